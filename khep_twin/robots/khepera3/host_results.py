"""Results of a Khepera III's commands: named tuples in SI units."""

from collections.abc import Sequence
from typing import NamedTuple, Self


class InfraredReadings(NamedTuple):
    """Commands N and O: eleven counts, 0 to 4095, around the robot and of the ground below it.

    Proximity is about 3980 at white paper; noise may be below 0.
    """

    back_left: int
    left: int
    front_side_left: int
    front_left: int
    front_right: int
    front_side_right: int
    right: int
    back_right: int
    back: int
    ground_right: int
    ground_left: int


class Echo(NamedTuple):
    """Command G: an echo.

    Attributes:
        distance: Distance of the object [m].
        amplitude: Amplitude [counts].
        time: Time since the robot's start or `reset_timer` [s].
    """

    distance: float
    amplitude: int
    time: float

    @classmethod
    def from_reply(cls, values: Sequence[int]) -> list[Self]:
        """Return the echoes of a reply."""
        starts = range(1, 1 + 3 * values[0], 3)
        return [cls(values[i] / 100, values[i + 1], values[i + 2] / 1000) for i in starts]


class EchoDistances(NamedTuple):
    """Distances of the nearest echoes of the ultrasonic sensors, 0.2 to 4 [m].

    Infinity is no echo, None a sensor that `configure_ultrasonic` has not made active.
    """

    left: float | None
    front_left: float | None
    front: float | None
    front_right: float | None
    right: float | None


class BatteryState(NamedTuple):
    """Command V: state of the battery.

    Attributes:
        voltage: Voltage [V].
        current: Current, below 0 while it is discharged [A].
        average_current: Average current [A].
        charge_mah: Remaining charge [mAh].
        temperature_celsius: Temperature [degrees Celsius].
        level: Remaining part of the charge, 0 to 1.
    """

    voltage: float
    current: float
    average_current: float
    charge_mah: float
    temperature_celsius: float
    level: float
