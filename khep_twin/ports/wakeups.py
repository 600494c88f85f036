"""What wakes the serving loop besides bytes: a timer, and hosts that open and close a terminal.

Both are descriptors of the Linux kernel that Python 3.11 has no functions for; where the system lacks them,
they are None and the loop does without: it sleeps by `select`, which is some 0.1 ms less exact, and learns
nothing of hosts that come and go.
"""

import ctypes
import os
import select
import struct
from contextlib import suppress

from khep_twin.clock import NS_PER_S

_IN_OPEN, _IN_CLOSE_WRITE, _IN_CLOSE_NOWRITE = 0x20, 0x08, 0x10
_EVENT = struct.Struct("iIII")
_CLOCK_MONOTONIC, _TFD_TIMER_ABSTIME = 1, 1
_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC

_ONE_HOST: dict[tuple[int, ...], int] = {(0, True): 1, (1, False): 0, (0, True, False): 0}
"""How many hosts there are after what happens to one alone: hosts before, then openings and closings."""


class Watch:
    """Tells of hosts that open and close a terminal, even when they are killed.

    Args:
        path: of the terminal.
        own: how often it is open here, for other purposes.

    Attributes:
        descriptor: for `select`; None where the system has no such watch.
        hosts: how many processes have it open.
    """

    def __init__(self, path: str, own: int) -> None:
        self.descriptor: int | None = None
        self.hosts = 0
        self._path, self._own = path, own
        libc = ctypes.CDLL(None, use_errno=True)
        if hasattr(libc, "inotify_init1"):
            made = int(libc.inotify_init1(_FLAGS))
            mask = _IN_OPEN | _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE
            if made >= 0 and libc.inotify_add_watch(made, path.encode(), mask) >= 0:
                self.descriptor = made
            elif made >= 0:
                os.close(made)

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
