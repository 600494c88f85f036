"""Fits of the infrared optics of the Khepera 1 to measured tables, and their residuals.

The tables are not part of the project; the environment variable KHEP_TWIN_REFERENCE_DATA names their
folder (with data/ and manual_data/). The printed values are those in khep_twin/assets/calibration.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin.lab.fit.infrared import Optics, View, unclipped_counts
from khep_twin.units import COUNTS_LIMIT, N_SENSORS, SENSOR_HEADINGS, SENSOR_POSITIONS
from tools.command_table import command_line

Floats = NDArray[np.float64]

CYLINDER_RADIUS = 0.027
SET_UP_BEARING = np.radians(2.2)
"""Corrections of the sampled set-up's bearings of wall and cylinder [rad]: they make left and right equal."""

MANUAL_SENSOR = 1
"""Sensor of the manual's figures 11 and 12, which name none: that of figure 13 which fits best."""

ROD_RADIUS, ROD_DISTANCE = 0.0035, 0.015
"""Obstacle of the manual's figure 12 [m], taken as a cylinder; its distance is from the sensor's face."""

MANUAL_SURFACES = {
    "white plastic": "white",
    "wood 2": "wood",
    "green styropor": "styropor",
    "copper": "copper",
    "pink sponge": "sponge",
    "grey plastic": "grey",
    "black plastic": "black",
}
"""Its materials that are built-in surfaces; of its two woods, one is enough."""

OTHER_WOOD, OBSTACLE_REFLECTANCE = 0.82, 1.2
"""Reflectances of the manual's "wood 1" and of the obstacle of its figure 12, as fitted."""

PEAK_DEG = 6
"""Largest angle from the peak of readings that count as on axis [degrees]."""

_ON_AXIS_WEIGHT = 8.0
_PRIOR = 200.0
USUAL, _SPREAD = np.array([4.0, 3.0]), np.array([4.0, 1.5])
"""Offset [mm] and lobe exponent of a usual sensor (assumed), which those of each are drawn to."""

OFFSET_PRIOR = 3.0


@dataclass(frozen=True, slots=True)
class MeasuredTable:
    """Readings of a robot in front of an object.

    Attributes:
        distances: Distances from the robot's edge to the object (n,) [m].
        bearings: Bearings of the object, counter-clockwise from ahead (n,) [rad].
        counts: Readings of the sensors (n, 8) [counts].
        radius: Radius of the cylinder [m]; 0 for a wall.
    """

    distances: Floats
    bearings: Floats
    counts: Floats
    radius: float

    def view(self, sensor: int, heading: float) -> View:
        """Return the view of a sensor with a heading [rad]."""
        return View.of(SENSOR_POSITIONS[sensor], heading, self.distances, self.bearings, self.radius)


def proximity(
    view: View, optics: Optics, reflectance: float = 1.0, limit_counts: int = COUNTS_LIMIT
) -> Floats:
    """Return the counts of a sensor without noise, not rounded (n_places,)."""
    return np.clip(unclipped_counts(view, optics, reflectance), 0, limit_counts)


def reference() -> Path:
    """Return the folder of the tables."""
    folder = os.environ.get("KHEP_TWIN_REFERENCE_DATA")
    if not folder:
        sys.exit("KHEP_TWIN_REFERENCE_DATA is not set; expected the folder with data/ and manual_data/")
    return Path(folder)


def sampled(folder: Path) -> list[MeasuredTable]:
    """Return the readings of the sampled robot before a wall and a cylinder."""
    tables: list[MeasuredTable] = []
    for name, radius in (("wall", 0.0), ("round", CYLINDER_RADIUS)):
        rows = np.genfromtxt(folder / "data" / f"evorobot_{name}_samples.csv", delimiter=",", skip_header=1)
        bearings = SET_UP_BEARING - np.radians(rows[:, 1])
        tables.append(MeasuredTable(rows[:, 0] / 1e3, bearings, rows[:, 2:], radius))
    return tables


def fit_sampled(tables: Sequence[MeasuredTable], sensor: int, heading: float) -> tuple[float, Optics]:
    """Fit heading [rad] and optics of one sensor of the sampled robot, by all bearings and on axis."""
    axes = [on_axis(table, sensor) for table in tables]

    def residuals(x: Floats) -> Floats:
        optics = Optics(x[1] * 1e5, x[2] * 100, *x[3:])
        errors = [proximity(table.view(sensor, x[0]), optics) - table.counts[:, sensor] for table in tables]
        means = [_ON_AXIS_WEIGHT * (axis @ error) for axis, error in zip(axes, errors, strict=True)]
        return np.concatenate([*errors, *means, _PRIOR * (x[3:] - USUAL) / _SPREAD])

    start = [heading, 9, 6, *USUAL]
    low, high = [-np.inf, 1, 0, 0, 0], [np.inf, 80, 20, 15, 8]
    x = least_squares(residuals, start, bounds=(low, high), x_scale=[0.05, 3, 1, 1, 1], max_nfev=60).x
    return float(x[0]), Optics(x[1] * 1e5, x[2] * 100, *x[3:])


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of one sensor before one object: model less robot.

    Attributes:
        everywhere: Residuals at all bearings (n,) [counts].
        on_axis: Residuals of the means near the peak, per distance [counts].
        half: Residual of the distance at half scale [m].
        peak: Residual of the peak's bearing [rad].
    """

    everywhere: Floats
    on_axis: Floats
    half: float
    peak: float


def peak(table: MeasuredTable, counts: Floats) -> float:
    """Return the bearing around which readings (n,) are centred [rad]."""
    return float(np.angle((counts * np.exp(1j * table.bearings)).sum()))


def on_axis(table: MeasuredTable, sensor: int) -> Floats:
    """Return the matrix that maps readings (n,) to their means near the peak, one per distance."""
    tangential = np.angle(np.exp(1j * (table.bearings - peak(table, table.counts[:, sensor]))))
    near = np.abs(tangential) <= np.radians(PEAK_DEG)
    rows = [near & (table.distances == distance) for distance in np.unique(table.distances)]
    return np.array([row / row.sum() for row in rows])


def compare(table: MeasuredTable, sensor: int, heading: float, optics: Optics) -> Residuals:
    """Return the residuals of a model."""
    measured = table.counts[:, sensor]
    modelled = proximity(table.view(sensor, heading), optics)
    axis, distances = on_axis(table, sensor), np.unique(table.distances)

    def half(counts: Floats) -> float:
        return float(np.interp(-511.5, -(axis @ counts), distances))

    return Residuals(
        modelled - measured,
        axis @ (modelled - measured),
        half(modelled) - half(measured),
        float(np.angle(np.exp(1j * (peak(table, modelled) - peak(table, measured))))),
    )


def rms(errors: Sequence[Floats]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.concatenate([error.ravel() for error in errors]) ** 2)))


def facing(distances: Floats, optics: Optics, reflectance: float = 1.0, limit: int = COUNTS_LIMIT) -> Floats:
    """Return the counts of a sensor face to face with a wall at these distances (n,) [m]."""
    return proximity(View(np.zeros(len(distances)), distances), optics, reflectance, limit)


def rod(bearings: Floats, optics: Optics, reflectance: float) -> Floats:
    """Return the counts of a sensor before the obstacle of figure 12 at bearings off its axis (n,) [rad]."""
    distances = np.full(len(bearings), ROD_DISTANCE + ROD_RADIUS)
    return proximity(View(bearings, distances, ROD_RADIUS), optics, reflectance)


def materials(folder: Path) -> dict[str, tuple[Floats, Floats]]:
    """Return the manual's figure 11: distances [m] and counts by material."""
    return _curves(folder / "manual_data" / "k1_fig11_proximity_vs_distance_materials.csv", "material")


def wooden_wall(folder: Path) -> list[tuple[Floats, Floats]]:
    """Return the manual's figure 13: distances [m] and counts of six sensors, from left to right."""
    path = folder / "manual_data" / "k1_fig13_proximity_vs_distance_wood_6sensors.csv"
    return list(_curves(path, "sensor").values())


def obstacle(folder: Path) -> tuple[Floats, Floats]:
    """Return the manual's figure 12: bearings [rad] and counts."""
    path = folder / "manual_data" / "k1_fig12_proximity_vs_angle_7mm_obstacle_15mm.csv"
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    return np.radians(rows[:, 0]), rows[:, 1]


def _curves(path: Path, column: str) -> dict[str, tuple[Floats, Floats]]:
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    # The plateau is drawn a little off.
    counts = np.where(rows["proximity_raw"] >= 1018, COUNTS_LIMIT, rows["proximity_raw"]).astype(np.float64)
    return {
        str(name): (rows["distance_mm"][rows[column] == name] / 1e3, counts[rows[column] == name])
        for name in dict.fromkeys(rows[column].tolist())
    }


def manual_residuals(
    folder: Path, sensors: Sequence[Optics], reflectances: dict[str, float]
) -> tuple[list[Floats], Floats, list[Floats]]:
    """Return model less robot for the manual's figures 11, 12 and 13, with reflectances by material."""
    optics, (bearings, counts) = sensors[MANUAL_SENSOR], obstacle(folder)
    eleven = [
        facing(*measured[:1], optics, reflectances[name]) - measured[1]
        for name, measured in materials(folder).items()
    ]
    walls = zip(wooden_wall(folder), sensors, strict=False)
    thirteen = [
        facing(distances, sensor_optics, reflectances["wood 2"]) - measured
        for (distances, measured), sensor_optics in walls
    ]
    return eleven, rod(bearings, optics, reflectances["obstacle"]) - counts, thirteen


def fit_manual(folder: Path) -> tuple[list[Optics], dict[str, float]]:
    """Fit six sensors of the manual's robot with one lobe, and reflectances beside white plastic."""
    names = [*(name for name in materials(folder) if name != "white plastic"), "obstacle"]

    def split(x: Floats) -> tuple[list[Optics], dict[str, float]]:
        sensors = [Optics(x[i] * 1e5, x[6 + i] * 100, x[12 + i], x[18]) for i in range(6)]
        return sensors, {"white plastic": 1.0, **dict(zip(names, x[19:].tolist(), strict=True))}

    def residuals(x: Floats) -> Floats:
        eleven, twelve, thirteen = manual_residuals(folder, *split(x))
        # Figure 12 has ten points, the others ten times as many.
        prior = OFFSET_PRIOR * (x[12:18] - USUAL[0])
        return np.concatenate([*eleven, twelve, *(1.5 * errors for errors in thirteen), prior])

    start = [*[10.0] * 6, *[4.0] * 6, *[USUAL[0]] * 6, 1.5, *[0.8] * len(names)]
    low = [*[1.0] * 6, *[0.0] * 6, *[0.0] * 6, 0.0, *[0.01] * len(names)]
    high = [*[80.0] * 6, *[20.0] * 6, *[15.0] * 6, 8.0, *[2.0] * len(names)]
    return split(least_squares(residuals, start, bounds=(low, high), max_nfev=60).x)


def main() -> None:
    """Fit both robots; print the values of their calibrations and the residuals."""
    command_line(__doc__).parse_args()
    folder = reference()
    tables = sampled(folder)
    fits = [fit_sampled(tables, sensor, SENSOR_HEADINGS[sensor]) for sensor in range(N_SENSORS)]
    print("khepera1\nheading_deg =", [round(float(np.degrees(heading)), 1) for heading, _ in fits])
    show_optics([optics for _, optics in fits])
    for table in tables:
        _residuals(f"radius {table.radius}", table, fits)
    for fitted, unseen in (tables, tables[::-1]):
        alone = [fit_sampled([fitted], sensor, SENSOR_HEADINGS[sensor]) for sensor in range(N_SENSORS)]
        _residuals(f"radius {unseen.radius}, not fitted", unseen, alone)
    sensors, reflectances = fit_manual(folder)
    print("\nkhepera1-manual")
    show_optics(sensors)
    print({name: round(value, 3) for name, value in reflectances.items()})
    eleven, twelve, thirteen = manual_residuals(folder, sensors, reflectances)
    print(f"figure 11 {rms(eleven):.1f}, figure 12 {rms([twelve]):.1f}, figure 13 {rms(thirteen):.1f}")


def show_optics(sensors: Sequence[Optics]) -> None:
    """Print optics in the form of a calibration."""
    print("gain_counts_mm2 =", [round(optics.gain_counts_mm2, -3) for optics in sensors])
    print("threshold_counts =", [round(optics.threshold_counts) for optics in sensors])
    for name in ("offset_mm", "lobe_exponent"):
        print(name, "=", [round(getattr(optics, name), 2) for optics in sensors])


def _residuals(title: str, table: MeasuredTable, fits: Sequence[tuple[float, Optics]]) -> None:
    residuals = [compare(table, sensor, *fit) for sensor, fit in enumerate(fits)]
    print(
        f"{title}: rms {rms([residual.everywhere for residual in residuals]):.1f} at all bearings, "
        f"{rms([residual.on_axis for residual in residuals]):.1f} on axis, "
        f"half scale within {max(abs(residual.half) for residual in residuals) * 1e3:.2f} mm, "
        f"peak within {np.degrees(max(abs(residual.peak) for residual in residuals)):.1f} deg"
    )
