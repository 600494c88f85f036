"""What wakes the serving loop besides bytes: a timer, and hosts that open and close a terminal.

Both are descriptors of the Linux kernel that Python 3.11 has no functions for; where the system lacks them,
they are None and the loop does without: it sleeps by `select`, some 0.1 ms less exactly, and looks from
time to time whether a host has hung up.
"""

import ctypes
import os
import select
import struct
from contextlib import suppress
from typing import Protocol

from khep_twin.clock import NS_PER_S

_IN_OPEN, _IN_CLOSE_WRITE, _IN_CLOSE_NOWRITE = 0x20, 0x08, 0x10
_EVENT = struct.Struct("iIII")
_CLOCK_MONOTONIC, _TFD_TIMER_ABSTIME = 1, 1
_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC

_ONE_HOST: dict[tuple[int, ...], int] = {(0, True): 1, (1, False): 0, (0, True, False): 0}
"""How many hosts there are after what happens to one alone: hosts before, then openings and closings."""


class Watch(Protocol):
    """Tells of hosts that open and close a terminal, even when they are killed.

    Attributes:
        descriptor: for `select`; None for one that has to be asked.
        hosts: how many processes have it open, as far as can be known.
    """

    descriptor: int | None
    hosts: int

    def look(self) -> tuple[bool, bool]:
        """Whether the last host has left since the last look, and whether another came in that moment."""
        ...

    def pending(self) -> bool:
        """Whether something has happened since the last look."""
        ...

    def close(self) -> None:
        """Gives it back."""
        ...


def watch(path: str, own: int) -> Watch | None:
    """A watch that wakes, None where the system has none to give.

    Args:
        path: of the terminal.
        own: how often it is open here, for other purposes.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    made = int(libc.inotify_init1(_FLAGS)) if hasattr(libc, "inotify_init1") else -1
    if made < 0:
        return None
    if libc.inotify_add_watch(made, path.encode(), _IN_OPEN | _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE) < 0:
        os.close(made)
        return None
    return _Inotify(made, path, own)


class HangUps:
    """A `Watch` that asks the terminal itself: when nobody has its other side open, it is hung up.

    It needs a terminal that is not kept open here, and that was open once. A host that comes and goes between
    two looks is noticed by what it has sent; one of several hosts that goes is not.

    Args:
        terminal: this side of it.
    """

    descriptor: int | None = None

    def __init__(self, terminal: int) -> None:
        self.hosts = 0
        self._poll = select.poll()
        self._poll.register(terminal, select.POLLIN)

    def look(self) -> tuple[bool, bool]:
        """Whether the host has left since the last look; who came in that moment cannot be known."""
        before, state = self.hosts, self._state()
        self.hosts = 0 if state & select.POLLHUP else 1
        return self.hosts == 0 and bool(before or state & select.POLLIN), False

    def pending(self) -> bool:
        """Whether a host is there by now."""
        return not self._state() & select.POLLHUP

    def close(self) -> None:
        """There is nothing to give back."""

    def _state(self) -> int:
        return next((state for _, state in self._poll.poll(0)), 0)


class _Inotify:
    """A `Watch` by the kernel's own messages."""

    def __init__(self, descriptor: int, path: str, own: int) -> None:
        self.descriptor: int | None = descriptor
        self.hosts = 0
        self._path, self._own = path, own

    def look(self) -> tuple[bool, bool]:
        """Whether the last host has left since the last look, and whether another came in that moment."""
        before = self.hosts
        opened: list[bool] = []
        while news := self._news():
            opened += news
            # Two events alike become one when they come close together, so that beyond one host that comes
            # or goes they cannot be counted. While holders are looked for, more may come.
            plain = _ONE_HOST.get((before, *opened))
            self.hosts = _n_holders(self._path, self._own) if plain is None else plain
        closed = not all(opened)
        in_a_moment = closed and before <= 1 and self.hosts > 0 and any(opened[opened.index(False) :])
        return closed and self.hosts == 0, in_a_moment

    def pending(self) -> bool:
        """Whether something has happened since the last look."""
        return self.descriptor is not None and bool(select.select([self.descriptor], [], [], 0)[0])

    def _news(self) -> list[bool]:
        """What has happened, in order: True for an opening, False for a closing."""
        if self.descriptor is None:
            return []
        try:
            events = os.read(self.descriptor, 65536)
        except BlockingIOError:
            return []
        kinds = [_EVENT.unpack_from(events, place)[1] for place in range(0, len(events), _EVENT.size)]
        return [bool(kind & _IN_OPEN) for kind in kinds]

    def close(self) -> None:
        """Gives it back."""
        if self.descriptor is not None:
            os.close(self.descriptor)
            self.descriptor = None


class _TimerSpec(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in ("every_s", "every_ns", "first_s", "first_ns")]


class Timer:
    """Becomes readable at a time of the wall clock (CLOCK_MONOTONIC).

    Attributes:
        descriptor: for `select`; None where the system has no such timers.
    """

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.descriptor: int | None = None
        if hasattr(self._libc, "timerfd_create"):
            made = self._libc.timerfd_create(_CLOCK_MONOTONIC, _FLAGS)
            self.descriptor = made if made >= 0 else None

    def set(self, wall_ns: int) -> None:
        """Wakes at this time [ns]; a time that is over wakes at once."""
        if self.descriptor is not None:
            spec = _TimerSpec(0, 0, *divmod(max(wall_ns, 1), NS_PER_S))
            self._libc.timerfd_settime(self.descriptor, _TFD_TIMER_ABSTIME, ctypes.byref(spec), None)

    def clear(self) -> None:
        """Makes it unreadable again."""
        if self.descriptor is not None:
            with suppress(BlockingIOError):
                os.read(self.descriptor, 8)

    def close(self) -> None:
        """Gives it back."""
        if self.descriptor is not None:
            os.close(self.descriptor)
            self.descriptor = None


def _n_holders(path: str, own: int) -> int:
    """How many of this machine's processes have a file open, as far as /proc shows them.

    Args:
        path: of the file.
        own: how often this process has it open without being a host.
    """
    count = 0
    for process in os.listdir("/proc"):
        if process.isdigit():
            found = -own if int(process) == os.getpid() else 0
            folder = f"/proc/{process}/fd"
            # Processes end while they are looked at, and those of others are closed to us.
            with suppress(OSError):
                for descriptor in os.listdir(folder):
                    with suppress(OSError):
                        found += os.readlink(f"{folder}/{descriptor}") == path
            count += found > 0
    return count
