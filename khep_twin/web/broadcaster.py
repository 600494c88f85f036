"""Messages to the pages that watch: each page gets what a thread sends, and a slow one misses pictures only.

Each message to a page wakes the thread that sends, which then slows the simulation down. So messages
are sent no more often than pictures, and no pictures while no page watches.
"""

import asyncio
import json
from collections import deque
from collections.abc import Mapping
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

_WAITING = 500
"""Most messages that wait for a page that does not take them."""


class Broadcaster:
    """Pages that are open."""

    def __init__(self) -> None:
        self._watchers: list[_Watcher] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._last: dict[str, str] = {}

    def tell(self, message: Mapping[str, object]) -> None:
        """Send a message to all pages; from any thread."""
        kind = str(message.get("kind"))
        if kind == "picture" and not self._watchers:
            return
        text = json.dumps(message, allow_nan=False, separators=(",", ":"))
        if kind in ("twin", "robot"):
            self._last = {"cast": text}
        elif kind == "ended":
            self._last = {}
        if self._loop is not None:
            with suppress(RuntimeError):  # the server is at its end
                self._loop.call_soon_threadsafe(self._broadcast, kind, text)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page until it goes."""
        self._loop = asyncio.get_running_loop()
        await socket.accept()
        watcher = _Watcher()
        for text in self._last.values():
            watcher.take("cast", text)
        self._watchers.append(watcher)
        sending = asyncio.create_task(self._send(socket, watcher))
        try:
            while True:
                # A page reports which file it has, so that the others know.
                said = await socket.receive_text()
                self._broadcast("page", json.dumps({"kind": "page", "said": said[:1000]}), but=watcher)
        except (WebSocketDisconnect, KeyError):
            pass
        finally:
            self._watchers.remove(watcher)
            sending.cancel()

    def _broadcast(self, kind: str, text: str, but: "_Watcher | None" = None) -> None:
        for watcher in self._watchers:
            if watcher is not but:
                watcher.take(kind, text)

    @staticmethod
    async def _send(socket: WebSocket, watcher: "_Watcher") -> None:
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await socket.send_text(await watcher.next())


class _Watcher:
    """Messages that wait to be sent to one page."""

    def __init__(self) -> None:
        self._waiting: deque[str] = deque(maxlen=_WAITING)
        self._picture: str | None = None
        self._something = asyncio.Event()

    def take(self, kind: str, text: str) -> None:
        """Take a message; a new picture replaces the one that still waits."""
        if kind == "picture":
            self._picture = text
        else:
            self._waiting.append(text)
        self._something.set()

    async def next(self) -> str:
        """Return the next message, when there is one."""
        while not self._waiting and self._picture is None:
            self._something.clear()
            await self._something.wait()
        if self._waiting:
            return self._waiting.popleft()
        text, self._picture = self._picture or "", None
        return text
