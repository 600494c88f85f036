"""Messages to the open pages, from any thread; a slow page misses pictures only.

Each message wakes the server's thread, which slows the simulation down. So messages are sent at most as often
as pictures, and pictures only while a page is open. A page that opens during a session first gets the message
that started the session, the paths of the robots, and the latest picture.
"""

import asyncio
import json
import math
from collections import deque
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from khep_twin.web.messages import FromPage, Message, Paths, Picture

_QUEUE_LIMIT = 500
"""Largest number of messages queued for a slow page."""

_PATH_LIMIT = 1500
"""Largest number of points of a path, as in the page."""

_PATH_STEP_MM = 3.0
"""Distance of a path's points, as in the page [mm]."""


class Broadcaster:
    """Sender of messages to the open pages."""

    def __init__(self) -> None:
        self._pages: list[_PageQueue] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._session_text: str | None = None
        self._picture: Message | None = None
        self._paths: list[list[tuple[float, float]]] = []

    @property
    def has_pages(self) -> bool:
        """True if a page is open."""
        return bool(self._pages)

    def publish(self, message: Message) -> None:
        """Send a message to all pages; from any thread."""
        kind = message["kind"]
        if message["kind"] == "picture":
            self._picture = message
            self._extend_paths(message)
            if not self._pages:
                return
        text = _to_json(message)
        if kind in ("twin", "robot", "ended"):
            self._session_text = None if kind == "ended" else text
            self._picture = None
            self._paths = []
        if self._loop is not None:
            with suppress(RuntimeError):  # the server is shutting down
                self._loop.call_soon_threadsafe(self._broadcast, kind, text)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page until it disconnects."""
        self._loop = asyncio.get_running_loop()
        await socket.accept()
        page = _PageQueue()
        if self._session_text is not None:
            page.put("session", self._session_text)
            paths: Paths = {"kind": "paths", "paths": [path.copy() for path in self._paths]}
            page.put("paths", _to_json(paths))
            if (picture := self._picture) is not None:  # the next one may take long
                page.put("picture", _to_json(picture))
        self._pages.append(page)
        sending = asyncio.create_task(self._send(socket, page))
        try:
            while True:
                text = await socket.receive_text()  # the page reports its file to the others
                message: FromPage = {"kind": "page", "said": text[:1000]}
                self._broadcast("page", json.dumps(message), sender=page)
        except (WebSocketDisconnect, KeyError):
            pass
        finally:
            self._pages.remove(page)
            sending.cancel()

    def _extend_paths(self, picture: Picture) -> None:
        """Add the robots' positions to their paths; a robot at a port has none."""
        robots = picture["robots"]
        if len(self._paths) != len(robots):
            self._paths = [[] for _ in robots]
        for path, robot in zip(self._paths, robots, strict=True):
            if "x_mm" not in robot or "y_mm" not in robot:
                continue
            position = robot["x_mm"], robot["y_mm"]
            if not path or math.dist(path[-1], position) > _PATH_STEP_MM:
                path.append(position)
                del path[:-_PATH_LIMIT]

    def _broadcast(self, kind: str, text: str, sender: "_PageQueue | None" = None) -> None:
        for page in self._pages:
            if page is not sender:
                page.put(kind, text)

    @staticmethod
    async def _send(socket: WebSocket, page: "_PageQueue") -> None:
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await socket.send_text(await page.get())


def _to_json(message: Message) -> str:
    return json.dumps(message, allow_nan=False, separators=(",", ":"))


class _PageQueue:
    """Queue of messages for one page."""

    def __init__(self) -> None:
        self._texts: deque[str] = deque(maxlen=_QUEUE_LIMIT)
        self._picture: str | None = None
        self._has_text = asyncio.Event()

    def put(self, kind: str, text: str) -> None:
        """Queue a message; a new picture replaces a queued one."""
        if kind == "picture":
            self._picture = text
        else:
            self._texts.append(text)
        self._has_text.set()

    async def get(self) -> str:
        """Wait for the next message and return it."""
        while not self._texts and self._picture is None:
            self._has_text.clear()
            await self._has_text.wait()
        if self._texts:
            return self._texts.popleft()
        text, self._picture = self._picture or "", None
        return text
