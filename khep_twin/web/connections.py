"""Connections to the page: limits of their number and of their waiting time, and reports of errors.

uvicorn waits for ever for the rest of a request and for a peer that accepts no answer, and it accepts until
no descriptor is left. Here a connection that stays in one state for too long is closed. At the limit, a new
connection replaces the one that has sent no complete head of a request for the longest time. A browser sends
its request at once, so connections that send nothing cannot lock it out.
"""

import logging
import time
from asyncio import BaseTransport, CancelledError
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from khep_twin.machine import open_files_limit

if TYPE_CHECKING:
    from uvicorn.server import Protocols

LONGEST_S: Mapping[str, float] = {"head": 10.0, "body": 60.0, "answer": 30.0, "end": 5.0}
"""Longest time in one state [s]: the head of a request, which begins with the connection or the last answer;
the rest of a request; an answer of which the peer accepts nothing; the last bytes of one, likewise. Work on
an answer, and a websocket that answers pings, may take any time."""

PING = 20.0
"""Interval of the pings to a websocket's page, and time to answer [s]."""

ACCEPTED_AT_ONCE, QUEUE = 4, 128
"""Largest numbers of connections accepted before the first can be closed, and waiting to be accepted."""

_MOST = 64
"""Largest number of connections: a page has up to seven, its websocket included."""

_AHEAD = 64 * 1024
"""Limit of bytes of further requests received before an answer; more than all of a page's."""

_NEXT_LINE = 60.0
"""Time in which an error of one kind is reported only once [s]."""


def most() -> int:
    """Return the limit of connections: as many as need a quarter of the descriptors, at most 64."""
    return max(min(_MOST, open_files_limit() // 4), 1)


class PageConnection(H11Protocol):
    """A connection that replaces an idle one if there are too many."""

    def connection_made(self, transport: BaseTransport) -> None:
        """Register the connection; close idle ones above the limit."""
        super().connection_made(transport)  # pyright: ignore[reportArgumentType]
        self.since = self.loop.time()
        places = most()
        taken = [each for each in self.connections if not _gone(each)]
        pages = [each for each in taken if isinstance(each, PageConnection)]
        idle = [each for each in pages if _stands_at(each)[0] in ("head", "end")]
        for each in sorted(idle, key=lambda each: each.since)[: max(len(taken) - places, 0)]:
            each.transport.abort()
            text = "all %d connections are taken; the one that is idle the longest is ended"
            self.logger.error(text, places)

    def on_response_complete(self) -> None:
        """Continue with the next request, unless requests arrive faster than they are answered."""
        if len(self.conn.trailing_data[0]) > _AHEAD:
            self.transport.abort()
        super().on_response_complete()


class Watch:
    """Limit of the time in one state; closes connections that exceed it when called repeatedly."""

    def __init__(self) -> None:
        self._seen: dict[object, tuple[tuple[str, object], float]] = {}

    def look(self, connections: Iterable["Protocols"], now: float) -> None:
        """Check all connections at a time [s]."""
        seen: dict[object, tuple[tuple[str, object], float]] = {}
        for connection in list(connections):
            stands_at = _stands_at(connection)
            before, since = self._seen.get(connection, (None, now))
            seen[connection] = stands_at, since if stands_at == before else now
            if now - seen[connection][1] > LONGEST_S.get(stands_at[0], float("inf")):
                connection.transport.abort()
        self._seen = seen


@contextmanager
def reported(report: Callable[[str], object] | None) -> Generator[None]:
    """Report each server error in one line, one of a kind per minute; without `report`, log them."""
    loggers = [logging.getLogger(name) for name in ("uvicorn.error", "asyncio")] if report else []
    lines = _Lines(report or str)
    for logger in loggers:
        logger.addHandler(lines)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(lines)


class _Lines(logging.Handler):
    """Handler that reports a record in one line."""

    def __init__(self, report: Callable[[str], object]) -> None:
        super().__init__(logging.ERROR)
        self._report = report
        self._next: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Report a record, unless one of its kind was reported a short time ago."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, CancelledError):
            return  # the server is shutting down
        kind, now = str(record.msg), time.monotonic()
        if now >= self._next.get(kind, 0.0):
            self._next[kind] = now + _NEXT_LINE
            text = record.getMessage().splitlines()[0]
            self._report(f"the page: {text}" + (f": {type(error).__name__}: {error}" if error else ""))


def _stands_at(connection: "Protocols") -> tuple[str, object]:
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


def _gone(connection: "Protocols") -> bool:
    return connection.transport.is_closing() and not connection.transport.get_write_buffer_size()
