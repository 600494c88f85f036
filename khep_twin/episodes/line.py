"""Times of a host's exchanges with a Khepera, for episodes without a serial line.

A host's cycle on the line, in which each exchange (request and reply) starts when the previous one has ended:

    start, N, its reply, O and H with their replies, D, its reply, a pause until start + period

A byte takes eleven bit times. The robot answers when the last byte of a request has arrived, with its current
registers. The speeds of command D take effect when its last byte has arrived. A cycle longer than the control
period delays the next one. To the nanosecond, these are the times on `khep://` of a host with no delay.

Without a line, a cycle reads and drives at the same time. The functions run interpreted and compiled.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.compilable import compilable
from khep_twin.errors import value_text
from khep_twin.robots.core import Registers
from khep_twin.robots.model import Interface
from khep_twin.sensing.buffers import Vector
from khep_twin.units import BITS_PER_BYTE, N_SENSORS

REQUESTS = "NOH"
"""Requests of a cycle: proximity, ambient light, positions of the wheels."""

N_EVENT = 4
NEXT_STEP, STAGE, EVENT_NS, CYCLE_START_NS = range(N_EVENT)
"""Indices in a robot's event: step before which it is handled, its stage (the number of answered requests),
and the times of the event and of the start of its cycle [ns]."""

NEVER = 2**62
"""Step of an event that waits for the caller's speeds."""

BAUD, DELAY_NS, PERIOD_NS, FIRST_REQUEST = range(4)
"""Indices in the times of a line: speed [baud], 0 for exchanges that take no time; delay from reading to
driving besides the exchanges [ns]; control period [ns]; first of the requests."""

_BYTE_NS_AT_1_BAUD = BITS_PER_BYTE * NS_PER_S
_LINE_END = 2  # carriage return and line feed end a reply
_REQUEST = 2  # a letter and a line feed
_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_ENCODER, _POSITION = int(kernel.Wheel.ENCODER), int(kernel.Wheel.POSITION)


@dataclass(frozen=True, slots=True)
class MeasuredCycle:
    """Measured times of a host's cycle, for a line whose speed does not determine them.

    Attributes:
        delay: Time from a reading until the speeds decided on it take effect [s].
        period: Duration of a cycle [s]; the control period if that is longer.

    Raises:
        ValueError: A time is negative or not finite, or the delay exceeds the period.
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
        raise ValueError(
            f"line = {value_text(line)}; expected a speed in baud, such as 9600, or a MeasuredCycle"
        )


def line_times(line: LineTimes, requests: str, period_ns: int) -> NDArray[np.int64]:
    """Return the times of a line for `initial_events` and `set_next_step`.

    Args:
        line: Line; None for exchanges that take no time.
        requests: Requests of a cycle, from `REQUESTS`; empty for a controller without requests, for which
            exchanges take no time.
        period_ns: Control period [ns].
    """
    codes = [REQUESTS.index(letter) for letter in requests]
    if line is None or not codes:
        return np.array([0, 0, period_ns, 0], np.int64)
    if isinstance(line, MeasuredCycle):
        # The first request reads all registers, and the others would come at the same time.
        return np.array([0, to_ns(line.delay), max(period_ns, to_ns(line.period)), codes[0]], np.int64)
    return np.array([line, 0, period_ns, *codes], np.int64)


def longest_cycle_ns(baud: int, requests: str) -> int:
    """Return the longest duration of a cycle with these requests [ns]."""
    counts, positions, speeds = "n" + ",1023" * N_SENSORS, "h" + ",-2147483648" * 2, "D,-127,-127\nd"
    replies = {"N": counts, "O": counts, "H": positions}
    lengths = [_REQUEST, len(speeds) + _LINE_END, *(len(replies[letter]) + _LINE_END for letter in requests)]
    return sum(_transfer_ns(baud, length) for length in (*lengths, *[_REQUEST] * (len(requests) - 1)))


def initial_events(n_robots: int, times: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the events of robots whose first cycles start at time 0 (n_robots, N_EVENT)."""
    return np.array([[0, 0, _transfer_ns(int(times[BAUD]), _REQUEST), 0]] * n_robots, np.int64)


@compilable
def set_next_step(event: Vector[int], times: Vector[int], step_ns: int) -> None:
    """Set the step before which an event (the arrival of a request or of speeds) is handled.

    If a line takes time, bytes that arrive at the end of a step are handled before that step, as by a robot
    with a serial line.
    """
    event[NEXT_STEP] = (event[EVENT_NS] - 1) // step_ns if times[BAUD] > 0 else event[EVENT_NS] // step_ns


@compilable
def answer_request(
    event: Vector[int],
    times: Vector[int],
    registers: Registers,
    host_registers: Registers,
    interface: Interface,
) -> bool:
    """Answer a request; return whether it is the last of its cycle.

    Args:
        event: Event of the robot; changed to that of the next request, or to the end of the last reply.
        times: Times of the line.
        registers: Registers of the robot.
        host_registers: Registers as read by the host, changed in place (n_registers,).
        interface: Meaning of the registers.
    """
    stage, baud = event[STAGE], times[BAUD]
    request = times[FIRST_REQUEST + stage]
    if stage == 0:
        for register in range(interface.n_registers):
            host_registers[register] = registers[register]
    elif request == 1:
        for register in range(interface.ambient[0], interface.ambient[1]):
            host_registers[register] = registers[register]
    elif request == 0:
        for register in range(interface.proximity[0], interface.proximity[1]):
            host_registers[register] = registers[register]
    else:
        for wheel in (0, kernel.RIGHT):
            host_registers[wheel + _ENCODER] = registers[wheel + _ENCODER]
            host_registers[wheel + _POSITION] = registers[wheel + _POSITION]
    event[STAGE] = stage + 1
    is_last = stage + 1 == len(times) - FIRST_REQUEST
    if baud > 0:
        event[EVENT_NS] += _transfer_ns(baud, _reply_length(host_registers, request))
        if not is_last:
            event[EVENT_NS] += _transfer_ns(baud, _REQUEST)
    return is_last


@compilable
def send_speeds(
    event: Vector[int], times: Vector[int], host_registers: Registers, interface: Interface
) -> None:
    """Set the event to the time when the setpoints in `host_registers` take effect."""
    if times[BAUD] > 0:
        left, right = host_registers[interface.setpoints[0]], host_registers[interface.setpoints[1]]
        length = 4 + _n_chars(left) + _n_chars(right)
        event[EVENT_NS] += _transfer_ns(times[BAUD], length)
    event[EVENT_NS] += times[DELAY_NS]


@compilable
def end_cycle(event: Vector[int], times: Vector[int]) -> int:
    """Set the event to the first request of the next cycle; return the duration of this one [ns]."""
    start_ns, baud = event[CYCLE_START_NS], times[BAUD]
    event[STAGE] = 0
    end_ns = event[EVENT_NS] + _transfer_ns(baud, 1 + _LINE_END)
    event[CYCLE_START_NS] = max(start_ns + times[PERIOD_NS], end_ns)
    event[EVENT_NS] = event[CYCLE_START_NS] + _transfer_ns(baud, _REQUEST)
    return event[CYCLE_START_NS] - start_ns


@compilable
def _transfer_ns(baud: int, n_bytes: int) -> int:
    """Return the duration of a number of bytes [ns]; 0 if exchanges take no time."""
    return n_bytes * _BYTE_NS_AT_1_BAUD // baud if baud > 0 else 0


@compilable
def _reply_length(host_registers: Registers, request: int) -> int:
    """Return the length [bytes] of the reply to a request, an index in REQUESTS (0 N, 1 O, 2 H)."""
    length = 1 + _LINE_END
    if request == 2:
        left, right = host_registers[_POSITION], host_registers[kernel.RIGHT + _POSITION]
        return length + 2 + _n_chars(left) + _n_chars(right)
    first_register = _AMBIENT if request == 1 else _PROXIMITY
    for sensor in range(N_SENSORS):
        length += 1 + _n_chars(host_registers[first_register + sensor])
    return length


@compilable
def _n_chars(number: int) -> int:
    """Return the length of a number as text, with its sign."""
    count, remainder = 1 if number >= 0 else 2, abs(number)
    while remainder >= 10:
        remainder //= 10
        count += 1
    return count
