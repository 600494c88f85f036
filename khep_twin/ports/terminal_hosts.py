"""Hosts that hold a pseudo-terminal open, as the kernel reports them.

A terminal whose host side is closed everywhere reports a hang-up, which is decisive. inotify reports when
to check, and in which order hosts opened, wrote and closed; it merges equal consecutive events, so its
counts alone are not reliable. Where the system has no inotify, the terminal is checked on each poll.

One descriptor of the host side is kept open here, so that leftover settings and locks can be removed. It is
closed during a check.
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
"""Checks of the terminal per poll before the rest is left to the next one."""

_CLOSING_S = 1.0
"""Longest duration of a closing (assumed) [s]."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)
"""Request for the state of a terminal's lock, which Python 3.11 does not name; the number is Linux's."""


_NONE, _ONE_WRITE = Change(), Change(writes_before=1)


class TerminalHosts:
    """Hosts on the host side of a terminal.

    Args:
        terminal: Descriptor of this side.
        kept: Descriptor of the host side, which passes to this object.
        events: Event source; None where the system has none.

    Attributes:
        hosts: Number of descriptors that hosts have open, at least; 0 only if there is none.
        host_side: Descriptor of the host side that is kept open here.
    """

    def __init__(self, terminal: int, kept: int, events: OpenEvents | None) -> None:
        self.hosts = 0
        self.host_side = kept
        self._name = os.ttyname(kept)
        self._events = events
        self._own: list[Event] = []
        self._later: list[Event] = []
        self._ask_until: float | None = None
        self._crowded = False  # several hosts were here at once since the terminal was free
        self._poll = select.poll()
        self._poll.register(terminal, 0)

    @property
    def descriptors(self) -> Sequence[int]:
        """Descriptor for `select` that becomes readable when hosts come, write or go; none without events."""
        return [] if self._events is None else [self._events.descriptor]

    def poll(self, wrote: bool) -> Change:
        """Return the changes since the last poll; `wrote` if bytes of a host were read since then."""
        if self._events is None:
            left = not (held := self._held()) and (wrote or self.hosts > 0)
            self.hosts = int(held)
            return Change(left)
        drained = self._drain(self._events)
        is_steady = self.hosts and not self._later and self._ask_until is None
        if is_steady and (not drained or drained is ONE_WRITE):
            self._crowded |= self.hosts > 1
            return _ONE_WRITE if drained else _NONE
        events = [*self._later, *drained]
        if wrote and not self.hosts and Event.OPENED not in events:
            # An event was lost; a check corrects this.
            events.append(Event.CLOSED)
        hosts, change, seen = self.hosts, Change(), list[Event]()
        for _ in range(_ROUNDS):
            seen += events
            if Event.CLOSED not in events:
                events = []
                break
            held, events = self._held(), [*self._drain(self._events)]
            if not held:
                change = _followed(hosts, change, seen)[1]
                hosts, change, seen, self._crowded = 0, _gone(change), [], False
        self._later = events
        n_followed, after = _followed(hosts, change, seen)
        ask_until, self._ask_until = self._ask_until, None
        # The kernel reports a host after the last closing.
        if Event.CLOSED in seen and n_followed == 0:
            # It reports a closing before it is complete, so check again; or events were merged.
            self._ask_until = ask_until or time.monotonic() + _CLOSING_S
            if time.monotonic() < self._ask_until:
                self._later = seen + self._later
                self.hosts = max(hosts, 1)
                return change
        self._crowded |= max(hosts, n_followed, seen.count(Event.OPENED)) > 1
        # One host after another is accepted as reported: more may happen in the milliseconds of a count.
        if Event.CLOSED in seen and (n_followed == 0 or (self._crowded and Event.OPENED in seen)):
            n_open = count_descriptors(self._name) - 1 or max(n_followed, 1)
            self._later += self._drain(self._events)
            if n_followed == 0 or not self._later:
                n_followed, after = _followed(hosts + n_open - n_followed, change, seen)
        self.hosts = max(n_followed, 1) if Event.CLOSED in seen else n_followed
        return after

    def is_quiet(self) -> bool:
        """Return whether no host has connected, written or left since the last poll."""
        if self._events is None:
            return self.hosts == int(self._held())
        # Other terminals of the directory have events, too.
        self._later += self._drain(self._events)
        return not self._later

    def recount(self) -> int:
        """Count the hosts anew, as events that the kernel merged are missed; return their number, at least 1.

        Descriptors of other users' processes cannot be seen.
        """
        self.hosts = max(count_descriptors(self._name) - 1, 1)
        return self.hosts

    def close(self) -> None:
        """Release the host side and the event source."""
        os.close(self.host_side)
        if self._events is not None:
            self._events.close()

    def _drain(self, events: OpenEvents) -> Sequence[Event]:
        """Return what hosts did since the last call, in order, without the events of `_held`."""
        if not self._own:
            return events.drain()
        found = [*events.drain()]
        # The descriptor kept here was closed, then opened; a host may have opened another just before.
        start = 0
        for own in self._own:
            if own in found[start:]:
                start = found.index(own, start)
                del found[start]
        self._own = []
        return found

    def _held(self) -> bool:
        """Return whether a host holds the terminal: without one, closing our descriptor causes a hang-up."""
        locked = any(fcntl.ioctl(self.host_side, _TIOCGEXCL, bytes(4)))
        if locked:
            # A lock would keep this process out, too.
            fcntl.ioctl(self.host_side, termios.TIOCNXCL)
        os.close(self.host_side)
        held = not any(state & select.POLLHUP for _, state in self._poll.poll(0))
        self.host_side = os.open(self._name, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        self._own = [Event.CLOSED, Event.OPENED]
        if locked and held:
            fcntl.ioctl(self.host_side, termios.TIOCEXCL)
        return held


def _gone(change: Change) -> Change:
    """Return a change after which all hosts have left: what was written so far is theirs."""
    return Change(True, change.writes_before + change.writes, 0)


def _followed(hosts: int, change: Change, events: list[Event]) -> tuple[int, Change]:
    """Return the number of hosts and the change after some more events."""
    for event in events:
        if event is Event.OPENED:
            hosts += 1
        elif event is Event.WRITTEN:
            n_before, n_after = (0, 1) if change.left else (1, 0)
            change = Change(change.left, change.writes_before + n_before, change.writes + n_after)
        elif hosts <= 1:
            hosts, change = 0, _gone(change)
        else:
            hosts -= 1
    return hosts, change
