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

_MAX_CHECKS = 4
"""Most checks of the terminal per poll; the next poll continues."""

_CLOSING_S = 1.0
"""Longest duration of a `close` in the kernel (assumed) [s]."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)
"""Request for the state of a terminal's lock, which Python 3.11 does not name; the number is Linux's."""

_NO_CHANGE, _ONE_WRITE = Change(), Change(old_writes=1)


class TerminalHosts:
    """Hosts on the host side of a terminal.

    Args:
        terminal: Descriptor of this side.
        host_side: Descriptor of the host side, which this object will close.
        events: Event source; None if the system has none.

    Attributes:
        n_hosts: Lower bound of the descriptors that hosts have open; 0 only if they have none.
        host_side: Descriptor of the host side that stays open here.
    """

    def __init__(self, terminal: int, host_side: int, events: OpenEvents | None) -> None:
        self.n_hosts = 0
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
            have_left = not (has_host := self._has_host()) and (has_data or self.n_hosts > 0)
            self.n_hosts = int(has_host)
            return Change(have_left)
        new_events = self._drain(self._events)
        is_steady = self.n_hosts and not self._pending and self._recheck_until_s is None
        if is_steady and (not new_events or new_events is ONE_WRITE):
            self._was_shared |= self.n_hosts > 1
            return _ONE_WRITE if new_events else _NO_CHANGE
        events = [*self._pending, *new_events]
        if has_data and not self.n_hosts and Event.OPENED not in events:
            # An event was lost; a check corrects the number.
            events.append(Event.CLOSED)
        n_before, change, handled = self.n_hosts, Change(), list[Event]()
        for _ in range(_MAX_CHECKS):
            handled += events
            if Event.CLOSED not in events:
                events = []
                break
            has_host, events = self._has_host(), [*self._drain(self._events)]
            if not has_host:
                change = _apply_events(n_before, change, handled)[1]
                n_before, change, handled, self._was_shared = 0, _mark_all_left(change), [], False
        self._pending = events
        n_hosts, next_change = _apply_events(n_before, change, handled)
        recheck_until_s, self._recheck_until_s = self._recheck_until_s, None
        # The last check found a host that the events do not have.
        if Event.CLOSED in handled and n_hosts == 0:
            # The kernel reports a closing before it is complete, so check again; or it has merged events.
            self._recheck_until_s = recheck_until_s or time.monotonic() + _CLOSING_S
            if time.monotonic() < self._recheck_until_s:
                self._pending = handled + self._pending
                self.n_hosts = max(n_before, 1)
                return change
        self._was_shared |= max(n_before, n_hosts, handled.count(Event.OPENED)) > 1
        # Single hosts in turn are accepted as reported: a count takes ms, in which more events may follow.
        if Event.CLOSED in handled and (n_hosts == 0 or (self._was_shared and Event.OPENED in handled)):
            n_open = count_descriptors(self._name) - 1 or max(n_hosts, 1)
            self._pending += self._drain(self._events)
            if n_hosts == 0 or not self._pending:
                n_hosts, next_change = _apply_events(n_before + n_open - n_hosts, change, handled)
        self.n_hosts = max(n_hosts, 1) if Event.CLOSED in handled else n_hosts
        return next_change

    def is_quiet(self) -> bool:
        """Return whether no host has connected, written or left since the last poll."""
        if self._events is None:
            return self.n_hosts == int(self._has_host())
        # Includes events of other terminals in the directory.
        self._pending += self._drain(self._events)
        return not self._pending

    def recount(self) -> int:
        """Count the hosts by /proc, which misses those of other users; return the number, at least 1."""
        self.n_hosts = max(count_descriptors(self._name) - 1, 1)
        return self.n_hosts

    def close(self) -> None:
        """Release the host side and the event source."""
        os.close(self.host_side)
        if self._events is not None:
            self._events.close()

    def _drain(self, events: OpenEvents) -> Sequence[Event]:
        """Return the hosts' events since the last call, in order, without those of `_has_host`."""
        if not self._own_events:
            return events.drain()
        drained = [*events.drain()]
        # `_has_host` closed a descriptor, then opened one; a host may have opened another just before.
        start = 0
        for event in self._own_events:
            if event in drained[start:]:
                start = drained.index(event, start)
                del drained[start]
        self._own_events = []
        return drained

    def _has_host(self) -> bool:
        """Return whether a host holds the terminal: without one, closing `host_side` causes a hang-up."""
        is_locked = any(fcntl.ioctl(self.host_side, _TIOCGEXCL, bytes(4)))
        if is_locked:
            # A lock would also exclude this process.
            fcntl.ioctl(self.host_side, termios.TIOCNXCL)
        os.close(self.host_side)
        has_host = not any(state & select.POLLHUP for _, state in self._poll.poll(0))
        self.host_side = os.open(self._name, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        self._own_events = [Event.CLOSED, Event.OPENED]
        if is_locked and has_host:
            fcntl.ioctl(self.host_side, termios.TIOCEXCL)
        return has_host


def _mark_all_left(change: Change) -> Change:
    """Return a change after which all hosts have left; all writes so far are theirs."""
    return Change(True, change.old_writes + change.new_writes, 0)


def _apply_events(n_hosts: int, change: Change, events: list[Event]) -> tuple[int, Change]:
    """Return the number of hosts and the change after further events."""
    for event in events:
        if event is Event.OPENED:
            n_hosts += 1
        elif event is Event.WRITTEN:
            n_old, n_new = (0, 1) if change.hosts_left else (1, 0)
            change = Change(change.hosts_left, change.old_writes + n_old, change.new_writes + n_new)
        elif n_hosts <= 1:
            n_hosts, change = 0, _mark_all_left(change)
        else:
            n_hosts -= 1
    return n_hosts, change
