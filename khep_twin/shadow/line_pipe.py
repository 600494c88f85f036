"""Pipe by which a line's bytes reach a shadow in another process, without any delay of the line.

Bytes that the pipe does not take immediately wait in memory, at most 1 kB/s of a line at 9600 baud, so none
are lost. A record without bytes states that none came until its time.
"""

import os
import select
import struct
import sys
import time
from collections.abc import Callable, Iterator

from khep_twin.shadow.recording import LineChunk

_CLOCK_START = struct.Struct("<q")
"""Start of the line's clock by `time.monotonic_ns`, which all processes of a machine share."""

_RECORD = struct.Struct("<q?H")
"""Time [ns], direction, and number of bytes that follow."""

_MAX_RECORD = 1 << 15

_POLL_S = 0.2
"""Longest wait for bytes between two calls of `stop` [s]."""


class LineSender:
    """End of the pipe at the line, whose clock starts at 0 [ns]; the descriptor stays open.

    Attributes:
        is_broken: Whether the reader has closed the pipe.
    """

    def __init__(self, descriptor: int, now: Callable[[], int]) -> None:
        self._descriptor = descriptor
        self._now = now
        self._buffer = bytearray(_CLOCK_START.pack(time.monotonic_ns() - now()))
        self.is_broken = False
        _set_blocking(descriptor, False)

    def on_bytes(self, to_robot: bool, data: bytes) -> None:
        """Send bytes that cross the line now."""
        for start in range(0, len(data), _MAX_RECORD):
            piece = data[start : start + _MAX_RECORD]
            self._buffer += _RECORD.pack(self._now(), to_robot, len(piece)) + piece
        self._write()

    def on_event(self, text: str) -> None:
        """Ignore an event: only logs record it."""

    def flush(self) -> None:
        """Send that no more bytes came until now."""
        self._buffer += _RECORD.pack(self._now(), True, 0)
        self._write()

    def close(self) -> None:
        """Send all waiting bytes, as fast as they are read."""
        _set_blocking(self._descriptor, True)
        while self._buffer and not self.is_broken:
            self._write()

    def _write(self) -> None:
        if self.is_broken:
            self._buffer.clear()
            return
        try:
            del self._buffer[: os.write(self._descriptor, self._buffer)]
        except BlockingIOError:
            pass
        except (BrokenPipeError, ConnectionResetError):
            self.is_broken = True


class LineReceiver:
    """End of the pipe at the shadow."""

    def __init__(self, descriptor: int, stop: Callable[[], bool]) -> None:
        self._descriptor = descriptor
        self._stop = stop
        self._start_ns = 0
        self._buffer = bytearray()

    def __iter__(self) -> Iterator[LineChunk]:
        """Yield the bytes of the line until it is closed."""
        if not self._fill(_CLOCK_START.size):
            return
        (self._start_ns,) = _CLOCK_START.unpack(self._take(_CLOCK_START.size))
        while self._fill(_RECORD.size):
            time_ns, to_robot, size = _RECORD.unpack(self._take(_RECORD.size))
            if not self._fill(size):
                return
            yield LineChunk(time_ns, to_robot, self._take(size))

    def lag_s(self, time_ns: int) -> float:
        """Return how far a time of the line is in the past [s]."""
        return (time.monotonic_ns() - self._start_ns - time_ns) * 1e-9

    def _fill(self, size: int) -> bool:
        """Wait for a number of bytes; return whether they have come."""
        while len(self._buffer) < size:
            if self._stop():
                return False
            if select.select([self._descriptor], [], [], _POLL_S)[0]:
                if not (read := os.read(self._descriptor, 1 << 16)):
                    return False
                self._buffer += read
        return True

    def _take(self, size: int) -> bytes:
        head = bytes(self._buffer[:size])
        del self._buffer[:size]
        return head


def _set_blocking(descriptor: int, blocks: bool) -> None:
    """Set whether a write waits for room; Windows does not support this for pipes."""
    if sys.platform != "win32":
        os.set_blocking(descriptor, blocks)
