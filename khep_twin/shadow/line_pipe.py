"""Pipe by which a line's bytes reach a shadow in another process, and which never delays the line.

What the pipe does not take at once waits in memory, at most the 1 kB/s of a line at 9600 baud, so nothing is
lost. Records without bytes tell that none came until their time.
"""

import os
import select
import struct
import sys
import time
from collections.abc import Callable, Iterator

from khep_twin.shadow.recording import Heard

_START = struct.Struct("<q")
"""Start of the line's clock, in that of `time.monotonic_ns`, which all processes of a machine share."""

_RECORD = struct.Struct("<q?H")
"""Time [ns], direction, and number of bytes that follow."""

_LARGEST = 1 << 15

_TURN_S = 0.2
"""Longest wait for bytes, before `stop` is asked again [s]."""


class LineSender:
    """End of the pipe at the line, whose clock starts at 0 [ns]; the descriptor stays open.

    Attributes:
        broken: Whether nobody reads any more.
    """

    def __init__(self, descriptor: int, now: Callable[[], int]) -> None:
        self._descriptor, self._now = descriptor, now
        self._waiting = bytearray(_START.pack(time.monotonic_ns() - now()))
        self.broken = False
        _set_blocking(descriptor, False)

    def on_bytes(self, to_robot: bool, data: bytes) -> None:
        """Take bytes that cross the line now."""
        for begin in range(0, len(data), _LARGEST):
            piece = data[begin : begin + _LARGEST]
            self._waiting += _RECORD.pack(self._now(), to_robot, len(piece)) + piece
        self._write()

    def on_event(self, text: str) -> None:
        """Leave an event to the log."""

    def flush(self) -> None:
        """Tell that nothing more came until now."""
        self._waiting += _RECORD.pack(self._now(), True, 0)
        self._write()

    def close(self) -> None:
        """Pass on what waits, as fast as it is read."""
        _set_blocking(self._descriptor, True)
        while self._waiting and not self.broken:
            self._write()

    def _write(self) -> None:
        if self.broken:
            self._waiting.clear()
            return
        try:
            del self._waiting[: os.write(self._descriptor, self._waiting)]
        except BlockingIOError:
            pass
        except (BrokenPipeError, ConnectionResetError):
            self.broken = True


class LineReceiver:
    """End of the pipe at the shadow."""

    def __init__(self, descriptor: int, stop: Callable[[], bool]) -> None:
        self._descriptor, self._stop = descriptor, stop
        self._start_ns = 0
        self._waiting = bytearray()

    def __iter__(self) -> Iterator[Heard]:
        """Yield what crosses the line, until it is closed."""
        if not self._fill(_START.size):
            return
        (self._start_ns,) = _START.unpack(self._taken(_START.size))
        while self._fill(_RECORD.size):
            time_ns, to_robot, size = _RECORD.unpack(self._taken(_RECORD.size))
            if not self._fill(size):
                return
            yield Heard(time_ns, to_robot, self._taken(size))

    def behind_s(self, time_ns: int) -> float:
        """Return by how much a time of the line is past [s]."""
        return (time.monotonic_ns() - self._start_ns - time_ns) * 1e-9

    def _fill(self, size: int) -> bool:
        """Wait for bytes; return whether there are so many."""
        while len(self._waiting) < size:
            if self._stop():
                return False
            if select.select([self._descriptor], [], [], _TURN_S)[0]:
                if not (read := os.read(self._descriptor, 1 << 16)):
                    return False
                self._waiting += read
        return True

    def _taken(self, size: int) -> bytes:
        taken = bytes(self._waiting[:size])
        del self._waiting[:size]
        return taken


def _set_blocking(descriptor: int, blocks: bool) -> None:
    """Set if a write waits for room; Windows has no such pipes."""
    if sys.platform != "win32":
        os.set_blocking(descriptor, blocks)
