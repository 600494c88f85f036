"""Sources that wake the serving loop besides bytes: exact time-outs, and hosts that open or close a terminal.

Both are of the Linux kernel. Where the system lacks the one, time-outs end 0.05 ms later; where it lacks
inotify, which Python has no functions for, there is no `OpenEvents`.
"""

import ctypes
import os
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path

from khep_twin.machine import flags

_FLAGS = flags("O_NONBLOCK", "O_CLOEXEC")

_IN_MODIFY, _IN_CLOSE_WRITE, _IN_CLOSE_NOWRITE, _IN_OPEN, _IN_Q_OVERFLOW = 0x02, 0x08, 0x10, 0x20, 0x4000
_IN_CLOSE = _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE
_HEAD = struct.Struct("iIII")
_BUFFER = 448
_FULL = _BUFFER - _HEAD.size - 256
"""Bytes of events above which more may wait: one with a name of 255 bytes may not have fitted."""


def exact_timeouts() -> None:
    """Have this thread's time-outs end when they are due, not 0.05 ms later, as the kernel's default is."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1")


class Event(Enum):
    """Act of a host on a terminal."""

    OPENED = auto()
    WRITTEN = auto()
    CLOSED = auto()


ONE_WRITE = (Event.WRITTEN,)
"""One run of writes, which is what most polls find."""


class OpenEvents:
    """Event source for one terminal.

    The terminal's directory is watched beside the terminal: its events stand between two equal ones of the
    terminal, which the kernel would merge. Those of two processors at the same moment may still be merged.

    Attributes:
        descriptor: Descriptor for `select`, readable when there are events.
    """

    def __init__(self, descriptor: int, watch: int) -> None:
        self.descriptor = descriptor
        self._watch = watch
        self._one_write = _HEAD.pack(watch, _IN_MODIFY, 0, 0)

    def drain(self) -> Sequence[Event]:
        """Return the events since the last call, the oldest first."""
        data = self._read()
        if data == self._one_write:
            return ONE_WRITE
        found: list[Event] = []
        while data:
            place = 0
            while place < len(data):
                watch, kind, _, name_size = _HEAD.unpack_from(data, place)
                place += _HEAD.size + name_size
                if watch == self._watch or kind & _IN_Q_OVERFLOW:
                    found.append(_event(kind))
            data = self._read() if len(data) > _FULL else b""
        return found

    def close(self) -> None:
        """Release the descriptor."""
        os.close(self.descriptor)

    def _read(self) -> bytes:
        try:
            return os.read(self.descriptor, _BUFFER)
        except BlockingIOError:
            return b""


def open_events(path: str) -> OpenEvents | None:
    """Return an event source for the terminal at `path`; None where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "inotify_init1"):
        return None
    descriptor = int(libc.inotify_init1(_FLAGS))
    if descriptor < 0:
        return None
    opens = _IN_OPEN | _IN_CLOSE
    watch = int(libc.inotify_add_watch(descriptor, path.encode(), opens | _IN_MODIFY))
    if watch < 0 or libc.inotify_add_watch(descriptor, os.path.dirname(path).encode(), opens) < 0:
        os.close(descriptor)
        return None
    return OpenEvents(descriptor, watch)


def _event(kind: int) -> Event:
    if kind & _IN_OPEN:
        return Event.OPENED
    # Of events that were lost, a closing is the one that must be looked into.
    return Event.WRITTEN if kind & _IN_MODIFY else Event.CLOSED
