"""Objects in front of a robot, at positions measured with a ruler, and the robot's subsequent poses.

The errors of ruler and eye are parameters of a fit: each test has one for the distance and one for the
bearing at its start, with the standard deviations of `Ruler`. All tests share one for the wheel base, and one
for unequal wheels, with which a robot does not turn about the middle of its axle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import Floats, Parameter
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import default_model
from khep_twin.sensing.calibration import INEQUALITY_SPREAD, Calibration
from khep_twin.units import SCAN_NS

KHEPERA = default_model()
"""Model of a robot that is not named."""

SCAN_LAG_S = SCAN_NS * 1e-9 / math.sqrt(12)
"""Standard deviation of a reading's age [s], which is uniform between the scan's start and end."""


@dataclass(frozen=True, slots=True)
class Ruler:
    """Standard deviations of a person's measurements (assumed).

    Attributes:
        distance_mm: For a distance by the ruler [mm].
        bearing_deg: For the direction of an object straight ahead, and for a counted turn [deg].
        base: For the wheel base, relative; by default that of published values, 52 to 54 mm.
    """

    distance_mm: float = 0.5
    bearing_deg: float = 1.5
    base: float = 0.015

    def __post_init__(self) -> None:
        """Raise a `FitError` for a negative value, or one too large for a fit."""
        for name, value, limit in (("ruler", self.distance_mm, 10), ("bearing", self.bearing_deg, 45)):
            if not 0 <= value <= limit:
                raise FitError(f"{name} = {value:g}; expected a standard deviation of 0 to {limit}")


@dataclass(frozen=True, slots=True)
class Misplacement:
    """Deviation of an object from its measured position.

    Attributes:
        distance: Additional distance [m].
        bearing: Additional bearing, counter-clockwise [rad].
        turn_error: Excess of the robot's true turns over those by its counters, relative.
        centre: Distance of the centre of turns from the middle of the axle, to the left [m].
    """

    distance: float = 0.0
    bearing: float = 0.0
    turn_error: float = 0.0
    centre: float = 0.0


IN_PLACE = Misplacement()


@dataclass(frozen=True, slots=True)
class Placement:
    """Object that stood straight ahead of a robot at its start.

    Attributes:
        poses: Subsequent poses of the robot, by its counters: x, y [m], heading [rad] (n, 3).
        distance: Distance from the robot's edge to the object's nearest point at the start [m], or a distance
            for each pose (n,).
        radius: Radius of the cylinder or the bulb, 0 for a wall [m].
        turn_rate: Fastest turn of the robot [rad/s].
        model: Model of the robot.
    """

    poses: Floats
    distance: float | Floats
    radius: float = 0.0
    turn_rate: float = 0.0
    model: RobotModel = KHEPERA

    def object_positions(self, misplacement: Misplacement = IN_PLACE) -> tuple[Floats, Floats]:
        """Return distances from the robot's edge [m] and bearings, counter-clockwise [rad], per pose (n,)."""
        (x, y, heading), body_radius = self.poses.T, self.model.body.radius
        heading = heading * (1 + misplacement.turn_error)
        x = x + misplacement.centre * np.sin(heading)
        y = y + misplacement.centre * (1 - np.cos(heading))
        distances = body_radius + self.distance + misplacement.distance + self.radius
        east, north = math.cos(misplacement.bearing), math.sin(misplacement.bearing)
        if self.radius == 0:
            # A wall's nearest point lies in the direction of its normal.
            return distances - x * east - y * north - body_radius, misplacement.bearing - heading
        forward, left = distances * east - x, distances * north - y
        bearings = np.angle(np.exp(1j * (np.arctan2(left, forward) - heading)))
        return np.hypot(forward, left) - self.radius - body_radius, bearings


@dataclass(frozen=True, slots=True)
class Readings:
    """Sensors' readings of an object.

    Attributes:
        name: Name in messages.
        placement: Position of the object, and poses of the robot.
        counts: Readings of the sensors around at these poses (n, n_sensors) [counts].
        power: Power of the lamp [W]; None for a wall or a cylinder.
        height: Height of the lamp's filament above the sensors [m].
    """

    name: str
    placement: Placement
    counts: Floats
    power: float | None = None
    height: float = 0.0


@dataclass(frozen=True, slots=True)
class FittedValue:
    """Fitted value of a calibration.

    Attributes:
        path: Location in the calibration: table, key, and number of the sensor.
        value: Fitted value, in the calibration's unit.
        interval: Half width of its 95 % confidence interval.
    """

    path: tuple[str, str] | tuple[str, str, int]
    value: float
    interval: float


@dataclass(frozen=True, slots=True)
class SensorsFit:
    """Fit of sensors to readings of objects.

    Attributes:
        calibration: Calibration with the fitted values, rounded.
        values: Fitted values; those that the readings do not determine are left out.
        rms: Root mean square of the residuals of each sensor, or of all [counts].
        misplacements: Misplacement of the object in each test.
    """

    calibration: Calibration
    values: tuple[FittedValue, ...]
    rms: tuple[float, ...]
    misplacements: tuple[Misplacement, ...]


def error_parameters(tests: Sequence[Readings], ruler: Ruler) -> list[Parameter]:
    """Return the errors of all tests as parameters: distances, bearings, those of turns and their centre."""
    # The wheels' radii are in inverse proportion to their distances from the centre.
    centre_mm = INEQUALITY_SPREAD * tests[0].placement.model.body.wheel_base * 1e3 / 4
    distance, base = max(ruler.distance_mm, 1e-3), max(ruler.base, 1e-6)
    lags = [math.degrees(test.placement.turn_rate * SCAN_LAG_S) for test in tests]
    bearings = [math.hypot(max(ruler.bearing_deg, 1e-3), lag) for lag in lags]
    return [
        *(Parameter(f"{test.name}: distance", 0, distance, prior=distance) for test in tests),
        *(
            Parameter(f"{test.name}: bearing", 0, bearing, prior=bearing)
            for test, bearing in zip(tests, bearings, strict=True)
        ),
        Parameter("turns", 0, base, prior=base),
        Parameter("centre of turns", 0, centre_mm, prior=centre_mm),
    ]


def jacobian_sparsity(tests: Sequence[Readings], n_per_sensor: int, n_shared: int = 0) -> NDArray[np.int64]:
    """Return the indices of the parameters of each residual for `least_squares`: by reading, then sensor.

    The parameters are `n_shared` of all residuals, `n_per_sensor` of each sensor, and `error_parameters`.
    """
    test_of_reading = np.repeat(np.arange(len(tests)), [len(test.counts) for test in tests])
    n_sensors: int = tests[0].counts.shape[1]
    test, sensor = np.repeat(test_of_reading, n_sensors), np.tile(np.arange(n_sensors), len(test_of_reading))
    first_error = n_shared + n_per_sensor * n_sensors
    shared_errors = [np.full_like(test, first_error + 2 * len(tests) + number) for number in range(2)]
    columns = [np.full_like(test, number) for number in range(n_shared)]
    columns += [n_shared + n_per_sensor * sensor + number for number in range(n_per_sensor)]
    return np.column_stack([*columns, first_error + test, first_error + len(tests) + test, *shared_errors])


def misplacements(values: Floats) -> list[Misplacement]:
    """Return the errors of each test from the values of `error_parameters`."""
    distances, bearings = values[:-2].reshape(2, -1)
    turn_error, centre_mm = values[-2:].tolist()
    return [
        Misplacement(distance / 1e3, math.radians(bearing), turn_error, centre_mm / 1e3)
        for distance, bearing in zip(distances.tolist(), bearings.tolist(), strict=True)
    ]
