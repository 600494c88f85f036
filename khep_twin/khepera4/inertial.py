"""Accelerometer and gyroscope of the Khepera IV, at the centre of rotation, in packets of ten values.

The accelerometer measures the specific force (acceleration minus gravity), averaged over 10 ms, in the
robot's frame: (v - previous v) / 10 ms + g upwards for the velocity v. Forward and left are positive; the
vertical axis has the opposite sign, as it reads minus 1 g at rest (library). The gyroscope has the present
rate of turn, 95 Hz.
"""

from collections.abc import Sequence

from khep_twin.sensing.noise import draws, plain_tables
from khep_twin.simulation.number_reader import NumberReader
from khep_twin.units import GRAVITY, TICK_NS

COUNTS_PER_G = 16_384
"""Scale of the accelerometer: 12 bits, shifted left by 4 (manual)."""

DEGREES_PER_COUNT = 0.066
"""Scale of the gyroscope [deg/s] (manual)."""

PACKET_SIZE = 10
"""Values of a packet, the newest first (manual)."""

_GYROSCOPE_NS = 1_000_000_000 // 95
_ACCELERATION_NOISE, _RATE_NOISE = 26.0, 2.0
"""Standard deviations [counts]: 0.22 mg and 0.03 deg/s per root Hz (data sheet of a similar chip, LSM330DLC)
over half of the rates."""

_KEY_MASK = 0x85EBCA6B
"""Arbitrary word that separates their random draws from those of other sensors."""

_DEGREES_PER_RADIAN = 57.29577951308232
_COUNTS_LIMIT = 1 << 15
_COUNTS_RANGE = -_COUNTS_LIMIT, _COUNTS_LIMIT - 1


class Inertial:
    """Both sensors of one robot.

    Args:
        key: Words of the key of the robot's random draws.
        noise: Scale of the readings' noise, 0 for none.

    Attributes:
        accelerations: Last complete packets of x, y and z, the newest value first (3, 10) [counts].
        rates: Those of the gyroscope.
    """

    def __init__(self, key: Sequence[int], noise: float) -> None:
        self._key = [key[0] ^ _KEY_MASK, key[1]]
        self._tables = plain_tables(noise)
        self.accelerations, self.rates = _zero_packets(), _zero_packets()
        self._partials = [_zero_packets(0), _zero_packets(0)]
        self._velocity: list[float] = [0.0, 0.0, 0.0]
        self._n_rate_samples = 0

    def tick(
        self, time_ns: int, rotation: Sequence[float], velocity: Sequence[float], rate: Sequence[float]
    ) -> None:
        """Measure in a control period.

        Args:
            time_ns: Time [ns].
            rotation: Orientation of the robot, rows of a matrix (9,).
            velocity: Its velocity in the world frame (3,) [m/s].
            rate: Its rate of turn in the robot's frame (3,) [rad/s].
        """
        force = [(new - old) / (TICK_NS * 1e-9) for new, old in zip(velocity, self._velocity, strict=True)]
        self._velocity = list(velocity)
        force[2] += GRAVITY
        local_force = [
            sum(rotation[3 * row + axis] * force[row] for row in range(3)) / GRAVITY for axis in range(3)
        ]
        local_force[2] = -local_force[2]
        scaled = [axis_force * COUNTS_PER_G for axis_force in local_force]
        counts = self._add_noise(time_ns, 0, scaled, _ACCELERATION_NOISE)
        self.accelerations = self._add_to_packet(0, [count >> 4 << 4 for count in counts], self.accelerations)
        if time_ns // _GYROSCOPE_NS > self._n_rate_samples:
            self._n_rate_samples = time_ns // _GYROSCOPE_NS
            scaled = [axis_rate * _DEGREES_PER_RADIAN / DEGREES_PER_COUNT for axis_rate in rate]
            self.rates = self._add_to_packet(1, self._add_noise(time_ns, 2, scaled, _RATE_NOISE), self.rates)

    def reset_velocity(self) -> None:
        """Set the velocity to zero."""
        self._velocity = [0.0, 0.0, 0.0]

    def state(self) -> tuple[list[int], list[float]]:
        """Return the state as integers and as floats."""
        packets = [value for axis in (*self.accelerations, *self.rates) for value in axis]
        lengths = [len(self._partials[0][0]), len(self._partials[1][0])]
        partial = [value for kind in self._partials for axis in kind for value in axis]
        integers = [self._n_rate_samples, *packets, *lengths, *partial]
        return [len(integers), *integers], self._velocity

    def set_state(self, integers: NumberReader[int], floats: NumberReader[float], time_ns: int) -> None:
        """Restore a state of a time [ns].

        Raises:
            ValueError: It has fewer or more numbers, or one is outside its range.
        """
        (count,) = integers.take("length of the inertial state", 1)
        (self._n_rate_samples,) = integers.take("gyroscope's samples", 1, 0, time_ns // _GYROSCOPE_NS)
        packets = [integers.take("inertial value", PACKET_SIZE, *_COUNTS_RANGE) for _ in range(6)]
        self.accelerations, self.rates = packets[:3], packets[3:]
        sizes = integers.take("length of an incomplete packet", 2, 0, PACKET_SIZE - 1)
        if count != (expected := 3 + 6 * PACKET_SIZE + 3 * sum(sizes)):
            raise ValueError(f"an inertial state of {count} numbers; expected {expected}")
        self._partials = [
            [integers.take("inertial value", size, *_COUNTS_RANGE) for _ in range(3)] for size in sizes
        ]
        self._velocity = floats.take("velocity", 3)

    def _add_noise(self, time_ns: int, offset: int, values: Sequence[float], noise: float) -> list[int]:
        """Return values with noise of a standard noise [counts], rounded, and clipped to 16 bits."""
        number = 4 * (time_ns // TICK_NS) + offset
        normal = (*draws(self._tables, self._key, number)[:2], draws(self._tables, self._key, number + 1)[0])
        return [
            min(max(round(value + noise * draw), _COUNTS_RANGE[0]), _COUNTS_RANGE[1])
            for value, draw in zip(values, normal, strict=True)
        ]

    def _add_to_packet(self, sensor: int, values: Sequence[int], packets: list[list[int]]) -> list[list[int]]:
        """Add x, y, z of a sensor (0 accelerometer, 1 gyroscope); return its last complete packets."""
        partial = self._partials[sensor]
        for axis, value in zip(partial, values, strict=True):
            axis.insert(0, value)
        if len(partial[0]) < PACKET_SIZE:
            return packets
        self._partials[sensor] = _zero_packets(0)
        return partial


def _zero_packets(count: int = PACKET_SIZE) -> list[list[int]]:
    return [[0] * count for _ in range(3)]
