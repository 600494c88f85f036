"""Fits of the infrared optics of Khepera IIs: the manufacturer's robot, another one, and the middle of both.

The tables are located as in `studies.infrared_fits`. The manufacturer's robot is `khepera2-manual`.
`khepera2` has its optics with the geometric mean of both robots' gains, and the means of their readings at
rest. A third robot, of which only means at rest are published, is not fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin.lab.fit.infrared import Optics, View, unclipped_counts
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration
from khep_twin.units import N_SENSORS
from studies.infrared_fits import OFFSET_PRIOR, USUAL, reference, show_optics
from tools.command_table import command_line

Floats = NDArray[np.float64]

FACING_DEG = (90, 45, 0, 0, -45, -90, 180, 180)
"""Bearings of the wall as each sensor of pykhepera's robot was turned to it [degrees]."""

ON_AXIS = (2, 3)
"""Sensors whose readings before a wall straight ahead are known of both robots."""

FITTED_DAYS = (30, 31, 3)
"""Days of pykhepera's table that are fitted; the two others check the fit."""

REST_MEAN, REST_RANGE = 84, (56, 133)
"""Means of a hundred readings at rest of a third robot, of all sensors and by sensor [counts]: nothing is
fitted to them (koshov/IAR-Khepera-Python-comms, Edinburgh)."""

_LIMIT = 1020


@dataclass(frozen=True, slots=True)
class Report:
    """Curve of K-Team's report on the Khepera II at its basic gain.

    Attributes:
        sensor: Number of the sensor.
        is_aside: Whether the target stands at the right side, not ahead.
        is_robot: Whether it is another robot, not white paper.
        distances: Distances from the face of the sensor that looks straight at it (n,) [m].
        counts: Readings (n,) [counts].
    """

    sensor: int
    is_aside: bool
    is_robot: bool
    distances: Floats
    counts: Floats

    def view(self, heading: float) -> View:
        """Return the view of the sensor with a heading [rad]."""
        body = find_model("khepera2").body
        faces = body.sensor_positions
        bearings = np.full(len(self.distances), np.radians(-90 if self.is_aside else 0))
        edge, radius = -faces[5][1] if self.is_aside else faces[2][0], body.radius if self.is_robot else 0.0
        return View.of(faces[self.sensor], heading, self.distances, bearings, radius, edge)


def khepera2_report(folder: Path) -> list[Report]:
    """Return the curves of the Khepera II's sensors before white paper and another robot."""
    path = folder / "manual_data" / "iran_proximity_curves.csv"
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    curves: list[Report] = []
    for target in ("paper", "robot"):
        for side in ("front", "side"):
            part = rows[(rows["test"] == f"A0_12_{target}_{side}") & (rows["kind"] == "marker")]
            for sensor in np.unique(part["sensor_fig7_number"]).tolist():
                sensor_rows = part[part["sensor_fig7_number"] == sensor]
                distances, counts = (
                    sensor_rows["distance_mm"] / 1e3,
                    sensor_rows["mean_raw"].astype(np.float64),
                )
                curves.append(Report(int(sensor), side == "side", target == "robot", distances, counts))
    return curves


def fit_khepera2(
    folder: Path, headings: Sequence[float], lobe: float = 4.0
) -> tuple[dict[int, Optics], float]:
    """Fit the sensors 1 to 5 of the Khepera II with a lobe, and the reflectance of another robot's shell."""
    curves = khepera2_report(folder)

    def split(x: Floats) -> tuple[dict[int, Optics], float]:
        sensors = {i + 1: Optics(x[i] * 1e5, -x[5 + i] * 100, x[10 + i], lobe) for i in range(5)}
        return sensors, float(x[15])

    def residuals(x: Floats) -> Floats:
        sensors, shell = split(x)
        errors = [
            np.minimum(
                unclipped_counts(
                    curve.view(headings[curve.sensor]),
                    sensors[curve.sensor],
                    shell if curve.is_robot else 1.0,
                ),
                _LIMIT,
            )
            - curve.counts
            for curve in curves
        ]
        return np.concatenate([*errors, OFFSET_PRIOR * (x[10:15] - USUAL[0])])

    start = [*[2.5] * 5, *[0.9] * 5, *[USUAL[0]] * 5, 0.2]
    low, high = [*[0.3] * 5, *[0.0] * 10, 0.01], [*[20.0] * 5, *[3.0] * 5, *[15.0] * 5, 2.0]
    return split(least_squares(residuals, start, bounds=(low, high), max_nfev=60).x)


@dataclass(frozen=True, slots=True)
class Wall:
    """Table of pykhepera's robot before a wall, each sensor turned to it.

    Attributes:
        days: Days of the readings (n,).
        sensors: Numbers of the sensors (n,).
        gaps: Distances of the wall from the robot's edge (n,) [m].
        counts: Readings (n,) [counts].
    """

    days: NDArray[np.int64]
    sensors: NDArray[np.int64]
    gaps: Floats
    counts: Floats

    def means(self, sensor: int, days: Sequence[int]) -> tuple[Floats, Floats]:
        """Return the distances [m] and mean counts of a sensor on some days."""
        rows = (self.sensors == sensor) & np.isin(self.days, days)
        gaps = np.unique(self.gaps[rows])
        return gaps, np.array([self.counts[rows & (self.gaps == gap)].mean() for gap in gaps])


def pykhepera_wall(folder: Path) -> Wall:
    """Return pykhepera's calibration of a Khepera II on five days."""
    path = folder / "data" / "khepera2_pykhepera_distance_calibration.csv"
    rows = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 1, 3, 4))
    days, sensors = rows[:, :2].T.astype(np.int64)
    return Wall(days, sensors, rows[:, 2] / 1e3, rows[:, 3])


def fit_wall(wall: Wall) -> tuple[float, list[float]]:
    """Fit pykhepera's robot: its gain over the manufacturer's, by the sensors ahead, and readings at rest."""
    manual, body = calibration.read("khepera2-manual")[0], find_model("khepera2").body
    rests: list[float] = []
    gains: list[float] = []
    for sensor in range(N_SENSORS):
        gaps, counts = wall.means(sensor, FITTED_DAYS)
        heading, bearings = np.radians(manual.heading_deg[sensor]), np.full(len(gaps), FACING_DEG[sensor])
        view = View.of(body.sensor_positions[sensor], heading, gaps, np.radians(bearings), 0, body.radius)
        optics = Optics.of(manual.proximity, sensor)
        light = unclipped_counts(view, optics) + optics.threshold_counts

        def residuals(x: Floats, light: Floats = light, counts: Floats = counts) -> Floats:
            return np.minimum(x[0] * light + 100 * x[1], _LIMIT) - counts

        gain, rest = least_squares(residuals, [0.5, 0.5], bounds=(0, 5)).x
        gains += [gain] if sensor in ON_AXIS else []
        rests.append(float(rest) * 100)
    return float(np.exp(np.mean(np.log(gains)))), rests


def noise_at_rest(wall: Wall, nearest: float = 0.05) -> tuple[float, float]:
    """Return the noise of pykhepera's robot far from a wall, within a day and from day to day [counts].

    Second differences along the distance, and deviations from the means of the days.

    Args:
        wall: Table.
        nearest: Least distance that counts [m].
    """
    within: list[float] = []
    between: list[float] = []
    far = wall.gaps >= nearest - 1e-9
    for sensor in range(N_SENSORS):
        rows = far & (wall.sensors == sensor)
        for day in np.unique(wall.days):
            within += (np.diff(wall.counts[rows & (wall.days == day)], 2) ** 2 / 6).tolist()
        for gap in np.unique(wall.gaps[rows]):
            between.append(float(wall.counts[rows & (wall.gaps == gap)].var(ddof=1)))
    return float(np.sqrt(np.mean(within))), float(np.sqrt(np.mean(between)))


def main() -> None:
    """Fit both robots and print the values of both calibrations, and the noise at rest."""
    command_line(__doc__).parse_args()
    folder = reference()
    optics_by_sensor, shell = fit_khepera2(folder, np.radians([90, 45, 10, -10, -45, -90]).tolist())
    print(f"khepera2-manual, sensors 1 to 5; reflectance of a robot's shell {shell:.3f}")
    show_optics(list(optics_by_sensor.values()))
    manual, wall = calibration.read("khepera2-manual")[0].proximity, pykhepera_wall(folder)
    gain, rests = fit_wall(wall)
    print(f"\npykhepera's robot: {gain:.2f} times the gain; at rest", np.round(rests).tolist())
    print("\nkhepera2")
    middle = np.array(manual.gain_counts_mm2) * np.sqrt(gain)
    print("gain_counts_mm2 =", np.round(middle, -3).tolist())
    middle_rests = (np.array(rests) - np.array(manual.threshold_counts)) / 2
    print("threshold_counts =", (-np.round(middle_rests)).tolist(), f"mean {middle_rests.mean():.0f}")
    within, between = noise_at_rest(wall)
    print(f"noise far from the wall: {within:.1f} counts within a day, {between:.1f} from day to day")
