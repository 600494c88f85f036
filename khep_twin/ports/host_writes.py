"""Bytes on a terminal and the hosts that have written them.

The kernel hands over bytes, and reports runs of writes, each by its own way: it keeps no boundary between the
bytes of a host that leaves and those of the next one. What was read and what was reported are compared here;
`terminal_hosts` has the reports, `pty` the bytes.
"""

import re
from dataclasses import dataclass
from enum import Enum

_LINE = re.compile(rb"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
"""Line with its end, or what there is of it."""

_TEXT = re.compile(rb"[\t\r\n -~]*")
"""Bytes that the robot's protocol consists of."""

_UNFINISHED = re.compile(rb"[^\r\n]*?[^,\r\n](?=[A-Z])")
"""Line that another one follows without an end between: commands begin with a capital letter."""


@dataclass(frozen=True, slots=True)
class Change:
    """Changes among the hosts since the last poll.

    Attributes:
        left: All hosts that were here have left, even if others came since.
        writes_before: Runs of writes of the hosts that have left; of those that are here, if none has.
        writes: Runs of writes of the hosts that came after the others left.
    """

    left: bool = False
    writes_before: int = 0
    writes: int = 0


class Reading(Enum):
    """Bytes that were read, compared with the writes that were reported.

    Attributes:
        EVEN: All that was read was reported, and all that was reported was read.
        AHEAD: Bytes were read whose write is not reported yet.
        BEHIND: Bytes of a reported write found no room here, or are underway.
        SPLIT: Bytes were read whose write is not reported yet, and more of them are there.
    """

    EVEN = (False, False)
    AHEAD = (True, False)
    BEHIND = (False, True)
    SPLIT = (True, True)

    @property
    def is_ahead(self) -> bool:
        """True if bytes were read whose write is not reported yet."""
        return self.value[0]

    @property
    def is_behind(self) -> bool:
        """True if bytes are still to be read."""
        return self.value[1]

    def after(self, got_bytes: bool, writes: int, more: bool) -> "Reading":
        """Return the next state, while no host leaves.

        Args:
            got_bytes: Bytes were read.
            writes: Runs of writes that were reported.
            more: More is there to read than there was room for.
        """
        # Bytes of an unfinished write are that write's, and no news.
        ahead = (self.is_ahead or (got_bytes and not self.is_behind)) and not writes
        return Reading((ahead, more or (writes > 0 and not got_bytes)))

    def unread(self, writes: int) -> int:
        """Return the runs of writes to be read yet, of the reported ones and those before."""
        return writes - self.is_ahead + self.is_behind


def divide_at_leaving(
    reading: Reading, first: bytes, is_whole: bool, rest: bytes, change: Change, later: Change
) -> tuple[bytes, bytes]:
    """Divide bytes into those of hosts that have left and those of hosts that are here.

    Args:
        reading: State before the first read.
        first: Bytes that were read before the hosts were polled.
        is_whole: True if these are some and no limit has cut them off.
        rest: Bytes that were read after that.
        change: Result of the poll, after which hosts have left.
        later: Result of another poll, after the rest.
    """
    n_before = reading.unread(change.writes_before)
    if not later.left:
        return divide(first + rest, n_before, change.writes + later.writes_before)
    # Whoever wrote what was read first has left, too, and with it that run of writes, unless cut off.
    last, data = divide(rest, n_before + change.writes + later.writes_before - is_whole, later.writes)
    return first + last, data


def divide(data: bytes, n_before: int, n_writes: int) -> tuple[bytes, bytes]:
    """Divide bytes into those of hosts that have left and those of hosts that are here.

    Where both have written, a new host is assumed to have written a line at a time. Bytes that are not text
    have no lines; all of them count as that host's, whose write may not have been reported yet.

    Args:
        data: Bytes of both.
        n_before: Runs of writes of hosts that have left.
        n_writes: Runs of writes of hosts that are here.
    """
    if n_before <= 0 or not _TEXT.fullmatch(data):
        return b"", data
    if n_writes <= 0:
        return data, b""
    lines = _LINE.findall(data)
    last, rest = b"".join(lines[:-n_writes]), b"".join(lines[-n_writes:])
    if unfinished := _UNFINISHED.match(rest):
        last, rest = last + unfinished[0], rest[unfinished.end() :]
    return last, rest
