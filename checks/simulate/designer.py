"""A simulated designer: the page's real application behind its guard, on a simulated loop and threads.

uvicorn and its connections, the page's static files, pictures, robots at ports and the terminals of a twin
are not run here.
"""

import asyncio
import json
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from checks.simulate import kernel
from checks.simulate.kernel import NS_PER_S, OpenFile, Process
from checks.simulate.page_threads import REQUEST, Group, Loop
from checks.simulate.simulation import Simulation, Violation
from khep_twin.ports import service_registry
from khep_twin.ports.host_port import NOTHING
from khep_twin.process import signals
from khep_twin.web import answers, file_actions, session_actions, twin_session
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard
from khep_twin.web.routes import Page

HOST = "127.0.0.1:8000"

MOST_KILLED = 0.1
"""Highest probability that the designer is killed in one of the threads that it starts."""

MOST_STALLED = 3e-3
"""Highest probability that a thread is held up at a call: threads are more often than processes (assumed)."""

MOST_CALLS = 60, 10_000
"""Most calls of the thread of a request, and of a twin, until then."""


class UnreachedError(Exception):
    """The designer is gone, or the page has left before the answer."""


class PageRequest:
    """A request of a page.

    Attributes:
        action: Name of the action.
        wanted: Content, if it is an object.
        began_ns: Time of the request [ns].
        status: Status of the answer, 0 before.
        body: Answer.
        left: True if the page waits no longer.
    """

    def __init__(self, simulation: Simulation, action: str, arguments: Mapping[str, Any]) -> None:
        self.action, self.arguments, self.began_ns = action, arguments, simulation.kernel.now_ns
        self.file = OpenFile(simulation.kernel)
        self.status, self.body = 0, b""
        self.is_answered = self.has_left = False


class Socket:
    """A page's websocket, with received messages and those to be sent."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []
        self.left = False
        self.outbox: asyncio.Queue[dict[str, Any]] = asyncio.Queue()


class QuietPort:
    """Terminal of a twin, at which no host ever is."""

    path, dropped, occupied = "/dev/pts/none", 0, False

    def __init__(self, baud: int) -> None:
        pass

    def descriptors(self, has_room: bool) -> list[int]:
        """Return none."""
        return []

    def set_baud(self, baud: int) -> None:
        """Do nothing."""

    def settings(self) -> None:
        """Return none."""

    def receive(self, limit: int, is_answered: bool = False) -> object:
        """Return nothing."""
        return NOTHING

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Drop it."""

    def close(self) -> None:
        """Close it."""


class Designer:
    """One start of the designer.

    Args:
        simulation: Simulation.
        folder: Folder of the playpens.
        number: Number of the start.
    """

    def __init__(self, simulation: Simulation, folder: Path, number: int) -> None:
        self._simulation = simulation
        self.group = Group(simulation, f"designer {number}", self._died)
        self.loop = Loop(simulation)
        self.token = f"token-{number}"
        self.page: Page | None = None
        self._open: list[PageRequest] = []

        def begin() -> None:
            self.page = Page(Documents(folder), "first.toml")
            self._app = Guard(self.page.app(), self.token, {HOST})
            self.loop.run()

        self.group.thread("loop", begin, lambda: None)

    @property
    def alive(self) -> bool:
        """True if it answers."""
        return self.group.alive and self.page is not None

    def ask(
        self, request: PageRequest, body: bytes, headers: Mapping[str, str], timeout_s: float | None
    ) -> PageRequest:
        """Send a request and wait for its answer, in the page's process.

        Raises:
            UnreachedError: There is none, or the page has left before.
        """
        simulated = self._simulation.kernel
        simulated.called()
        if not self.alive:
            raise UnreachedError
        self._open.append(request)
        self.loop.call_soon_threadsafe(self._begin, request, body, headers)
        deadline_ns = None if timeout_s is None else simulated.now_ns + round(timeout_s * NS_PER_S)
        simulated.wait([request.file], lambda: request.is_answered or not self.group.alive, deadline_ns)
        request.has_left = True
        self._open.remove(request)
        if not request.is_answered:
            raise UnreachedError
        return request

    def connect(self) -> Socket:
        """Open a websocket."""
        socket = Socket()
        if self.alive:
            self.loop.call_soon_threadsafe(lambda: self.loop.create_task(self._serve(socket)))
        return socket

    def say(self, socket: Socket, message: dict[str, Any]) -> None:
        """Send a message of the websocket, for example its end."""
        socket.left = socket.left or message["type"] == "websocket.disconnect"
        if self.alive:
            self.loop.call_soon_threadsafe(socket.outbox.put_nowait, message)

    def in_thread(self, function: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:
        """Run a function in a thread, as starlette does."""
        future, faults = self.loop.create_future(), self._simulation.faults

        def work() -> None:
            try:
                result = function(*args)
            except Violation:
                raise
            except Exception as error:
                self.loop.call_soon_threadsafe(future.set_exception, error)
            else:
                self.loop.call_soon_threadsafe(future.set_result, result)

        request = REQUEST.get()
        thread = self.group.thread("request", work, lambda: None)
        self.group.requests[thread] = request
        self._doom(thread, MOST_CALLS[0])
        if faults.happens("late", "requests", 0.1):
            thread.token += 1
            late_ns = round(faults.drawn("late", "requests").uniform(0, 2) * NS_PER_S)
            self._simulation.kernel._push(self._simulation.kernel.now_ns + late_ns, thread)
        return future

    def _doom(self, thread: Process, most_calls: int) -> None:
        faults = self._simulation.faults
        if faults.happens("designer-killed", "designer", MOST_KILLED):
            thread.calls_left = round(most_calls ** faults.drawn("designer-killed", "designer").random())

    def _died(self) -> None:
        self.loop.close()
        for request in [*self._open]:
            request.file.changed()

    def _begin(self, request: PageRequest, body: bytes, headers: Mapping[str, str]) -> None:
        self.loop.create_task(self._answer(request, body, headers))

    def _scope(self, kind: str, path: str, headers: Mapping[str, str]) -> dict[str, Any]:
        all_headers = {"host": HOST, "origin": f"http://{HOST}", **headers}
        return {
            "type": kind,
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "scheme": "http",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": [(name.encode(), value.encode("latin-1")) for name, value in all_headers.items()],
            "client": ("127.0.0.1", 40000),
            "server": ("127.0.0.1", 8000),
        }

    async def _answer(self, request: PageRequest, body: bytes, headers: Mapping[str, str]) -> None:
        REQUEST.set(request)
        half = len(body) // 2
        parts = [{"body": body[:half], "more_body": True}, {"body": body[half:], "more_body": False}]

        async def receive() -> dict[str, Any]:
            if request.has_left or not parts:
                return {"type": "http.disconnect"}
            return {"type": "http.request", **parts.pop(0)}

        async def send(message: Any) -> None:
            if message["type"] == "http.response.start":
                request.status = message["status"]
            else:
                request.body += message.get("body", b"")

        all_headers = {"content-type": "application/json", "content-length": str(len(body)), **headers}
        key = all_headers.pop("token", self.token)
        scope = self._scope("http", f"/{key}/do/{request.action}", all_headers)
        try:
            await self._app({**scope, "method": "POST"}, receive, send)
        except Exception as error:
            self.loop.trouble = error
        request.is_answered = True
        request.file.changed()

    async def _serve(self, socket: Socket) -> None:
        first = [{"type": "websocket.connect"}]

        async def receive() -> dict[str, Any]:
            return first.pop() if first else await socket.outbox.get()

        async def send(message: Any) -> None:
            if socket.left:
                raise OSError
            if self._simulation.faults.happens("slow", "pages", 0.05):
                await asyncio.sleep(self._simulation.faults.drawn("slow", "pages").uniform(0, 3))
            if "text" in message:
                socket.messages.append(json.loads(message["text"]))

        try:
            await self._app(
                {**self._scope("websocket", f"/{self.token}/live", {}), "subprotocols": []}, receive, send
            )
        except Exception as error:
            self.loop.trouble = error


@contextmanager
def installed(simulation: Simulation, present: Callable[[], Designer], private: Path) -> Generator[None]:
    """Put simulated threads, terminals and private folder below the page."""

    async def run_in_threadpool(function: Callable[..., Any], *args: Any) -> Any:
        return await present().in_thread(function, *args)

    with ExitStack() as stack:
        for place, name, value in (
            (answers, "run_in_threadpool", run_in_threadpool),
            (file_actions, "found_ports", list),
            (session_actions, "found_ports", list),
            (twin_session, "open_any_port", QuietPort),
            (twin_session, "set_exact_timeouts", lambda: None),
            (service_registry, "private_folder", lambda: private),
            (kernel, "MOST_STALLED", MOST_STALLED),
            (signals, "_write_lock", simulation.system.modules["threading"].RLock()),
        ):
            stack.enter_context(patch.object(place, name, value))
        yield
