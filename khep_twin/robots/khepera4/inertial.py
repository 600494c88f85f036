"""Accelerometer and gyroscope of the Khepera IV, at the centre of rotation, in packets of ten values.

The accelerometer measures the specific force (acceleration minus gravity), averaged over 10 ms, in the
robot's frame: (v - previous v) / 10 ms + g upwards for the velocity v. Forward and left are positive; the
vertical axis has the opposite sign, as it reads minus 1 g at rest (library). The gyroscope has the present
rate of turn, 95 Hz. Complete packets are in the registers of the dsPIC, the newest value first.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from khep_twin.board.memory import write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.registers import COUNTS_PER_G, DEGREES_PER_COUNT, PACKET_SIZE, DspicRegister
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.noise import Tables, draws
from khep_twin.units import GRAVITY, TICK_NS

GYROSCOPE_NS = 1_000_000_000 // 95
"""Period of the gyroscope [ns]."""

COUNTS_LIMIT = 1 << 15
"""Counts are from minus this to below it."""

_ACCELERATION_NOISE, _RATE_NOISE = 26.0, 2.0
"""Standard deviations [counts]: 0.22 mg and 0.03 deg/s per root Hz (data sheet of a similar chip, LSM330DLC)
over half of the rates."""

_KEY_MASK = 0x85EBCA6B
"""Arbitrary word that separates their random draws from those of other sensors."""

_DEGREES_PER_RADIAN = 57.29577951308232
_TICK_S = TICK_NS * 1e-9
_ACCELEROMETER, _GYROSCOPE = int(DspicRegister.ACCELEROMETER), int(DspicRegister.GYROSCOPE)

Triple = tuple[float, float, float]


class InertialState(NamedTuple):
    """State of both sensors, besides their complete packets.

    Attributes:
        values: Packets in progress of x, y and z of the accelerometer and of the gyroscope, filled from their
            ends (6 * PACKET_SIZE,) [counts].
        lengths: Lengths of both sensors' packets in progress (2,).
        n_rates: Number of samples of the gyroscope (1,).
        velocity: Velocity at the last measurement (3,) [m/s].
    """

    values: Vector[int]
    lengths: Vector[int]
    n_rates: Vector[int]
    velocity: Vector[float]


def at_rest() -> InertialState:
    """Return the state before the first measurement."""
    values, velocity = np.zeros(6 * PACKET_SIZE, np.int64), np.zeros(3)
    return InertialState(values, np.zeros(2, np.int64), np.zeros(1, np.int64), cast(Any, velocity))


@compilable
def measure(
    inertial: InertialState,
    memory: Vector[int],
    tables: Tables,
    key: Vector[int],
    time_ns: int,
    rotation: Sequence[float],
    velocity: Triple,
    rate: Triple,
) -> None:
    """Measure in a control period.

    Args:
        inertial: State of the sensors.
        memory: Memory of the dsPIC.
        tables: Quantiles of random draws.
        key: Words of the key of the robot's random draws (2,).
        time_ns: Time [ns].
        rotation: Orientation of the robot, rows of a matrix (9,).
        velocity: Its velocity in the world frame [m/s].
        rate: Its rate of turn in the robot's frame [rad/s].
    """
    old = inertial.velocity
    fx, fy = (velocity[0] - old[0]) / _TICK_S, (velocity[1] - old[1]) / _TICK_S
    fz = (velocity[2] - old[2]) / _TICK_S + GRAVITY
    for axis in range(3):
        old[axis] = velocity[axis]
    # In the robot's frame [g], the vertical axis downwards.
    x = (rotation[0] * fx + rotation[3] * fy + rotation[6] * fz) / GRAVITY
    y = (rotation[1] * fx + rotation[4] * fy + rotation[7] * fz) / GRAVITY
    z = -(rotation[2] * fx + rotation[5] * fy + rotation[8] * fz) / GRAVITY
    own_key: Any = key[0] ^ _KEY_MASK, key[1]
    number = 4 * (time_ns // TICK_NS)
    normal = draw_axes(tables, own_key, number)
    for axis in range(3):
        force = x if axis == 0 else y if axis == 1 else z
        counts = to_counts(force * COUNTS_PER_G + _ACCELERATION_NOISE * normal[axis])
        _append(inertial, 0, axis, counts >> 4 << 4)
    _end_sample(inertial, memory, 0)
    if time_ns // GYROSCOPE_NS > inertial.n_rates[0]:
        inertial.n_rates[0] = time_ns // GYROSCOPE_NS
        normal = draw_axes(tables, own_key, number + 2)
        for axis in range(3):
            degrees = rate[axis] * _DEGREES_PER_RADIAN
            _append(inertial, 1, axis, to_counts(degrees / DEGREES_PER_COUNT + _RATE_NOISE * normal[axis]))
        _end_sample(inertial, memory, 1)


@compilable
def draw_axes(tables: Tables, key: Vector[int], number: int) -> Triple:
    """Return a standard normal draw for each axis, from two numbers."""
    first, second = draws(tables, key, number), draws(tables, key, number + 1)
    return first[0], first[1], second[0]


@compilable
def to_counts(value: float) -> int:
    """Return a value in counts, rounded and clipped to 16 bits."""
    return min(max(round(value), -COUNTS_LIMIT), COUNTS_LIMIT - 1)


@compilable
def _append(inertial: InertialState, sensor: int, axis: int, counts: int) -> None:
    """Add a value of a sensor (0 accelerometer, 1 gyroscope) to its packet in progress."""
    last = (3 * sensor + axis) * PACKET_SIZE + PACKET_SIZE - 1
    inertial.values[last - inertial.lengths[sensor]] = counts


@compilable
def _end_sample(inertial: InertialState, memory: Vector[int], sensor: int) -> None:
    """Count a sample of a sensor, and move a complete packet to the registers."""
    inertial.lengths[sensor] += 1
    if inertial.lengths[sensor] < PACKET_SIZE:
        return
    inertial.lengths[sensor] = 0
    register = _GYROSCOPE if sensor else _ACCELEROMETER
    for index in range(3 * PACKET_SIZE):
        write_number(memory, register + 2 * index, 2, inertial.values[3 * PACKET_SIZE * sensor + index])
