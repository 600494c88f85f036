"""Times of a host's exchanges with its robot, for episodes without a serial line.

A host's cycle on the line, each exchange begun when the one before has ended:

    begin, N, its reply, O and H with their replies, D, its reply, a pause until begin + period

A byte takes eleven bit times; the robot answers once a request's last byte has arrived. So a reading is that
of the moment when the robot answers, the speeds decided on it take effect when all of D has arrived, and a
cycle that takes longer than the control period delays the next one. These are the times of a controller on
`khep://`, to the nanosecond, where the host's own computing takes none.

Without a line, a cycle reads and drives at one moment. The functions run interpreted and compiled.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.units import BITS_PER_BYTE, N_SENSORS

REQUESTS = "NOH"
"""Requests that a cycle may have: proximity, ambient light, positions of the wheels."""

N_EVENT = 4
NEXT, STAGE, AT_NS, BEGUN_NS = range(N_EVENT)
"""Indices in a robot's event: step before which it is due, its stage, which is the number of requests that
are answered, and the times of the event and of the begin of its cycle [ns]."""

NEVER = 2**62
"""Step of an event that waits for the caller's speeds."""

BAUD, DELAY_NS, PERIOD_NS, REQUESTED = range(4)
"""Indices in the times of a line: speed [baud], 0 for exchanges that take no time; time from reading to
driving besides that of the exchanges, control period [ns]; and first of the requests."""

_BYTE_BITS_NS = BITS_PER_BYTE * NS_PER_S
_END = 2  # carriage return and line feed end a reply
_REQUEST = 2  # a letter and a line feed
_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_ENCODER, _POSITION = int(kernel.Wheel.ENCODER), int(kernel.Wheel.POSITION)
_LEFT_SETPOINT, _RIGHT_SETPOINT = kernel.SETPOINTS
_RIGHT = kernel.RIGHT


@dataclass(frozen=True, slots=True)
class MeasuredCycle:
    """Measured times of a host's cycle, for a line whose speed alone does not tell them.

    Attributes:
        delay: Time from the robot's reading to the effect of the speeds decided on it [s].
        period: Duration of a cycle [s]; the control period if that is longer.

    Raises:
        ValueError: A time is no number from 0, or the delay exceeds the period.
    """

    delay: float
    period: float

    def __post_init__(self) -> None:
        """Check the times."""
        if not 0 <= self.delay <= self.period < math.inf:
            raise ValueError(f"{self}; expected a delay from 0 to the period, in seconds")


LineTimes = int | MeasuredCycle | None
"""Speed of a line [baud], a measured cycle, or None for exchanges that take no time."""


def check_line(line: object) -> None:
    """Raise a `ValueError` unless this is a `LineTimes`."""
    is_speed = isinstance(line, int) and not isinstance(line, bool) and 0 < line <= NS_PER_S
    if not (is_speed or line is None or isinstance(line, MeasuredCycle)):
        raise ValueError(f"line = {line!r}; expected a speed in baud, such as 9600, or a MeasuredCycle")


def line_times(line: LineTimes, requests: str, period_ns: int) -> NDArray[np.int64]:
    """Return the times of a line for `first_events` and `set_next`.

    Args:
        line: Line; None for exchanges that take no time.
        requests: Requests of a cycle, of `REQUESTS`; none for a controller that asks nothing, and so has no
            line.
        period_ns: Control period [ns].
    """
    codes = [REQUESTS.index(letter) for letter in requests]
    if line is None or not codes:
        return np.array([0, 0, period_ns, 0], np.int64)
    if isinstance(line, MeasuredCycle):
        return np.array([0, to_ns(line.delay), max(period_ns, to_ns(line.period)), *codes], np.int64)
    return np.array([line, 0, period_ns, *codes], np.int64)


def longest_cycle_ns(baud: int, requests: str) -> int:
    """Return the longest duration of a cycle with these requests [ns]."""
    counts, positions, speeds = "n" + ",1023" * N_SENSORS, "h" + ",-2147483648" * 2, "D,-127,-127\nd"
    replies = {"N": counts, "O": counts, "H": positions}
    lengths = [_REQUEST, len(speeds) + _END, *(len(replies[letter]) + _END for letter in requests)]
    return sum(_bytes_ns(baud, length) for length in (*lengths, *[_REQUEST] * (len(requests) - 1)))


def first_events(n_robots: int, times: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the events of robots whose first cycles begin at time 0 (n_robots, N_EVENT)."""
    return np.array([[0, 0, _bytes_ns(int(times[BAUD]), _REQUEST), 0]] * n_robots, np.int64)


@compilable
def set_next(event: Vector[int], times: Vector[int], step_ns: int) -> None:
    """Set the step before which an event is due.

    Where a line takes time, bytes that arrive at a step's end are handled before that step, as by a robot at
    its line.
    """
    event[NEXT] = (event[AT_NS] - 1) // step_ns if times[BAUD] > 0 else event[AT_NS] // step_ns


@compilable
def answer(
    event: Vector[int], times: Vector[int], registers: kernel.Registers, seen: kernel.Registers
) -> bool:
    """Answer a request; return whether it is the last of its cycle.

    Args:
        event: Event of the robot, which becomes that of the next request, or the end of the last reply.
        times: Times of the line.
        registers: State of the board.
        seen: State as the host has read it, changed in place (N_REGISTERS,).
    """
    stage, baud = event[STAGE], times[BAUD]
    request = times[REQUESTED + stage]
    if stage == 0:
        for register in range(kernel.N_REGISTERS):
            seen[register] = registers[register]
    elif request == 1:
        for sensor in range(N_SENSORS):
            seen[_AMBIENT + sensor] = registers[_AMBIENT + sensor]
    elif request == 0:
        for sensor in range(N_SENSORS):
            seen[_PROXIMITY + sensor] = registers[_PROXIMITY + sensor]
    else:
        for wheel in (0, _RIGHT):
            seen[wheel + _ENCODER] = registers[wheel + _ENCODER]
            seen[wheel + _POSITION] = registers[wheel + _POSITION]
    event[STAGE] = stage + 1
    is_last = stage + 1 == len(times) - REQUESTED
    if baud > 0:
        event[AT_NS] += _bytes_ns(baud, _length(seen, request))
        if not is_last:
            event[AT_NS] += _bytes_ns(baud, _REQUEST)
    return is_last


@compilable
def send_speeds(event: Vector[int], times: Vector[int], seen: kernel.Registers) -> None:
    """Make the event the moment when the speeds in `seen` take effect."""
    if times[BAUD] > 0:
        length = 4 + _digits(seen[_LEFT_SETPOINT]) + _digits(seen[_RIGHT_SETPOINT])
        event[AT_NS] += _bytes_ns(times[BAUD], length)
    event[AT_NS] += times[DELAY_NS]


@compilable
def end_cycle(event: Vector[int], times: Vector[int]) -> int:
    """Make the event the first request of the next cycle; return the duration of this one [ns]."""
    begun_ns, baud = event[BEGUN_NS], times[BAUD]
    event[STAGE] = 0
    event[BEGUN_NS] = max(begun_ns + times[PERIOD_NS], event[AT_NS] + _bytes_ns(baud, 1 + _END))
    event[AT_NS] = event[BEGUN_NS] + _bytes_ns(baud, _REQUEST)
    return event[BEGUN_NS] - begun_ns


@compilable
def _bytes_ns(baud: int, count: int) -> int:
    """Return the duration of some bytes [ns]; 0 for a line that takes no time."""
    return count * _BYTE_BITS_NS // baud if baud > 0 else 0


@compilable
def _length(seen: kernel.Registers, request: int) -> int:
    """Return the length of the reply to a request."""
    length = 1 + _END
    if request == 2:
        return length + 2 + _digits(seen[_POSITION]) + _digits(seen[_RIGHT + _POSITION])
    first = _AMBIENT if request == 1 else _PROXIMITY
    for sensor in range(N_SENSORS):
        length += 1 + _digits(seen[first + sensor])
    return length


@compilable
def _digits(number: int) -> int:
    """Return the length of a number as text, with its sign."""
    count, rest = 1 if number >= 0 else 2, abs(number)
    while rest >= 10:
        rest //= 10
        count += 1
    return count
