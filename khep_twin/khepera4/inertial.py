"""Accelerometer and gyroscope of the Khepera IV, at the centre of rotation, in packets of ten values.

The accelerometer gives the mean of the last 10 ms of what is felt, in the robot's frame: with the velocity
v, (v - v before) / 10 ms + g upwards, forward and left with their signs, and up with the other one, as at
rest it reads minus 1 g (library). The gyroscope gives the present rate of turn; 95 values a second.
"""

from collections.abc import Sequence

from khep_twin.sensing.noise import TABLES, draws
from khep_twin.units import GRAVITY, TICK_NS

COUNTS_PER_G = 16_384
"""Scale of the accelerometer, of 12 bits that are shifted to the left by 4 (manual)."""

DEGREES_PER_COUNT = 0.066
"""Scale of the gyroscope [deg/s] (manual)."""

PACKET = 10
"""Values of a packet, the newest first (manual)."""

_GYROSCOPE_NS = 1_000_000_000 // 95
_ACCELERATION_NOISE, _RATE_NOISE = 26.0, 2.0
"""Standard deviations [counts]: 0.22 mg and 0.03 deg/s per root of a Hz (data sheet of its kind, LSM330DLC)
over half of the rates."""

_KEY = 0x85EBCA6B
"""Word that tells their random draws from those of other sensors: any."""

_DEGREES = 57.29577951308232
_WORD = 1 << 15


class Inertial:
    """Both sensors of one robot.

    Args:
        key: Words of the key of its random draws.
        is_noisy: Whether they have noise.

    Attributes:
        accelerations: Packets of x, y and z that are to be read, the newest value first (3, 10) [counts].
        rates: The same of the gyroscope.
    """

    def __init__(self, key: Sequence[int], is_noisy: bool) -> None:
        self._key, self._tables = [key[0] ^ _KEY, key[1]], TABLES[is_noisy]
        self.accelerations, self.rates = _packets(), _packets()
        self._filling = [_packets(0), _packets(0)]
        self._velocity: list[float] = [0.0, 0.0, 0.0]
        self._rates = 0

    def tick(
        self, time_ns: int, turn: Sequence[float], velocity: Sequence[float], rate: Sequence[float]
    ) -> None:
        """Take the values of a control period.

        Args:
            time_ns: Time [ns].
            turn: Orientation of the robot, rows of a matrix (9,).
            velocity: Its velocity in the world's frame (3,) [m/s].
            rate: Its rate of turn in its own frame (3,) [rad/s].
        """
        felt = [(now - then) / (TICK_NS * 1e-9) for now, then in zip(velocity, self._velocity, strict=True)]
        self._velocity = list(velocity)
        felt[2] += GRAVITY
        own = [sum(turn[3 * row + axis] * felt[row] for row in range(3)) / GRAVITY for axis in range(3)]
        own[2] = -own[2]
        scaled = [each * COUNTS_PER_G for each in own]
        counts = self._noisy(time_ns, 0, scaled, _ACCELERATION_NOISE)
        self.accelerations = self._put(0, [each >> 4 << 4 for each in counts], self.accelerations)
        if time_ns // _GYROSCOPE_NS > self._rates:
            self._rates = time_ns // _GYROSCOPE_NS
            scaled = [each * _DEGREES / DEGREES_PER_COUNT for each in rate]
            self.rates = self._put(1, self._noisy(time_ns, 2, scaled, _RATE_NOISE), self.rates)

    def rest(self) -> None:
        """Begin at rest."""
        self._velocity = [0.0, 0.0, 0.0]

    def state(self) -> tuple[list[int], list[float]]:
        """Return the state as integers and as floats."""
        packets = (*self.accelerations, *self.rates)
        filling = [len(self._filling[0][0]), len(self._filling[1][0])]
        rest = [each for kind in self._filling for axis in kind for each in axis]
        return [self._rates, *(each for axis in packets for each in axis), *filling, *rest], self._velocity

    def set_state(self, integers: Sequence[int], floats: Sequence[float]) -> None:
        """Take over a state."""
        left = iter(integers)
        self._rates, self._velocity = next(left), list(floats)
        packets = [[next(left) for _ in range(PACKET)] for _ in range(6)]
        self.accelerations, self.rates = packets[:3], packets[3:]
        filling = [next(left), next(left)]
        self._filling = [[[next(left) for _ in range(count)] for _ in range(3)] for count in filling]

    def _noisy(self, time_ns: int, first: int, values: Sequence[float], noise: float) -> list[int]:
        """Return values with noise, rounded, and clipped to 16 bits."""
        number = 4 * (time_ns // TICK_NS) + first
        random = (*draws(self._tables, self._key, number)[:2], draws(self._tables, self._key, number + 1)[0])
        return [
            min(max(round(value + noise * each), -_WORD), _WORD - 1)
            for value, each in zip(values, random, strict=True)
        ]

    def _put(self, kind: int, values: Sequence[int], packets: list[list[int]]) -> list[list[int]]:
        """Add values to the packet that fills up; return the packet that is to be read."""
        filling = self._filling[kind]
        for axis, value in zip(filling, values, strict=True):
            axis.insert(0, value)
        if len(filling[0]) < PACKET:
            return packets
        self._filling[kind] = _packets(0)
        return filling


def _packets(count: int = PACKET) -> list[list[int]]:
    return [[0] * count for _ in range(3)]
