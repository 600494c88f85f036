"""Hosts that hold a pseudo-terminal open, by the kernel's reports.

A terminal whose host side is closed everywhere reports a hang-up, which is decisive. inotify reports when
to check, and in which order hosts opened, wrote and closed; it merges equal consecutive events, so its
counts alone are not reliable. On a system without inotify, the terminal is checked on each poll.

    free --opened--> held --closed--> check --hang-up--> free
                      ^                 |
                      +---no hang-up----+  the next host is in the events, or is counted after 1 s without

One descriptor of the host side stays open here, to remove settings and locks that hosts leave. It is closed
during a check.
"""

import fcntl
import os
import select
import sys
import termios
import time
from collections.abc import Sequence

from khep_twin.ports.event_sources import ONE_WRITE, Event, OpenEvents
from khep_twin.ports.host_writes import Change
from khep_twin.ports.port_users import count_descriptors

if sys.platform == "win32":
    raise ImportError("a pseudo-terminal needs a system with terminals")

_ROUNDS = 4
"""Most checks of the terminal per poll; the next poll continues."""

_CLOSING_S = 1.0
"""Longest duration of a `close` in the kernel (assumed) [s]."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)
"""Request for the state of a terminal's lock, which Python 3.11 does not name; the number is Linux's."""

_NO_CHANGE, _ONE_WRITE = Change(), Change(writes_before=1)


class TerminalHosts:
    """Hosts on the host side of a terminal.

    Args:
        terminal: Descriptor of this side.
        host_side: Descriptor of the host side, which this object will close.
        events: Event source; None if the system has none.

    Attributes:
        hosts: Lower bound of the descriptors that hosts have open; 0 only if they have none.
        host_side: Descriptor of the host side that stays open here.
    """

    def __init__(self, terminal: int, host_side: int, events: OpenEvents | None) -> None:
        self.hosts = 0
        self.host_side = host_side
        self._name = os.ttyname(host_side)
        self._events = events
        self._own_events: list[Event] = []
        self._pending: list[Event] = []
        self._recheck_until_s: float | None = None
        self._was_shared = False  # by several hosts since the terminal was free
        self._poll = select.poll()
        self._poll.register(terminal, 0)

    @property
    def descriptors(self) -> Sequence[int]:
        """Descriptor for `select`, readable when hosts open, write or close; none without events."""
        return [] if self._events is None else [self._events.descriptor]

    def poll(self, has_data: bool) -> Change:
        """Return the changes since the last poll; `has_data` if bytes of a host were read since then."""
        if self._events is None:
            left = not (is_held := self._is_held()) and (has_data or self.hosts > 0)
            self.hosts = int(is_held)
            return Change(left)
        drained = self._drain(self._events)
        is_steady = self.hosts and not self._pending and self._recheck_until_s is None
        if is_steady and (not drained or drained is ONE_WRITE):
            self._was_shared |= self.hosts > 1
            return _ONE_WRITE if drained else _NO_CHANGE
        events = [*self._pending, *drained]
        if has_data and not self.hosts and Event.OPENED not in events:
            # An event was lost; a check corrects the number.
            events.append(Event.CLOSED)
        hosts, change, handled = self.hosts, Change(), list[Event]()
        for _ in range(_ROUNDS):
            handled += events
            if Event.CLOSED not in events:
                events = []
                break
            is_held, events = self._is_held(), [*self._drain(self._events)]
            if not is_held:
                change = _apply_events(hosts, change, handled)[1]
                hosts, change, handled, self._was_shared = 0, _all_left(change), [], False
        self._pending = events
        n_hosts, next_change = _apply_events(hosts, change, handled)
        recheck_until_s, self._recheck_until_s = self._recheck_until_s, None
        # The last check found a host that the events do not have.
        if Event.CLOSED in handled and n_hosts == 0:
            # The kernel reports a closing before it is complete, so check again; or it has merged events.
            self._recheck_until_s = recheck_until_s or time.monotonic() + _CLOSING_S
            if time.monotonic() < self._recheck_until_s:
                self._pending = handled + self._pending
                self.hosts = max(hosts, 1)
                return change
        self._was_shared |= max(hosts, n_hosts, handled.count(Event.OPENED)) > 1
        # Single hosts in turn are accepted as reported: a count takes ms, in which more events may follow.
        if Event.CLOSED in handled and (n_hosts == 0 or (self._was_shared and Event.OPENED in handled)):
            n_open = count_descriptors(self._name) - 1 or max(n_hosts, 1)
            self._pending += self._drain(self._events)
            if n_hosts == 0 or not self._pending:
                n_hosts, next_change = _apply_events(hosts + n_open - n_hosts, change, handled)
        self.hosts = max(n_hosts, 1) if Event.CLOSED in handled else n_hosts
        return next_change

    def is_quiet(self) -> bool:
        """Return whether no host has connected, written or left since the last poll."""
        if self._events is None:
            return self.hosts == int(self._is_held())
        # Includes events of other terminals in the directory.
        self._pending += self._drain(self._events)
        return not self._pending

    def recount(self) -> int:
        """Count the hosts by /proc, which misses those of other users; return the number, at least 1."""
        self.hosts = max(count_descriptors(self._name) - 1, 1)
        return self.hosts

    def close(self) -> None:
        """Release the host side and the event source."""
        os.close(self.host_side)
        if self._events is not None:
            self._events.close()

    def _drain(self, events: OpenEvents) -> Sequence[Event]:
        """Return the hosts' events since the last call, in order, without those of `_is_held`."""
        if not self._own_events:
            return events.drain()
        drained = [*events.drain()]
        # `_is_held` closed a descriptor, then opened one; a host may have opened another just before.
        start = 0
        for event in self._own_events:
            if event in drained[start:]:
                start = drained.index(event, start)
                del drained[start]
        self._own_events = []
        return drained

    def _is_held(self) -> bool:
        """Return whether a host holds the terminal: without one, closing `host_side` causes a hang-up."""
        is_locked = any(fcntl.ioctl(self.host_side, _TIOCGEXCL, bytes(4)))
        if is_locked:
            # A lock would also exclude this process.
            fcntl.ioctl(self.host_side, termios.TIOCNXCL)
        os.close(self.host_side)
        is_held = not any(state & select.POLLHUP for _, state in self._poll.poll(0))
        self.host_side = os.open(self._name, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        self._own_events = [Event.CLOSED, Event.OPENED]
        if is_locked and is_held:
            fcntl.ioctl(self.host_side, termios.TIOCEXCL)
        return is_held


def _all_left(change: Change) -> Change:
    """Return a change after which all hosts have left; all writes so far are theirs."""
    return Change(True, change.writes_before + change.writes, 0)


def _apply_events(hosts: int, change: Change, events: list[Event]) -> tuple[int, Change]:
    """Return the number of hosts and the change after further events."""
    for event in events:
        if event is Event.OPENED:
            hosts += 1
        elif event is Event.WRITTEN:
            n_before, n_after = (0, 1) if change.hosts_left else (1, 0)
            change = Change(change.hosts_left, change.writes_before + n_before, change.writes + n_after)
        elif hosts <= 1:
            hosts, change = 0, _all_left(change)
        else:
            hosts -= 1
    return hosts, change
