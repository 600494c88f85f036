"""Connections to the page: limits of their number and of their waiting time, and reports of errors.

uvicorn waits forever for the rest of a request and for a peer that accepts no answer, and it accepts until
no descriptor is left. Here a connection that stays in one state without progress for too long is closed:

    head --> body --> work --> answer --> head, for the next request
    any state --> end, when the server closes the connection

At the limit, a new connection replaces the oldest one in the states head and end. A browser sends its request
immediately, so connections that send nothing cannot lock it out.
"""

import logging
import time
from asyncio import BaseTransport, CancelledError
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from uvicorn.protocols.http.h11_impl import H11Protocol

from khep_twin.process.machine import open_files_limit

if TYPE_CHECKING:
    from uvicorn.server import Protocols

State = Literal["head", "body", "work", "answer", "end"]

LONGEST_S: Mapping[State, float] = {"head": 10.0, "body": 60.0, "answer": 30.0, "end": 5.0}
"""Longest time without progress in a state [s]: the head of a request, after the connection or last answer;
the rest of a request; an answer, and the last bytes of one, of which the peer accepts nothing. Work on an
answer, and a websocket that answers pings, may take any time."""

PING_S = 20.0
"""Interval of pings to a page's websocket, and time limit of its reply [s]."""

ACCEPT_BATCH, BACKLOG = 4, 128
"""Largest numbers of connections accepted before the first can be closed, and in the listen queue."""

_CONNECTION_LIMIT = 64
"""Largest number of connections; a page has up to seven, with its websocket."""

_PIPELINE_LIMIT = 64 * 1024
"""Limit of pipelined requests, which are received before an answer [bytes]; more than a page sends."""

_REPORT_INTERVAL = 60.0
"""Shortest interval of reports of one kind of error [s]."""


def connection_limit() -> int:
    """Return the limit of connections: a quarter of the descriptors, at most 64."""
    return max(min(_CONNECTION_LIMIT, open_files_limit() // 4), 1)


class PageConnection(H11Protocol):
    """Connection that replaces an idle one at the limit."""

    def connection_made(self, transport: BaseTransport) -> None:
        """Register the connection; close idle ones above the limit."""
        super().connection_made(transport)  # pyright: ignore[reportArgumentType]
        self.connect_time = self.loop.time()
        limit = connection_limit()
        connections = [connection for connection in self.connections if not _is_closed(connection)]
        pages = [connection for connection in connections if isinstance(connection, PageConnection)]
        idle = [connection for connection in pages if _find_state(connection)[0] in ("head", "end")]
        idle.sort(key=lambda connection: connection.connect_time)
        for connection in idle[: max(len(connections) - limit, 0)]:
            connection.transport.abort()
            text = "all %d connections are taken; the one that is idle the longest is ended"
            self.logger.error(text, limit)

    def on_response_complete(self) -> None:
        """Continue with the next request, unless requests arrive faster than answers leave."""
        if len(self.conn.trailing_data[0]) > _PIPELINE_LIMIT:
            self.transport.abort()
        super().on_response_complete()


class Watchdog:
    """Closes connections that stay in one state for too long; call `check` repeatedly."""

    def __init__(self) -> None:
        self._states: dict[object, tuple[tuple[State, object], float]] = {}

    def check(self, connections: Iterable["Protocols"], now: float) -> None:
        """Check all connections at a time [s]."""
        states: dict[object, tuple[tuple[State, object], float]] = {}
        for connection in list(connections):
            state = _find_state(connection)
            previous, start = self._states.get(connection, (None, now))
            states[connection] = state, start if state == previous else now
            if now - states[connection][1] > LONGEST_S.get(state[0], float("inf")):
                connection.transport.abort()
        self._states = states


@contextmanager
def report_errors(report: Callable[[str], object] | None) -> Generator[None]:
    """Report server errors, a line each and one of a kind per minute; without `report`, log them."""
    loggers = [logging.getLogger(name) for name in ("uvicorn.error", "asyncio")] if report else []
    handler = _LineHandler(report or str)
    for logger in loggers:
        logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


class _LineHandler(logging.Handler):
    """Handler that reports a record in one line."""

    def __init__(self, report: Callable[[str], object]) -> None:
        super().__init__(logging.ERROR)
        self._report = report
        self._next: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Report a record, unless one of its kind was reported within the last minute."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, CancelledError):
            return  # the server is shutting down
        kind, now = str(record.msg), time.monotonic()
        if now >= self._next.get(kind, 0.0):
            self._next[kind] = now + _REPORT_INTERVAL
            text = record.getMessage().splitlines()[0]
            self._report(f"the page: {text}" + (f": {type(error).__name__}: {error}" if error else ""))


def _find_state(connection: "Protocols") -> tuple[State, object]:
    """Return a connection's state, and a value that changes with its progress."""
    transport = connection.transport
    if transport.is_closing():
        return "end", None
    if unsent := transport.get_write_buffer_size():
        return "answer", unsent
    if isinstance(connection, H11Protocol):
        cycle: Any = connection.cycle
        if cycle is None or cycle.response_complete:
            return "head", cycle
        if cycle.more_body:
            return "body", cycle
    return "work", None


def _is_closed(connection: "Protocols") -> bool:
    return connection.transport.is_closing() and not connection.transport.get_write_buffer_size()
