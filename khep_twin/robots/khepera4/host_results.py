"""Results of a Khepera IV's commands: named tuples in SI units."""

import math
from typing import NamedTuple, Self

from khep_twin.robots.khepera4.channels import ULTRASONIC_CODES

_SPECIAL_DISTANCES: dict[int, float | None] = dict(zip(ULTRASONIC_CODES, (0.0, math.inf, None), strict=True))
"""Distances of ultrasonic readings that are codes."""


class InfraredCounts(NamedTuple):
    """Commands N and O: twelve counts, 0 to 1023, around the robot and of the ground below it.

    Proximity is about 1020 at white paper, and about 100 without an object, from the floor's reflection.
    """

    back_left: int
    left: int
    front_left: int
    front: int
    front_right: int
    right: int
    back_right: int
    back: int
    ground_left: int
    ground_front_left: int
    ground_front_right: int
    ground_right: int


class Distances(NamedTuple):
    """Command G: distances that the ultrasonic sensors measure, 0.25 to 2.5 [m].

    0 is an object nearer than 0.25 m, infinity no object in range, None a sensor disabled by
    `enable_ultrasonic`.
    """

    left: float | None
    front_left: float | None
    front: float | None
    front_right: float | None
    right: float | None

    @classmethod
    def from_cm(cls, values_cm: tuple[int, ...]) -> Self:
        """Return the distances of readings [cm]."""
        return cls._make(_SPECIAL_DISTANCES.get(value, value / 100) for value in values_cm)


class Vector3(NamedTuple):
    """A vector in the robot's frame, x forward, y left."""

    x: float
    y: float
    z: float


class Battery(NamedTuple):
    """Command V: state of the battery.

    Attributes:
        voltage: Voltage [V].
        current: Current, below 0 while it is discharged [A].
        average_current: Average current of the last half minute [A].
        charge_mah: Remaining charge [mAh].
        temperature_celsius: Temperature [degrees Celsius].
        level: Remaining part of the charge, 0 to 1.
        is_charging: Whether the charger is plugged in.
    """

    voltage: float
    current: float
    average_current: float
    charge_mah: float
    temperature_celsius: float
    level: float
    is_charging: bool
