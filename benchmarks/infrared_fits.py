"""Fits of the infrared optics to measured tables, and what is left: `python -m benchmarks.infrared_fits`.

The tables are not part of the project; the environment variable KHEP_TWIN_REFERENCE_DATA names the folder in
which they lie (data/ and manual_data/). The printed values are those in khep_twin/assets/calibration.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin.lab.fit.infrared import TANGENTS, Bench, MeasuredTable, Optics, proximity
from khep_twin.units import N_SENSORS, SENSOR_HEADINGS

Floats = NDArray[np.float64]

CYLINDER_RADIUS = 0.027
SET_UP_BEARING = np.radians(2.2)
"""Corrections of the sampled set-up's bearings of wall and cylinder [rad]: they make left and right equal."""

MANUAL = Optics(1_205_400, 333.8, 0.01, 3.72, 1.14)
"""The sensor of the manual's figure 11, whose gain is for white plastic."""

MANUAL_SURFACES = {
    "white plastic": "white",
    "wood 2": "wood",
    "green styropor": "styropor",
    "copper": "copper",
    "pink sponge": "sponge",
    "grey plastic": "grey",
    "black plastic": "black",
}
"""Its materials that are built-in surfaces; "wood 1" is left out, one wood being enough."""

PEAK_DEG = 6
"""Largest angle from the peak of readings that count as on axis [degrees]."""

_ON_AXIS_WEIGHT = 8.0
_PRIOR = 200.0
_SHARED = np.array([5.58, 1.04, 0.18])
"""Offset, lobe and incidence exponent of one fit to all sensors, which those of each are drawn to."""


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
    """Fit one sensor of the sampled robot: heading [rad] and optics, by all bearings, then those on axis."""
    axes = [on_axis(table, sensor) for table in tables]

    def left(x: Floats) -> Floats:
        optics = Optics(x[1] * 1e5, x[2] * 100, *x[3:])
        errors = [
            proximity(table.view(sensor, x[0]), TANGENTS, optics) - table.counts[:, sensor]
            for table in tables
        ]
        means = [_ON_AXIS_WEIGHT * (axis @ error) for axis, error in zip(axes, errors, strict=True)]
        return np.concatenate([*errors, *means, _PRIOR * (x[3:] - _SHARED) / [2, 1, 0.2]])

    start = [heading, 13, 6, *_SHARED]
    low, high = [-np.inf, 1, 0, 0, 0, 0], [np.inf, 80, 11, 15, 8, 3]
    x = least_squares(left, start, bounds=(low, high), x_scale=[0.05, 3, 1, 1, 1, 0.2], max_nfev=60).x
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
    fit_inputs = table.counts[:, sensor]
    modelled = proximity(table.view(sensor, heading), TANGENTS, optics)
    axis, distances = on_axis(table, sensor), np.unique(table.distances)

    def half(counts: Floats) -> float:
        return float(np.interp(-511.5, -(axis @ counts), distances))

    return Residuals(
        modelled - fit_inputs,
        axis @ (modelled - fit_inputs),
        half(modelled) - half(fit_inputs),
        float(np.angle(np.exp(1j * (peak(table, modelled) - peak(table, fit_inputs))))),
    )


def rms(errors: Sequence[Floats]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.concatenate([error.ravel() for error in errors]) ** 2)))


def facing(distances: Floats, optics: Optics, reflectance: float = 1.0, limit: int = 1023) -> Floats:
    """Return the counts of a sensor face to face with a wall at these distances (n,) [m]."""
    bench = Bench((0.0, 0.0), 0.0, TANGENTS, 0.0)
    view = bench.wall(distances, np.zeros(len(distances)))
    return proximity(view, TANGENTS, optics, reflectance, limit)


def materials(folder: Path) -> dict[str, tuple[Floats, Floats]]:
    """Return the manual's figure 11: distances [m] and counts by material."""
    rows = np.genfromtxt(
        folder / "manual_data" / "k1_fig11_proximity_vs_distance_materials.csv",
        delimiter=",",
        names=True,
        dtype=None,
        encoding="utf-8",
    )
    # The plateau is drawn a little low.
    counts = np.where(rows["proximity_raw"] >= 1018, 1023, rows["proximity_raw"]).astype(np.float64)
    return {
        str(name): (rows["distance_mm"][rows["material"] == name] / 1e3, counts[rows["material"] == name])
        for name in dict.fromkeys(rows["material"].tolist())
    }


def khepera2_paper(folder: Path, side: str, sensor: int) -> tuple[Floats, Floats]:
    """Return a Khepera II sensor's distances [m] and counts before white paper, at its basic gain."""
    rows = np.genfromtxt(
        folder / "manual_data" / "iran_proximity_curves.csv",
        delimiter=",",
        names=True,
        dtype=None,
        encoding="utf-8",
    )
    wanted = (
        (rows["test"] == f"A0_12_paper_{side}")
        & (rows["sensor_fig7_number"] == sensor)
        & (rows["kind"] == "marker")
    )
    return rows["distance_mm"][wanted] / 1e3, rows["mean_raw"][wanted].astype(np.float64)


def main() -> None:
    """Fit the sampled robot and print the values of its calibration."""
    tables = sampled(reference())
    fits = [fit_sampled(tables, sensor, SENSOR_HEADINGS[sensor]) for sensor in range(N_SENSORS)]
    print("heading_deg =", [round(float(np.degrees(heading)), 1) for heading, _ in fits])
    print("gain_counts_mm2 =", [round(optics.gain_counts_mm2, -3) for _, optics in fits])
    print("threshold_counts =", [round(optics.threshold_counts) for _, optics in fits])
    for name in ("offset_mm", "lobe_exponent", "incidence_exponent"):
        print(name, "=", [round(getattr(optics, name), 2) for _, optics in fits])
    for table in tables:
        found = [compare(table, sensor, *fits[sensor]) for sensor in range(N_SENSORS)]
        print(
            f"radius {table.radius}: rms {rms([each.everywhere for each in found]):.1f} at all bearings, "
            f"{rms([each.on_axis for each in found]):.1f} on axis, "
            f"half scale within {max(abs(each.half) for each in found) * 1e3:.2f} mm, "
            f"peak within {np.degrees(max(abs(each.peak) for each in found)):.1f} deg"
        )


if __name__ == "__main__":
    main()
