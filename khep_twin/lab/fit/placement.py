"""Objects before a robot, as a ruler has found them, and the robot's poses since.

A ruler's and an eye's errors are unknowns of a fit: each test has one of the distance and one of the bearing
at its start, with the standard deviations of `Ruler`; all tests share one of the wheel base.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import Floats, Parameter
from khep_twin.units import BODY_RADIUS, N_SENSORS, SCAN_NS

SCAN_LAG_S = SCAN_NS * 1e-9 / math.sqrt(12)
"""Standard deviation of a reading's age [s]: it is uniform between the scan's beginning and end."""


@dataclass(frozen=True, slots=True)
class Ruler:
    """Standard deviations of what a person measures (assumed).

    Attributes:
        distance_mm: Of a distance by the ruler [mm].
        bearing_deg: Of a direction: of an object that stands straight ahead, of a counted turn [deg].
        base: Of the wheel base, relative; of one that no drive has measured: published are 52 to 54 mm.
    """

    distance_mm: float = 0.5
    bearing_deg: float = 1.5
    base: float = 0.015

    def __post_init__(self) -> None:
        """Raise a `FitError` for a negative value, or one that no test can be fitted with."""
        for name, value, limit in (("ruler", self.distance_mm, 10), ("bearing", self.bearing_deg, 45)):
            if not 0 <= value <= limit:
                raise FitError(f"{name} = {value:g}; expected a standard deviation of 0 to {limit}")


@dataclass(frozen=True, slots=True)
class Misplacement:
    """Deviation of an object from where a person has put it.

    Attributes:
        distance: How much farther away it stood [m].
        bearing: How much farther to the left, counter-clockwise [rad].
        turned: How much more than by its counters the robot has turned, relative.
    """

    distance: float = 0.0
    bearing: float = 0.0
    turned: float = 0.0


IN_PLACE = Misplacement()


@dataclass(frozen=True, slots=True)
class Placement:
    """Object that stood straight ahead of a robot at its start.

    Attributes:
        poses: Poses of the robot since, by its counters: x, y [m], heading [rad] (n, 3).
        distance: Distance from the robot's edge to the object's nearest point at the start [m], or one for
            each pose (n,).
        radius: Radius of the cylinder or the bulb, 0 for a wall [m].
        turning: Fastest turn of the robot [rad/s].
    """

    poses: Floats
    distance: float | Floats
    radius: float = 0.0
    turning: float = 0.0

    def seen(self, moved: Misplacement = IN_PLACE) -> tuple[Floats, Floats]:
        """Return distances from the robot's edge [m] and bearings, counter-clockwise [rad], per pose (n,)."""
        x, y, heading = self.poses.T
        heading = heading * (1 + moved.turned)
        away = BODY_RADIUS + self.distance + moved.distance + self.radius
        east, north = math.cos(moved.bearing), math.sin(moved.bearing)
        if self.radius == 0:
            # A wall's nearest point lies in the direction of its normal.
            return away - x * east - y * north - BODY_RADIUS, moved.bearing - heading
        ahead, left = away * east - x, away * north - y
        bearings = np.angle(np.exp(1j * (np.arctan2(left, ahead) - heading)))
        return np.hypot(ahead, left) - self.radius - BODY_RADIUS, bearings


@dataclass(frozen=True, slots=True)
class Readings:
    """Sensors' readings of an object.

    Attributes:
        name: Name in messages.
        placement: Place of the object, and poses of the robot.
        counts: Readings of the sensors in these poses (n, 8) [counts].
        power: Power of the lamp [W]; None for a wall or a cylinder.
        height: Height of the lamp's filament above the sensors [m].
    """

    name: str
    placement: Placement
    counts: Floats
    power: float | None = None
    height: float = 0.0


def unknowns(tests: Sequence[Readings], ruler: Ruler) -> list[Parameter]:
    """Return the errors of all tests as parameters: distances, bearings, and one of the turns."""
    distance, base = max(ruler.distance_mm, 1e-3), max(ruler.base, 1e-6)
    lags = [math.degrees(test.placement.turning * SCAN_LAG_S) for test in tests]
    bearings = [math.hypot(max(ruler.bearing_deg, 1e-3), lag) for lag in lags]
    return [
        *(Parameter(f"{test.name}: distance", 0, distance, prior=distance) for test in tests),
        *(
            Parameter(f"{test.name}: bearing", 0, bearing, prior=bearing)
            for test, bearing in zip(tests, bearings, strict=True)
        ),
        Parameter("turns", 0, base, prior=base),
    ]


def owners_of(tests: Sequence[Readings], own: int, shared: int = 0) -> NDArray[np.int64]:
    """Return the parameters of each residual for `least_squares`: reading by reading, sensor by sensor.

    The parameters are `shared` ones of all residuals, `own` ones of each sensor in turn, and `unknowns`.
    """
    rows = np.repeat(np.arange(len(tests)), [len(test.counts) for test in tests])
    test, sensor = np.repeat(rows, N_SENSORS), np.tile(np.arange(N_SENSORS), len(rows))
    errors = shared + own * N_SENSORS
    last = np.full_like(test, errors + 2 * len(tests))
    columns = [np.full_like(test, number) for number in range(shared)]
    columns += [shared + own * sensor + number for number in range(own)]
    return np.column_stack([*columns, errors + test, errors + len(tests) + test, last])


def misplacements(values: Floats) -> list[Misplacement]:
    """Return the errors of each test from the values of the parameters of `unknowns`."""
    distances, bearings = values[:-1].reshape(2, -1)
    return [
        Misplacement(distance / 1e3, math.radians(bearing), float(values[-1]))
        for distance, bearing in zip(distances.tolist(), bearings.tolist(), strict=True)
    ]
