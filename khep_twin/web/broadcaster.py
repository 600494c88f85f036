"""Messages to the open pages: each page gets what a thread sends; a slow page misses pictures only.

Each message to a page wakes the sending thread, which slows the simulation down. So messages are sent no
more often than pictures, and no pictures without an open page.
"""

import asyncio
import json
from collections import deque
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from khep_twin.web.messages import FromPage, Message

_WAITING = 500
"""Largest number of messages that wait for a slow page."""


class Broadcaster:
    """Sender of messages to the open pages."""

    def __init__(self) -> None:
        self._watchers: list[_Watcher] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._begun: str | None = None
        self._picture: Message | None = None

    @property
    def is_watched(self) -> bool:
        """True if a page is open."""
        return bool(self._watchers)

    def publish(self, message: Message) -> None:
        """Send a message to all pages; from any thread."""
        kind = message["kind"]
        if kind == "picture":
            self._picture = message
            if not self._watchers:
                return
        text = _text(message)
        if kind in ("twin", "robot", "ended"):
            self._begun, self._picture = None if kind == "ended" else text, None
        if self._loop is not None:
            with suppress(RuntimeError):  # the server is at its end
                self._loop.call_soon_threadsafe(self._broadcast, kind, text)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page until it disconnects."""
        self._loop = asyncio.get_running_loop()
        await socket.accept()
        watcher = _Watcher()
        if self._begun is not None:
            watcher.take("begun", self._begun)
            if (picture := self._picture) is not None:  # the next one may be long in coming
                watcher.take("picture", _text(picture))
        self._watchers.append(watcher)
        sending = asyncio.create_task(self._send(socket, watcher))
        try:
            while True:
                # A page reports its file to the others.
                said = await socket.receive_text()
                message: FromPage = {"kind": "page", "said": said[:1000]}
                self._broadcast("page", json.dumps(message), but=watcher)
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


def _text(message: Message) -> str:
    return json.dumps(message, allow_nan=False, separators=(",", ":"))


class _Watcher:
    """Queue of messages for one page."""

    def __init__(self) -> None:
        self._waiting: deque[str] = deque(maxlen=_WAITING)
        self._picture: str | None = None
        self._something = asyncio.Event()

    def take(self, kind: str, text: str) -> None:
        """Queue a message; a new picture replaces one that still waits."""
        if kind == "picture":
            self._picture = text
        else:
            self._waiting.append(text)
        self._something.set()

    async def next(self) -> str:
        """Wait for the next message and return it."""
        while not self._waiting and self._picture is None:
            self._something.clear()
            await self._something.wait()
        if self._waiting:
            return self._waiting.popleft()
        text, self._picture = self._picture or "", None
        return text
