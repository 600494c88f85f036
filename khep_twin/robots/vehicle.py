"""Braitenberg vehicle of a program on a robot."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import mul

from khep_twin.board.kernel import divide

WANDERING, TURNING, N_STILL, LAST_LEFT, LAST_RIGHT = range(5)
"""Indices in the state: whether the vehicle drives, whether it turns in place, rounds without motion, and
positions at the last motion [pulses]."""
N_VEHICLE = 5


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Numbers of a vehicle, which turns in place after six rounds without motion."""

    left: Sequence[int]  # weights of the readings around the robot
    right: Sequence[int]
    threshold: int  # least reading with an effect
    saturation: int
    divisor: int  # of the sums
    forward: int  # speed without obstacles
    min_speed: int
    turn: int  # speed of a turn in place
    moved_pulses: int  # motion that counts
    front: slice  # of the readings
    unit: int = 1  # of the speeds
    gain: int = 1  # of the sums
    is_unsigned: bool = False  # positions are compared as unsigned numbers
    waits: bool = False  # rounds of a turn have no effect, and a turn needs no obstacle

    def speeds(self, readings: Sequence[int], gain: int | None = None) -> tuple[int, int]:
        """Return the speeds of the left and right wheel."""
        factor = self.gain if gain is None else gain
        inputs = [
            0 if count < self.threshold else (min(count, self.saturation) - self.threshold) // 2
            for count in readings
        ]
        left, right = (
            divide(factor * sum(map(mul, weights, inputs)), self.divisor) + self.forward
            for weights in (self.left, self.right)
        )
        return self._at_least(left), self._at_least(right)

    def is_near(self, position: int, last_position: int) -> bool:
        """Return whether a wheel has not moved."""
        low, high = last_position - self.moved_pulses, last_position + self.moved_pulses
        return low < position < high and not (self.is_unsigned and low < 0 <= high)

    def _at_least(self, speed: int) -> int:
        return self.unit * (max(speed, self.min_speed) if speed >= 0 else min(speed, -self.min_speed))
