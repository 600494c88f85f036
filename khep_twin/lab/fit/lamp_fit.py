"""Fit of one robot's light receivers to readings of a lamp: heading, lobe width and gain of each.

The model is that of `khep_twin.sensing.ambient`, for many positions of a lamp at once. All eight receivers
are fitted together, as they share the dark level, the brightest level, the diffuse part, and the errors of
the ruler in each test.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats, Parameter, expected, least_squares
from khep_twin.lab.fit.placement import (
    IN_PLACE,
    SCAN_LAG_S,
    Misplacement,
    Readings,
    Ruler,
    misplacements,
    owners_of,
    unknowns,
)
from khep_twin.sensing.calibration import AmbientCalibration, Calibration
from khep_twin.units import BODY_RADIUS, N_SENSORS, SENSOR_LABELS, SENSOR_POSITIONS

_LEAST_LIGHT = 40.0
"""Least depth of a reading below the dark level to fit a receiver [counts]."""

_OWN = 3
"""Number of parameters of a receiver: heading, gain, lobe exponent."""


@dataclass(frozen=True, slots=True)
class LampTable:
    """Lamp around a robot.

    Attributes:
        positions: Filaments from the robot's centre: forward, left, and above the sensors (n, 3) [m].
        power: Power of the lamp [W].
    """

    positions: Floats
    power: float

    @classmethod
    def of(cls, test: Readings, moved: Misplacement = IN_PLACE) -> Self:
        """Return the lamp of a test, whose bulb stood where the placement and its error say."""
        distances, bearings = test.placement.seen(moved)
        away, height = BODY_RADIUS + distances + test.placement.radius, np.full(len(bearings), test.height)
        positions = [away * np.cos(bearings), away * np.sin(bearings), height]
        return cls(np.column_stack(positions), test.power or 0.0)


@dataclass(frozen=True, slots=True)
class LampFit:
    """Fit of the receivers.

    Attributes:
        ambient: Fitted calibration.
        gain_intervals: Halves of the gains' 95 % confidence intervals, relative (8,).
        heading_intervals: Halves of the headings' 95 % confidence intervals (8,) [deg].
        lobe_intervals: Halves of the lobe exponents' 95 % confidence intervals (8,).
        dark_interval: Half of the dark level's 95 % confidence interval [counts].
        diffuse_interval: Half of the diffuse part's 95 % confidence interval.
        rms: Root mean square of the residuals [counts].
        moved: Where the lamp stood in each test.
    """

    ambient: AmbientCalibration
    gain_intervals: tuple[float, ...]
    heading_intervals: tuple[float, ...]
    lobe_intervals: tuple[float, ...]
    dark_interval: float
    diffuse_interval: float
    rms: float
    moved: tuple[Misplacement, ...]


def ambient_counts(table: LampTable, channel: int, calibration: AmbientCalibration) -> Floats:
    """Return the readings of a receiver without noise and with a lamp in full sight, not rounded (n,)."""
    columns = (calibration.heading_deg, calibration.gain_counts_mm2_per_w, calibration.lobe_exponent)
    receiver = tuple(column[channel] for column in columns)
    levels = calibration.dark_counts, calibration.floor_counts, calibration.diffuse
    return _counts(table, channel, receiver, levels, calibration.offset_mm)


def fit_lamps(tests: Sequence[Readings], start: Calibration, ruler: Ruler | None = None) -> LampFit:
    """Fit the receivers to the readings.

    Args:
        tests: Readings of lamps.
        start: Initial values, and the rest of the receivers.
        ruler: Precision of the lamps' places; None for the usual one.

    Raises:
        FitError: The readings do not determine a receiver's heading, gain or lobe, or the shared values.
    """
    before = start.ambient
    counts = np.concatenate([test.counts for test in tests])
    for name, readings in zip(SENSOR_LABELS, counts.T, strict=True):
        if np.ptp(readings) < _LEAST_LIGHT:
            raise FitError(
                f"{name}: the gain for lamps cannot be determined: its readings differ by less than "
                f"{_LEAST_LIGHT:.0f} counts; expected a turn of 360 degrees in a lamp's light"
            )
    # Without saturated readings the level of the brightest light stays as it was.
    saturated = bool((counts < before.floor_counts + 4 * before.noise_counts).sum() >= N_SENSORS)
    shared = _shared(before, saturated)
    n_shared = len(shared)
    n_levels = n_shared + _OWN * N_SENSORS

    def split(x: Floats) -> tuple[tuple[float, float, float], Floats]:
        floor = float(x[2]) if saturated else before.floor_counts
        return (float(x[0]), floor, float(x[1])), x[n_shared:n_levels].reshape(N_SENSORS, _OWN)

    noise = max(before.noise_counts, 1.0)

    def left(x: Floats) -> Floats:
        common, each = split(x)
        lamps = [
            LampTable.of(test, moved) for test, moved in zip(tests, misplacements(x[n_levels:]), strict=True)
        ]
        columns = [
            np.concatenate([_counts(lamp, sensor, tuple(own), common, before.offset_mm) for lamp in lamps])
            for sensor, own in enumerate(each)
        ]
        # Noise above the highest reading is cut off, as it is in the dark.
        means = expected(np.column_stack(columns), before.noise_counts, before.ceiling_counts)
        return ((means - counts) / noise).ravel()

    parameters = [*shared, *_receivers(before), *unknowns(tests, ruler or Ruler())]
    wish = "readings of a lamp in turns of 360 degrees, at two distances and more"
    owners = owners_of(tests, _OWN, n_shared)
    # The residuals tell the noise, by which they are to be compared with the errors of the ruler.
    noise *= max(least_squares(left, parameters, wish, owners=owners).rms, 0.1)
    found = least_squares(left, parameters, wish, unit_variance=True, owners=owners)
    (dark, floor, diffuse), each = split(found.values)
    _, widths = split(found.intervals)
    update = {
        "heading_deg": tuple(np.round(each[:, 0], 1).tolist()),
        "gain_counts_mm2_per_w": tuple(np.round(each[:, 1], -3).tolist()),
        "lobe_exponent": tuple(np.round(each[:, 2], 2).tolist()),
        "dark_counts": round(dark, 1),
        "floor_counts": round(floor, 1),
        "diffuse": round(diffuse, 3),
    }
    lag = max(CONFIDENCE * math.degrees(test.placement.turning * SCAN_LAG_S) for test in tests)
    return LampFit(
        before.model_copy(update=update),
        tuple((widths[:, 1] / each[:, 1]).tolist()),
        tuple(np.hypot(widths[:, 0], lag).tolist()),
        tuple(widths[:, 2].tolist()),
        float(found.intervals[0]),
        float(found.intervals[1]),
        found.rms * noise,
        tuple(misplacements(found.values[n_levels:])),
    )


def _shared(before: AmbientCalibration, saturated: bool) -> list[Parameter]:
    """Return the parameters of all receivers."""
    floor = Parameter("level of the brightest light", before.floor_counts, 20, 20, " counts", 0, 1023)
    return [
        Parameter("dark level", before.dark_counts, 20, 20, " counts", 0, 1023),
        Parameter("diffuse part", before.diffuse, 0.1, 0.1, "", 0, 1),
        *([floor] if saturated else []),
    ]


def _receivers(before: AmbientCalibration) -> list[Parameter]:
    """Return the parameters of each receiver in turn."""
    found: list[Parameter] = []
    for sensor, name in enumerate(SENSOR_LABELS):
        gain = before.gain_counts_mm2_per_w[sensor]
        found += [
            Parameter(f"{name}: heading to lamps", before.heading_deg[sensor], 10, 10, " deg"),
            Parameter(f"{name}: gain for lamps", gain, gain / 4, gain / 5, " counts mm2/W", 0.0),
            Parameter(f"{name}: width for lamps", before.lobe_exponent[sensor], 0.5, 1, "", 0, 20),
        ]
    return found


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
