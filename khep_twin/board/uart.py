"""The serial line in simulated time: arrival of each byte, in either direction.

A byte takes eleven bit times. Byte k (counted from 1) of a burst that starts at t0 arrives at
t0 + k * 11 * 10^9 // baud; a burst that finds the line busy starts when the line is free.
"""

import re
from bisect import bisect_right
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Annotated, NamedTuple

from pydantic import Base64UrlBytes, Field

from khep_twin.clock import NS_PER_S
from khep_twin.units import BITS_PER_BYTE

QUEUE_LIMIT = 1024
"""Bytes queued for the robot before flow control stops the host (assumed; the manual gives none)."""

_BYTE_BITS_NS = BITS_PER_BYTE * NS_PER_S


@dataclass(frozen=True, slots=True)
class LineSettings:
    """A host's settings of its end of the line, as far as they are known.

    Attributes:
        baud: Bits per second; 0 for a disconnected line.
        stop_bits: Stop bits, 1 or 2.
    """

    baud: int
    stop_bits: int


class HostEventKind(IntEnum):
    """Actions of a host on the line, and of a user on the robot and its world."""

    SEND = 0
    DISCONNECT = 1
    FLUSH = 2
    SET = 3
    PUT = 4
    SWITCH = 5
    SCAN = 6
    SET_LAMPS = 7
    NOTE = 8


class HostEvent(NamedTuple):
    """One action on a robot's line; the same actions repeat a run.

    Attributes:
        kind: Kind of action.
        at_ns: Time of effect, now or later [ns].
        host: Settings of the host's end of the line; None for the robot's own.
        data: Bytes as the host sent them; new pose of the robot, switched lamp or new lamps, encoded by
            `khep_twin.interventions`; text of an event, after a byte that is 1 if it is about no robot.
    """

    kind: HostEventKind
    at_ns: int
    host: LineSettings | None = None
    data: bytes = b""


class LineState(NamedTuple):
    """State of one direction of the line.

    Attributes:
        baud: Bits per second; 0 for a line without delay.
        data: Bytes in transit, and those that no one has read.
        arrivals: Arrival of each of them [ns].
        free_ns: Time from which on the line is free [ns].
    """

    baud: Annotated[int, Field(ge=0, le=10**9)]
    data: Base64UrlBytes
    arrivals: tuple[Annotated[int, Field(ge=0, lt=2**62)], ...]
    free_ns: Annotated[int, Field(ge=0, lt=2**62)]


class SerialLine:
    """One direction of the line.

    Attributes:
        baud: Bits per second; 0 for a line without delay.
        next_ns: Arrival of the oldest byte in transit [ns]; None if the line is empty.
    """

    def __init__(self, baud: int) -> None:
        self.baud = baud
        self.next_ns: int | None = None
        self._bytes = bytearray()
        self._arrivals: list[int] = []
        self._free_ns = 0

    def __len__(self) -> int:
        return len(self._bytes)

    def state(self, since_ns: int = -1) -> LineState:
        """Return the state, with the bytes that arrive after a time [ns]."""
        first = self.arrived(since_ns)
        arrivals = tuple(self._arrivals[first:])
        return LineState(self.baud, bytes(self._bytes[first:]), arrivals, self._free_ns)

    def set_state(self, state: LineState) -> None:
        """Take over a state.

        Raises:
            ValueError: Its bytes do not arrive one after the other.
        """
        arrivals = list(state.arrivals)
        if len(arrivals) != len(state.data) or arrivals != sorted(arrivals):
            raise ValueError(
                f"{len(arrivals)} arrivals of {len(state.data)} bytes; expected one each, rising"
            )
        self.baud, self._free_ns = state.baud, state.free_ns
        self._bytes, self._arrivals = bytearray(state.data), arrivals
        self.next_ns = arrivals[0] if arrivals else None

    @property
    def byte_ns(self) -> int:
        """Duration of one byte [ns]."""
        return _BYTE_BITS_NS // self.baud if self.baud else 0

    def put(self, data: bytes, time_ns: int) -> int:
        """Send `data` at `time_ns` or once the line is free; return the arrival of its last byte [ns]."""
        if data:
            start_ns = max(time_ns, self._free_ns)
            self._arrivals += [start_ns + end_ns for end_ns in _byte_ends_ns(self.baud, len(data))]
            self._bytes += data
            self._free_ns = self._arrivals[-1]
            self.next_ns = self._arrivals[0]
        return self._free_ns

    def arrived(self, time_ns: int) -> int:
        """Return the number of bytes that have arrived by `time_ns`."""
        return bisect_right(self._arrivals, time_ns)

    def arrival(self, count: int) -> int | None:
        """Return the arrival of the `count`-th byte in transit [ns], None if there are fewer."""
        return self._arrivals[count - 1] if 0 < count <= len(self._arrivals) else None

    def count_to(self, wanted: re.Pattern[bytes]) -> int | None:
        """Return the number of bytes in transit up to the end of the first match; None without one."""
        found = wanted.search(self._bytes)
        return found and found.end()

    def count_to_end_of(self, text: bytes) -> int | None:
        """Return the number of bytes in transit up to the end of the first `text`, None if it is absent."""
        place = self._bytes.find(text) if text else -1
        return place + len(text) if place >= 0 else None

    def read(self, time_ns: int, limit: int | None = None) -> bytes:
        """Remove and return the bytes that have arrived by `time_ns`, at most `limit`."""
        count = self.arrived(time_ns)
        count = count if limit is None else min(count, limit)
        data = bytes(self._bytes[:count])
        del self._bytes[:count], self._arrivals[:count]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        return data

    def flush(self, time_ns: int) -> None:
        """Drop the bytes that have not arrived by `time_ns`; the line is free then."""
        count = self.arrived(time_ns)
        del self._bytes[count:], self._arrivals[count:]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        self._free_ns = min(self._free_ns, time_ns)


@lru_cache(maxsize=1024)
def _byte_ends_ns(baud: int, count: int) -> tuple[int, ...]:
    """Return the ends of consecutive bytes after the start of the first one [ns]."""
    return tuple(k * _BYTE_BITS_NS // baud if baud else 0 for k in range(1, count + 1))


class Uart:
    """Both directions, named as the robot sees them."""

    def __init__(self, baud: int) -> None:
        self.rx = SerialLine(baud)
        self.tx = SerialLine(baud)

    @property
    def room(self) -> int:
        """Number of bytes that the host may send before flow control stops it.

        A host that connects as another leaves may have sent more already; the number is then 0.
        """
        return max(QUEUE_LIMIT - len(self.rx), 0)
