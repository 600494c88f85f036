"""Assignment of the bytes on a terminal to the hosts that have written them.

The kernel passes bytes, and reports runs (consecutive writes) separately. It keeps no boundary between the
bytes of a host that leaves and those of the next one. This module compares the bytes that `pty` has read with
the writes that `terminal_hosts` reports.
"""

import re
from dataclasses import dataclass
from enum import Enum

_LINE = re.compile(rb"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
"""Line with its end, or an unfinished line."""

_PROTOCOL_TEXT = re.compile(rb"[\t\r\n -~]*")
"""Bytes of the robot's protocol."""

_UNFINISHED_LINE = re.compile(rb"[^\r\n]*?[^,\r\n](?=[A-Z])")
"""Unfinished line directly before another one: commands start with a capital letter."""


@dataclass(frozen=True, slots=True)
class Change:
    """Changes among the hosts since the last poll.

    Attributes:
        hosts_left: True if all earlier hosts have left, even if others have opened the terminal since.
        old_writes: Runs of writes of the hosts that have left; of the present hosts, if none has left.
        new_writes: Runs of writes of the hosts that came after the others left.
    """

    hosts_left: bool = False
    old_writes: int = 0
    new_writes: int = 0


class ReadState(Enum):
    """State of the bytes that were read, compared with the writes that were reported.

    Attributes:
        MATCHED: All bytes that were read were reported, and all reported writes were read.
        UNREPORTED: Bytes were read whose write is not reported yet.
        UNREAD: Bytes of a reported write had no room in the last read, or are in transit.
        SPLIT: Bytes were read whose write is not reported yet, and more bytes of it are pending.
    """

    MATCHED = (False, False)
    UNREPORTED = (True, False)
    UNREAD = (False, True)
    SPLIT = (True, True)

    @property
    def has_unreported(self) -> bool:
        """True if bytes were read whose write is not reported yet."""
        return self.value[0]

    @property
    def has_unread(self) -> bool:
        """True if bytes are pending."""
        return self.value[1]

    def next_state(self, has_read: bool, n_writes: int, is_full: bool) -> "ReadState":
        """Return the next state, while no host leaves.

        Args:
            has_read: True if bytes were read.
            n_writes: Runs of writes that were reported.
            is_full: True if more bytes are pending than there was room for.
        """
        # Bytes of a partly read write belong to that write.
        is_unreported = (self.has_unreported or (has_read and not self.has_unread)) and not n_writes
        return ReadState((is_unreported, is_full or (n_writes > 0 and not has_read)))

    def count_unread(self, n_writes: int) -> int:
        """Return the number of unread runs of writes, both newly reported and earlier ones."""
        return n_writes - self.has_unreported + self.has_unread


def split_at_departure(
    state: ReadState, first: bytes, is_complete: bool, rest: bytes, change: Change, later_change: Change
) -> tuple[bytes, bytes]:
    """Split bytes into those of hosts that have left and those of present hosts.

    Args:
        state: State before the first read.
        first: Bytes that were read before the hosts were polled.
        is_complete: True if these are not empty and were not cut off by the limit.
        rest: Bytes that were read after the poll.
        change: Result of the poll, which reported that hosts have left.
        later_change: Result of another poll after the rest was read.
    """
    n_old_writes = state.count_unread(change.old_writes)
    if not later_change.hosts_left:
        return split_by_host(first + rest, n_old_writes, change.new_writes + later_change.old_writes)
    # The host that wrote the first bytes has also left; its run of writes is complete unless cut off.
    n_old_writes += change.new_writes + later_change.old_writes - is_complete
    last_data, data = split_by_host(rest, n_old_writes, later_change.new_writes)
    return first + last_data, data


def split_by_host(data: bytes, n_old_writes: int, n_new_writes: int) -> tuple[bytes, bytes]:
    """Split bytes into those of hosts that have left and those of present hosts.

    If both have written, a new host is assumed to have written one line per write. Bytes that are not text
    have no lines; all of them are assigned to the new host, whose write may not be reported yet.

    Args:
        data: Bytes of both.
        n_old_writes: Runs of writes of hosts that have left.
        n_new_writes: Runs of writes of present hosts.
    """
    if n_old_writes <= 0 or not _PROTOCOL_TEXT.fullmatch(data):
        return b"", data
    if n_new_writes <= 0:
        return data, b""
    lines = _LINE.findall(data)
    last_data, new_data = b"".join(lines[:-n_new_writes]), b"".join(lines[-n_new_writes:])
    if unfinished := _UNFINISHED_LINE.match(new_data):
        last_data, new_data = last_data + unfinished[0], new_data[unfinished.end() :]
    return last_data, new_data
