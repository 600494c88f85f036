"""The designer's page without sockets and threads: its connection, guard, and routes, for a fuzz target.

Bytes of a browser pass through the server's `PageConnection`, over a transport in memory, and through
uvicorn, the guard and the routes. A session has its real world, but no thread that runs it: its jobs wait. No
port is opened, and no picture rendered, which would take a second each.
"""

import asyncio
import logging
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import uvicorn
from uvicorn.server import ServerState

from checks.fuzz import page_recipes as recipes
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.ports.twin import open_twin
from khep_twin.web import answers as page_answers
from khep_twin.web import (
    challenges,
    connections,
    file_actions,
    robot_session,
    routes,
    server,
    session_actions,
    twin_session,
)
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard

HOST, TOKEN = recipes.HOST.decode(), recipes.TOKEN.decode()

TIMEOUT_S = 10.0
"""Longest time for an answer [s]."""

ANSWER = re.compile(rb"HTTP/1\.[01] (\d{3}) [^\r\n]*\r\n((?:[^\r\n]+\r\n)*)\r\n")


class Answer(NamedTuple):
    """Answer to a request: status, head, and body."""

    status: int
    head: bytes
    body: bytes


class Transport(asyncio.Transport):
    """Transport of one connection; `sent` has the answers."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, self.closed = bytearray(), False
        self.protocol: Any = None

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return an address on loopback."""
        return {"peername": ("127.0.0.1", 50000), "sockname": ("127.0.0.1", 7000)}.get(name, default)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Take a part of an answer."""
        if not self.closed:
            self.sent += data

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Continue with a websocket's protocol."""
        self.protocol = protocol

    def is_closing(self) -> bool:
        """Return whether the server has closed the connection."""
        return self.closed

    def close(self) -> None:
        """Close the connection."""
        self.closed = True

    def get_write_buffer_size(self) -> int:
        """Return 0: the browser takes all bytes immediately."""
        return 0

    abort = close
    pause_reading = resume_reading = lambda self: None


class Session(twin_session.TwinActor):
    """Session with a world whose time stands still, and which carries out requests immediately."""

    def begin(self) -> None:
        """Open the world."""
        self._open = ExitStack()
        self._is_alive = True
        twin = self._open.enter_context(open_twin(self.playpen, self._options))
        if self.log is not None:
            twin.record(self.log)
        self._twin = Requests(twin)  # pyright: ignore

    @property
    def is_alive(self) -> bool:
        """True until the end."""
        return self._is_alive

    def end(self) -> None:
        """Close the world."""
        if self.is_alive:
            self._is_alive = False
            self._open.close()


class Requests:
    """Time source that stands still, and does each request when it comes."""

    def __init__(self, twin: Any) -> None:
        self.world, self.robots = twin.world, twin.robots
        self.speed, self.paused = 1.0, False

    def request(self, action: Callable[[], None]) -> None:
        """Carry out a request of a page."""
        action()

    def step(self) -> None:
        """Take no step."""

    def stop_motors(self) -> None:
        """Stop no motors."""

    def stop_program(self) -> None:
        """End no job."""


class Unopened(robot_session.RobotActor):
    """Robot at a port that is never opened."""

    def begin(self) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""

    @property
    def is_alive(self) -> bool:
        """True."""
        return True


class Waiting(challenges.Challenges):
    """Challenges whose programs are never started."""

    def _start(self, message: Mapping[str, object], work: Callable[..., None]) -> None:
        """Publish the message without scoring."""
        self._publish(message)


class Errors(logging.Handler):
    """Handler that keeps the server's error records."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep an error."""
        self.records.append(record)


class Designer:
    """Designer of one folder; `errors` holds the error records of its server."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.errors = folder, Errors()
        self.loop = asyncio.new_event_loop()
        self.patch_slow_parts()
        logging.getLogger("uvicorn.error").propagate = False
        for name in ("uvicorn.error", "asyncio"):
            logging.getLogger(name).addHandler(self.errors)

    def patch_slow_parts(self) -> None:
        """Replace functions that need threads, ports or a second for a picture."""

        async def call_directly(function: Callable[..., Any], *words: Any) -> Any:
            return function(*words)

        page_answers.run_in_threadpool = call_directly
        session_actions.TwinActor, session_actions.RobotActor = Session, Unopened  # pyright: ignore
        routes.Challenges = Waiting  # pyright: ignore
        file_actions.render = lambda playpen, path: b"\x89PNG" + repr(playpen.name).encode()  # pyright: ignore

    def opened(self) -> "Browser":
        """Return a browser at a new page."""
        return Browser(self)


class Browser:
    """Connections of a browser to a new page."""

    def __init__(self, designer: Designer) -> None:
        self._loop, self._state = designer.loop, ServerState()
        self.page = routes.Page(Documents(designer.folder), None)
        test = SensorTest("proximity", 10.0, None, 10, 64, False)
        self.page._session._sensor_runs.append(SensorRun(test, np.ones((2, 10), np.int64), np.arange(2.0)))  # pyright: ignore
        self._config = uvicorn.Config(
            Guard(self.page.app(), TOKEN, {HOST, HOST.replace("127.0.0.1", "localhost")}),
            log_config=None,
            access_log=False,
            lifespan="off",
            server_header=False,
            ws="websockets-sansio",
            ws_max_size=server.MESSAGE_LIMIT,
            ws_ping_interval=server.PING_S,
            h11_max_incomplete_event_size=32 * 1024,
            http=connections.PageConnection,
        )

    def say(self, pieces: list[bytes]) -> bytes:
        """Send bytes over a new connection, and close it; return all that was answered."""
        return self._loop.run_until_complete(asyncio.wait_for(self._send_pieces(pieces), TIMEOUT_S))

    async def _send_pieces(self, pieces: list[bytes]) -> bytes:
        transport = Transport()
        if not self._config.loaded:
            self._config.load()
        transport.protocol = connections.PageConnection(self._config, self._state, {}, self._loop)
        transport.protocol.connection_made(transport)
        for piece in pieces:
            if not transport.closed:
                transport.protocol.data_received(piece)
                await self._quiet(transport)
        transport.protocol.connection_lost(None)
        # Each task ends with its connection.
        while tasks := list(self._state.tasks):
            await asyncio.wait(tasks)
        return bytes(transport.sent)

    async def _quiet(self, transport: Transport) -> None:
        """Wait until the server waits for its browser."""
        while not transport.closed:
            cycle = getattr(transport.protocol, "cycle", None)
            if cycle is not None and cycle.response_complete:
                return
            # Only the page's files are read by another thread.
            is_answering = cycle is not None and not cycle.more_body
            await asyncio.sleep(0)
            if not self._loop._ready:  # pyright: ignore
                if not is_answering:
                    return
                await asyncio.sleep(0.0001)

    def close(self) -> None:
        """End the session."""
        self.page.close()


def answers(sent: bytes) -> list[Answer]:
    """Return the answers in the bytes that a connection sent; a websocket's messages are the body of its 101.

    Raises:
        AssertionError: It is no sequence of answers.
    """
    responses: list[Answer] = []
    while sent:
        head = ANSWER.match(sent)
        assert head, sent[:200]
        status, rest = int(head[1]), sent[head.end() :]
        if status == 100:  # no answer: the rest of the request may come
            sent = rest
            continue
        length = re.search(rb"(?i)^content-length: (\d+)\r$", head[2], re.MULTILINE)
        size = len(rest) if length is None else int(length[1])
        if rest.startswith(b"HTTP/1.") or status == 304:  # of a HEAD
            size = 0
        responses.append(Answer(status, head[2], rest[:size]))
        sent = rest[size:]
    return responses
