"""Connection of one robot of a served twin to its host: a terminal or a network; a limit of its notices."""

import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

from khep_twin.board.uart import LineSettings


class Received(NamedTuple):
    """Bytes from the hosts of a cable since the last call, and news about the hosts.

    Attributes:
        data: Bytes sent by hosts that are here.
        left: All hosts that were here have left, even if another came since; what they left is cleared.
        last: Bytes sent by hosts that have left.
        notices: Lines for the user who runs the server.
    """

    data: bytes = b""
    left: bool = False
    last: bytes = b""
    notices: Sequence[str] = ()


NOTHING = Received()
"""No bytes and no news."""


class HostPort(Protocol):
    """The far end of one robot's line."""

    @property
    def path(self) -> str:
        """Path or URL that a host opens."""
        ...

    @property
    def dropped(self) -> int:
        """Number of bytes that no host took in time."""
        ...

    @property
    def occupied(self) -> bool:
        """True if a host is there, as far as that can be known."""
        ...

    def set_baud(self, baud: int) -> None:
        """Take the speed of the robot's line, which a host has that sets none [baud]."""
        ...

    def descriptors(self, room: bool) -> Sequence[int]:
        """Return the descriptors that become readable when a host comes, goes or, if `room`, writes."""
        ...

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; None where it has set none, or where they cannot be seen."""
        ...

    def receive(self, limit: int, answered: bool = False) -> Received:
        """Take what hosts have sent, at most `limit` bytes unless they have left, and news about them.

        Args:
            limit: Most bytes that the robot's line takes now.
            answered: All that was taken so far is carried out and answered: a host that has finished sending
                and waits for its replies is let go.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send to the host."""
        ...

    def close(self) -> None:
        """Close the host's endpoint."""
        ...


_AT_ONCE = 10
"""Notices that may follow each other."""

_INTERVAL = 10.0
"""Time per further notice [s]."""


class NoticeLimit:
    """Rate limit of notices, ten at once and six a minute: no host fills the log or blocks standard error."""

    def __init__(self) -> None:
        self._room = float(_AT_ONCE)
        self._since = time.monotonic()
        self._dropped = 0

    def admit(self, notices: Iterable[str]) -> list[str]:
        """Return the notices to be printed; the next one gives the number of those that were not."""
        now = time.monotonic()
        self._room = min(self._room + (now - self._since) / _INTERVAL, _AT_ONCE)
        self._since = now
        printed: list[str] = []
        for notice in notices:
            if self._room < 1:
                self._dropped += 1
                continue
            self._room -= 1
            rest = f" ({self._dropped} more notices were not printed)" if self._dropped else ""
            printed.append(notice + rest)
            self._dropped = 0
        return printed
