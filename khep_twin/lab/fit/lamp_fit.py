"""Fit of one robot's light receivers to readings of a lamp: heading, lobe width and gain of each.

The model is that of `khep_twin.sensing.ambient`, for many positions of a lamp at once. All eight receivers
are fitted together, as they share the dark level, the brightest level and the diffuse part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats, Parameter, least_squares
from khep_twin.lab.sensor_test.sensor_test import SENSORS
from khep_twin.sensing.calibration import AmbientCalibration, Calibration
from khep_twin.units import N_SENSORS, SCAN_NS, SENSOR_POSITIONS

_LEAST_LIGHT = 40.0
"""Least depth of a reading below the dark level to fit a receiver [counts]."""


@dataclass(frozen=True, slots=True)
class LampTable:
    """Readings of a lamp around a robot.

    Attributes:
        positions: Filaments from the robot's centre: forward, left, and above the sensors (n, 3) [m].
        counts: Readings of the receivers (n, 8) [counts].
        power: Power of the lamp [W].
        turning: Fastest turn of the robot [rad/s].
    """

    positions: Floats
    counts: Floats
    power: float
    turning: float = 0.0


@dataclass(frozen=True, slots=True)
class LampFit:
    """Fit of the receivers.

    Attributes:
        ambient: Fitted calibration.
        gain_intervals: Halves of the gains' 95 % confidence intervals, relative (8,).
        heading_intervals: Halves of the headings' 95 % confidence intervals (8,) [deg].
        rms: Root mean square of the residuals [counts].
    """

    ambient: AmbientCalibration
    gain_intervals: tuple[float, ...]
    heading_intervals: tuple[float, ...]
    rms: float


def ambient_counts(table: LampTable, channel: int, calibration: AmbientCalibration) -> Floats:
    """Return the readings of a receiver without noise and with a lamp in full sight, not rounded (n,)."""
    columns = (calibration.heading_deg, calibration.gain_counts_mm2_per_w, calibration.lobe_exponent)
    receiver = tuple(column[channel] for column in columns)
    levels = calibration.dark_counts, calibration.floor_counts, calibration.diffuse
    return _counts(table, channel, receiver, levels, calibration.offset_mm)


def fit_lamps(tables: Sequence[LampTable], start: Calibration) -> LampFit:
    """Fit the receivers to the readings.

    Raises:
        FitError: The readings do not determine a receiver's heading, gain or lobe, or the shared values.
    """
    before = start.ambient
    counts = np.concatenate([table.counts for table in tables])
    for name, readings in zip(SENSORS, counts.T, strict=True):
        if np.ptp(readings) < _LEAST_LIGHT:
            raise FitError(
                f"{name}: the gain for lamps cannot be determined: its readings differ by less than "
                f"{_LEAST_LIGHT:.0f} counts; expected a turn of 360 degrees in a lamp's light"
            )
    shared = [
        Parameter("dark level", before.dark_counts, 20, 20, " counts", 0, 1023),
        # Without saturated readings the level of the brightest light stays as it was.
        Parameter("diffuse part", before.diffuse, 0.1, 0.1, "", 0, 1),
    ]
    saturated = (counts < before.floor_counts + 4 * before.noise_counts).sum() >= N_SENSORS
    if saturated:
        shared.append(
            Parameter("level of the brightest light", before.floor_counts, 20, 20, " counts", 0, 1023)
        )
    own: list[Parameter] = []
    for sensor, name in enumerate(SENSORS):
        gain = before.gain_counts_mm2_per_w[sensor]
        own += [
            Parameter(f"{name}: heading to lamps", before.heading_deg[sensor], 10, 10, " deg"),
            Parameter(f"{name}: gain for lamps", gain, gain / 4, gain / 5, " counts mm2/W", 0.0),
            Parameter(f"{name}: width for lamps", before.lobe_exponent[sensor], 0.5, 1, "", 0, 20),
        ]

    def split(x: Floats) -> tuple[tuple[float, float, float], Floats]:
        floor = float(x[2]) if saturated else before.floor_counts
        return (float(x[0]), floor, float(x[1])), x[len(shared) :].reshape(N_SENSORS, 3)

    def left(x: Floats) -> Floats:
        common, each = split(x)
        return np.concatenate(
            [
                _counts(table, sensor, tuple(each[sensor]), common, before.offset_mm)
                - table.counts[:, sensor]
                for table in tables
                for sensor in range(N_SENSORS)
            ]
        )

    found = least_squares(
        left, [*shared, *own], "readings of a lamp in turns of 360 degrees, at two distances and more"
    )
    (dark, floor, diffuse), each = split(np.array(found.values))
    widths = np.array(found.intervals[len(shared) :]).reshape(N_SENSORS, 3)
    update = {
        "heading_deg": tuple(np.round(each[:, 0], 1).tolist()),
        "gain_counts_mm2_per_w": tuple(np.round(each[:, 1], -3).tolist()),
        "lobe_exponent": tuple(np.round(each[:, 2], 2).tolist()),
        "dark_counts": round(dark, 1),
        "floor_counts": round(floor, 1),
        "diffuse": round(diffuse, 3),
    }
    # The age of a reading within a scan is unknown: it is uniform between the scan's beginning and end.
    lag = CONFIDENCE * SCAN_NS * 1e-9 / math.sqrt(12)
    blurred = math.degrees(lag * max(table.turning for table in tables))
    return LampFit(
        before.model_copy(update=update),
        tuple((widths[:, 1] / each[:, 1]).tolist()),
        tuple(np.hypot(widths[:, 0], blurred).tolist()),
        found.rms,
    )


def _counts(
    table: LampTable,
    channel: int,
    receiver: tuple[float, ...],
    levels: tuple[float, float, float],
    offset_mm: float,
) -> Floats:
    """Return counts; receiver is heading [deg], gain, exponent; levels are dark, brightest, diffuse part."""
    (heading_deg, gain, exponent), (dark, floor, diffuse) = receiver, levels
    ways = table.positions - np.array([*SENSOR_POSITIONS[channel], 0.0])
    distances = np.sqrt((ways**2).sum(axis=1))
    heading = np.radians(heading_deg)
    cosines = (ways[:, 0] * np.cos(heading) + ways[:, 1] * np.sin(heading)) / distances
    straight = np.where(cosines > 0, np.abs(cosines) ** exponent, 0)
    lobe = (1 - diffuse) * straight + diffuse * (1 + cosines) / 2
    light = gain * table.power * lobe / np.maximum(distances * 1e3 - offset_mm, 1) ** 2
    return np.maximum(dark - light, floor)
