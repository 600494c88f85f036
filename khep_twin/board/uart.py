"""The serial line in simulated time: when each byte has crossed it, in either direction.

A byte takes eleven bit times. Of a burst that starts at t0, byte k (counted from 1) has arrived at
t0 + k * 11 * 10^9 // baud; a burst that finds the line busy starts when the line is free.
"""

from bisect import bisect_right
from dataclasses import dataclass
from enum import IntEnum

from khep_twin.clock import NS_PER_S
from khep_twin.units import BITS_PER_BYTE

QUEUE_LIMIT = 1024
"""Bytes that wait on the way to the robot before the line pushes back (assumed; the manual gives none)."""

_BYTE_BITS_NS = BITS_PER_BYTE * NS_PER_S


@dataclass(frozen=True, slots=True)
class LineSettings:
    """How a host has set its end of the line, as far as that can be seen.

    Attributes:
        baud: bits per second; 0 for a line hung up.
        stop_bits: 1 or 2.
    """

    baud: int
    stop_bits: int


class Act(IntEnum):
    """What a host does to the line, and a hand to the robot and its world."""

    SEND = 0
    HANG_UP = 1
    TAKE_BACK = 2
    SET = 3
    PUT = 4
    SWITCH = 5
    SCAN = 6
    RELIGHT = 7


@dataclass(frozen=True, slots=True)
class HostAct:
    """One thing that a host did to its robot's line: with the same ones, a run can be repeated.

    Attributes:
        kind: what it was.
        at_ns: from when on it holds, now or later [ns].
        host: how the host had set its end of the line, None for as the robot has it.
        data: what was sent, as it left the host; where the robot was put, as `khep_twin.placing` has it;
            which lamp was switched, or which lamps there are, as `khep_twin.switching` has it.
    """

    kind: Act
    at_ns: int
    host: LineSettings | None = None
    data: bytes = b""


class Line:
    """One direction of the line.

    Attributes:
        baud: bits per second; 0 for a line that takes no time.
        next_ns: when the oldest byte under way arrives [ns], None when the line is empty.
    """

    def __init__(self, baud: int) -> None:
        self.baud = baud
        self.next_ns: int | None = None
        self._bytes = bytearray()
        self._arrivals: list[int] = []
        self._free_ns = 0

    def __len__(self) -> int:
        return len(self._bytes)

    @property
    def byte_ns(self) -> int:
        """Time that one byte takes [ns]."""
        return _BYTE_BITS_NS // self.baud if self.baud else 0

    def put(self, data: bytes, time_ns: int) -> int:
        """Sends `data`, at `time_ns` or as soon as the line is free; returns when its last byte arrives."""
        start_ns = max(time_ns, self._free_ns)
        baud = self.baud
        if data:
            counts = range(1, len(data) + 1)
            self._arrivals += [start_ns + (k * _BYTE_BITS_NS // baud if baud else 0) for k in counts]
            self._bytes += data
            self._free_ns = self._arrivals[-1]
            self.next_ns = self._arrivals[0]
        return self._free_ns

    def arrived(self, time_ns: int) -> int:
        """How many bytes have arrived by `time_ns`."""
        return bisect_right(self._arrivals, time_ns)

    def arrival(self, count: int) -> int | None:
        """When the `count`-th byte under way arrives [ns], None if there are fewer."""
        return self._arrivals[count - 1] if 0 < count <= len(self._arrivals) else None

    def count_to(self, *wanted: int) -> int | None:
        """How many bytes it is up to and with the first of these under way, None if there is none."""
        places = [place for byte in wanted if (place := self._bytes.find(byte)) >= 0]
        return min(places) + 1 if places else None

    def count_to_end_of(self, text: bytes) -> int | None:
        """Return how many bytes under way end with the first `text`, None if it is not there."""
        place = self._bytes.find(text) if text else -1
        return place + len(text) if place >= 0 else None

    def read(self, time_ns: int, limit: int | None = None) -> bytes:
        """Takes what has arrived by `time_ns`, at most `limit` bytes."""
        count = self.arrived(time_ns)
        count = count if limit is None else min(count, limit)
        data = bytes(self._bytes[:count])
        del self._bytes[:count], self._arrivals[:count]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        return data

    def take_back(self, time_ns: int) -> None:
        """Drops what has not arrived by `time_ns`; the line is free then."""
        count = self.arrived(time_ns)
        del self._bytes[count:], self._arrivals[count:]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        self._free_ns = min(self._free_ns, time_ns)


class Uart:
    """Both directions, named as the robot sees them."""

    def __init__(self, baud: int) -> None:
        self.rx = Line(baud)
        self.tx = Line(baud)

    @property
    def room(self) -> int:
        """Number of bytes that the host may send before the line pushes back.

        A host that comes as another leaves may have sent more already, so that there is less than none.
        """
        return max(QUEUE_LIMIT - len(self.rx), 0)
