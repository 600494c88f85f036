"""Sources that wake the serving loop besides bytes: exact time-outs, and hosts that open or close a terminal.

Both are interfaces of the Linux kernel: timer slack, without which time-outs end 0.05 ms later, and inotify,
which reports the use of files; without it, `open_events` returns None.
"""

import ctypes
import os
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path

from khep_twin.process.machine import flags

_INOTIFY_FLAGS = flags("O_NONBLOCK", "O_CLOEXEC")

_IN_MODIFY, _IN_CLOSE_WRITE, _IN_CLOSE_NOWRITE, _IN_OPEN, _IN_Q_OVERFLOW = 0x02, 0x08, 0x10, 0x20, 0x4000
_IN_CLOSE = _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE
_EVENT_HEADER = struct.Struct("iIII")
_BUFFER_SIZE = 448
_MORE_PENDING_SIZE = _BUFFER_SIZE - _EVENT_HEADER.size - 256
"""Bytes of events above which more may be pending: an event with a name of 255 bytes may not have fitted."""


def set_exact_timeouts() -> None:
    """End this thread's time-outs when they are due, not 0.05 ms later as by the kernel's default."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1")


class Event(Enum):
    """Action of a host on a terminal."""

    OPENED = auto()
    WRITTEN = auto()
    CLOSED = auto()


ONE_WRITE = (Event.WRITTEN,)
"""One run of writes, the result of most polls."""


class OpenEvents:
    """Event source for one terminal.

    The kernel merges equal consecutive events. The terminal's directory is therefore also watched: its events
    separate equal ones of the terminal. Simultaneous events on two processors may still be merged.

    Attributes:
        descriptor: Descriptor for `select`, readable when there are events.
    """

    def __init__(self, descriptor: int, watch: int) -> None:
        self.descriptor = descriptor
        self._watch = watch
        self._one_write = _EVENT_HEADER.pack(watch, _IN_MODIFY, 0, 0)

    def drain(self) -> Sequence[Event]:
        """Return the events since the last call, the oldest first."""
        data = self._read()
        if data == self._one_write:
            return ONE_WRITE
        events: list[Event] = []
        while data:
            offset = 0
            while offset < len(data):
                watch, mask, _, name_size = _EVENT_HEADER.unpack_from(data, offset)
                offset += _EVENT_HEADER.size + name_size
                if watch == self._watch or mask & _IN_Q_OVERFLOW:
                    events.append(_event_of(mask))
            data = self._read() if len(data) > _MORE_PENDING_SIZE else b""
        return events

    def close(self) -> None:
        """Release the descriptor."""
        os.close(self.descriptor)

    def _read(self) -> bytes:
        try:
            return os.read(self.descriptor, _BUFFER_SIZE)
        except BlockingIOError:
            return b""


def open_events(path: str) -> OpenEvents | None:
    """Return an event source for the terminal at `path`; None where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "inotify_init1"):
        return None
    descriptor = int(libc.inotify_init1(_INOTIFY_FLAGS))
    if descriptor < 0:
        return None
    open_mask = _IN_OPEN | _IN_CLOSE
    watch = int(libc.inotify_add_watch(descriptor, path.encode(), open_mask | _IN_MODIFY))
    if watch < 0 or libc.inotify_add_watch(descriptor, os.path.dirname(path).encode(), open_mask) < 0:
        os.close(descriptor)
        return None
    return OpenEvents(descriptor, watch)


def _event_of(mask: int) -> Event:
    """Return the event of an inotify mask."""
    if mask & _IN_OPEN:
        return Event.OPENED
    # Lost events are treated as a closing, which must be checked.
    return Event.WRITTEN if mask & _IN_MODIFY else Event.CLOSED
