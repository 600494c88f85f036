"""Interface of the ports that hosts open, as a terminal or over a network, and a rate limit of notices."""

import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

from khep_twin.board.uart import LineSettings


class Received(NamedTuple):
    """Bytes from the hosts of a port since the last call, and changes among the hosts.

    Attributes:
        data: Bytes sent by connected hosts.
        hosts_left: True if all earlier hosts have left and been cleared; another one may be connected.
        last_data: Bytes sent by hosts that have left.
        notices: Lines for the user who runs the server.
    """

    data: bytes = b""
    hosts_left: bool = False
    last_data: bytes = b""
    notices: Sequence[str] = ()


NOTHING = Received()
"""No bytes and no changes."""


class HostPort(Protocol):
    """End of one robot's line that hosts open."""

    @property
    def path(self) -> str:
        """Path or URL that a host opens."""
        ...

    @property
    def dropped(self) -> int:
        """Number of reply bytes that were dropped because no host read them in time."""
        ...

    @property
    def occupied(self) -> bool:
        """True if a host is connected, as far as the system reports it."""
        ...

    def set_baud(self, baud: int) -> None:
        """Set the baud rate of the robot's line, which applies to a host that sets none."""

    def descriptors(self, has_room: bool) -> Sequence[int]:
        """Return the descriptors that are readable when a host connects, leaves or, if `has_room`, writes."""
        ...

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; None if it has set none, or they are not reported."""
        ...

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        """Return the hosts' bytes, at most `limit` from connected ones, and changes among the hosts.

        Args:
            limit: Most bytes that the robot's line accepts now.
            is_answered: True if all earlier commands are answered; a host that has finished may be closed.
        """
        ...

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Send to the host; `is_end` is True if no further byte of a reply is on its way."""

    def close(self) -> None:
        """Close the port."""


_MAX_TOKENS = 10
"""Notices that are printed without a pause."""

_TOKEN_INTERVAL_S = 10.0
"""Time per further notice [s]."""


class NoticeLimit:
    """Rate limit of notices, ten together and six per minute: no host fills the log or blocks stderr."""

    def __init__(self) -> None:
        self._tokens = float(_MAX_TOKENS)
        self._updated_s = time.monotonic()
        self._n_suppressed = 0

    def admit(self, notices: Iterable[str]) -> list[str]:
        """Return the notices to print; one after suppressed notices states their number."""
        now = time.monotonic()
        self._tokens = min(self._tokens + (now - self._updated_s) / _TOKEN_INTERVAL_S, _MAX_TOKENS)
        self._updated_s = now
        admitted: list[str] = []
        for notice in notices:
            if self._tokens < 1:
                self._n_suppressed += 1
                continue
            self._tokens -= 1
            suffix = f" ({self._n_suppressed} more notices were not printed)" if self._n_suppressed else ""
            admitted.append(notice + suffix)
            self._n_suppressed = 0
        return admitted
