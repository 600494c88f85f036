"""Model of the serial line in simulated time: the arrival of each byte in both directions.

A byte takes eleven bit times. Byte k (counted from 1) of a burst that starts at t0 arrives at
t0 + k * 11 * 10^9 // baud; a burst that finds the line busy starts when the line is free.
"""

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
    """A host's known settings of its end of the line.

    Attributes:
        baud: Bits per second; 0 for a disconnected line.
        stop_bits: Stop bits, 1 or 2.
    """

    baud: int
    stop_bits: int


class HostEventKind(IntEnum):
    """Actions of a host on the line, and of a user on the robot or its world; the numbers are logged."""

    SEND = 0
    DISCONNECT = 1
    FLUSH = 2
    LINE_SETTINGS = 3
    MOVE_ROBOT = 4
    SWITCH_LAMP = 5
    SCAN = 6
    SET_LAMPS = 7
    NOTE = 8


class HostEvent(NamedTuple):
    """One action of a host on a robot's line, or of a user; replay of the same actions repeats a run.

    Attributes:
        kind: Kind of action.
        at_ns: Time of effect, now or later [ns].
        host: Settings of the host's end of the line; None if they equal the robot's.
        data: Bytes as the host sent them; or the robot's new pose, the switched lamp or the new lamps,
            encoded by `khep_twin.interventions`; or an event's text after a byte, 1 if it concerns no robot.
    """

    kind: HostEventKind
    at_ns: int
    host: LineSettings | None = None
    data: bytes = b""


class LineState(NamedTuple):
    """State of one direction of the line.

    Attributes:
        baud: Bits per second; 0 for a line without delay.
        data: Bytes in transit or arrived but unread.
        arrivals: Arrival of each byte [ns].
        free_ns: Time from which the line is free [ns].
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
        n_arrived = self.count_arrived(since_ns)
        arrivals = tuple(self._arrivals[n_arrived:])
        return LineState(self.baud, bytes(self._bytes[n_arrived:]), arrivals, self._free_ns)

    def set_state(self, state: LineState) -> None:
        """Restore a state.

        Raises:
            ValueError: Its arrivals are not one for each byte in rising order.
        """
        arrivals = list(state.arrivals)
        if len(arrivals) != len(state.data) or arrivals != sorted(arrivals):
            raise ValueError(
                f"{len(arrivals)} arrivals of {len(state.data)} bytes; expected one each, rising"
            )
        self.baud = state.baud
        self._free_ns = state.free_ns
        self._bytes = bytearray(state.data)
        self._arrivals = arrivals
        self.next_ns = arrivals[0] if arrivals else None

    @property
    def byte_ns(self) -> int:
        """Duration of one byte [ns]."""
        return _BYTE_BITS_NS // self.baud if self.baud else 0

    def send(self, data: bytes, time_ns: int) -> int:
        """Send `data` at `time_ns` or once the line is free; return the arrival of its last byte [ns]."""
        if data:
            start_ns = max(time_ns, self._free_ns)
            self._arrivals += [start_ns + end_ns for end_ns in _byte_ends_ns(self.baud, len(data))]
            self._bytes += data
            self._free_ns = self._arrivals[-1]
            self.next_ns = self._arrivals[0]
        return self._free_ns

    def count_arrived(self, time_ns: int) -> int:
        """Return the number of bytes that have arrived by `time_ns`."""
        return bisect_right(self._arrivals, time_ns)

    def arrival_ns(self, count: int) -> int | None:
        """Return the arrival of the `count`-th byte in transit [ns], None if there are fewer."""
        return self._arrivals[count - 1] if 0 < count <= len(self._arrivals) else None

    @property
    def content(self) -> bytearray:
        """Bytes in transit or arrived but unread, not to be changed."""
        return self._bytes

    def count_to_end_of(self, text: bytes) -> int | None:
        """Return the number of bytes in transit up to the end of the first `text`, None if it is absent."""
        start = self._bytes.find(text) if text else -1
        return start + len(text) if start >= 0 else None

    def read(self, time_ns: int, limit: int | None = None) -> bytes:
        """Remove and return the bytes that have arrived by `time_ns`, at most `limit`."""
        n_bytes = self.count_arrived(time_ns)
        n_bytes = n_bytes if limit is None else min(n_bytes, limit)
        data = bytes(self._bytes[:n_bytes])
        del self._bytes[:n_bytes], self._arrivals[:n_bytes]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        return data

    def flush(self, time_ns: int) -> None:
        """Drop the bytes that have not arrived by `time_ns`; the line is free then."""
        n_arrived = self.count_arrived(time_ns)
        del self._bytes[n_arrived:], self._arrivals[n_arrived:]
        self.next_ns = self._arrivals[0] if self._arrivals else None
        self._free_ns = min(self._free_ns, time_ns)


@lru_cache(maxsize=1024)
def _byte_ends_ns(baud: int, count: int) -> tuple[int, ...]:
    """Return the ends of consecutive bytes after the start of the first one [ns]."""
    return tuple(k * _BYTE_BITS_NS // baud if baud else 0 for k in range(1, count + 1))


class Uart:
    """Both directions of the line: `rx` to the robot, `tx` from the robot."""

    def __init__(self, baud: int) -> None:
        self.rx = SerialLine(baud)
        self.tx = SerialLine(baud)

    @property
    def free_capacity(self) -> int:
        """Number of bytes that the host may send before flow control stops it; 0 if it has sent more."""
        return max(QUEUE_LIMIT - len(self.rx), 0)
