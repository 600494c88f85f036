"""Fit of one robot's light receivers to readings of a lamp: heading, lobe width and gain of each.

The model is that of `khep_twin.sensing.ambient`, vectorized over positions of a lamp. All receivers are
fitted together, as they share the dark level, the brightest level, the diffuse part, and the errors of the
ruler in each test.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats, Parameter, expected_readings, least_squares
from khep_twin.lab.fit.placement import (
    IN_PLACE,
    SCAN_LAG_S,
    FittedValue,
    Misplacement,
    Readings,
    Ruler,
    SensorsFit,
    error_parameters,
    jacobian_sparsity,
    misplacements,
)
from khep_twin.sensing.calibration import AmbientCalibration, Calibration
from khep_twin.units import COUNTS_LIMIT

_MIN_RANGE = 40.0
"""Smallest range of a receiver's readings to fit it [counts]."""
_N_PARAMETERS = 3
"""Number of parameters of a receiver: heading, gain, lobe exponent."""


@dataclass(frozen=True, slots=True)
class LampPositions:
    """Positions of a lamp around a robot.

    Attributes:
        positions: Filament relative to the robot's centre: forward, left, above the sensors (n, 3) [m].
        power: Power of the lamp [W].
        receivers: Positions of the receivers on the robot [m].
    """

    positions: Floats
    power: float
    receivers: Sequence[tuple[float, float]]

    @classmethod
    def of(cls, test: Readings, misplacement: Misplacement = IN_PLACE) -> Self:
        """Return the lamp of a test, with its bulb at the placement plus the misplacement."""
        distances, bearings = test.placement.object_positions(misplacement)
        body = test.placement.model.body
        radii, height = body.radius + distances + test.placement.radius, np.full(len(bearings), test.height)
        positions = [radii * np.cos(bearings), radii * np.sin(bearings), height]
        return cls(np.column_stack(positions), test.power or 0.0, body.sensor_positions)


def ambient_counts(
    lamp: LampPositions, channel: int, calibration: AmbientCalibration, largest: int = COUNTS_LIMIT
) -> Floats:
    """Return the readings of a receiver without noise, for an unobstructed lamp, not rounded (n,).

    `largest` is the converter's largest count.
    """
    columns = (calibration.heading_deg, calibration.gain_counts_mm2_per_w, calibration.lobe_exponent)
    receiver = tuple(column[channel] for column in columns)
    levels = calibration.dark_counts, calibration.floor_counts, calibration.diffuse
    counts = _counts(lamp, channel, receiver, levels, calibration.offset_mm)
    return largest - counts if calibration.rises_with_light else counts


def fit_lamps(tests: Sequence[Readings], start: Calibration, ruler: Ruler | None = None) -> SensorsFit:
    """Fit the receivers to the readings.

    Args:
        tests: Readings of lamps.
        start: Initial values, and the receivers' other parameters.
        ruler: Precision of the lamps' positions; None for the default.

    Raises:
        FitError: The readings do not determine a receiver's heading, gain or lobe, or the shared values.
    """
    initial, n_sensors = start.ambient, len(start.heading_deg)
    names = tests[0].placement.model.body.ring_sensors
    counts = np.concatenate([test.counts for test in tests])
    if initial.rises_with_light:
        counts = start.largest_count - counts
    for name, readings in zip(names, counts.T, strict=True):
        if np.ptp(readings) < _MIN_RANGE:
            raise FitError(
                f"{name}: the gain for lamps cannot be determined: its readings differ by less than "
                f"{_MIN_RANGE:.0f} counts; expected a turn of 360 degrees in a lamp's light"
            )
    # Without saturated readings, the level of the brightest light keeps its initial value.
    is_saturated = bool((counts < initial.floor_counts + 4 * initial.noise_counts).sum() >= n_sensors)
    shared = _shared_parameters(initial, is_saturated, start.largest_count)
    n_shared = len(shared)
    n_levels = n_shared + _N_PARAMETERS * n_sensors

    def split_values(x: Floats) -> tuple[tuple[float, float, float], Floats]:
        floor = float(x[2]) if is_saturated else initial.floor_counts
        return (float(x[0]), floor, float(x[1])), x[n_shared:n_levels].reshape(n_sensors, _N_PARAMETERS)

    noise = max(initial.noise_counts, 1.0)

    def residuals(x: Floats) -> Floats:
        levels, receivers = split_values(x)
        lamps = [LampPositions.of(*pair) for pair in zip(tests, misplacements(x[n_levels:]), strict=True)]
        columns = [
            np.concatenate([_counts(lamp, sensor, tuple(row), levels, initial.offset_mm) for lamp in lamps])
            for sensor, row in enumerate(receivers)
        ]
        # Noise above the highest reading is clipped, as in the dark.
        means = expected_readings(np.column_stack(columns), initial.noise_counts, initial.ceiling_counts)
        return ((means - counts) / noise).ravel()

    parameters = [*shared, *_receiver_parameters(initial, names), *error_parameters(tests, ruler or Ruler())]
    expected_data = "readings of a lamp in turns of 360 degrees, at two distances and more"
    sparsity = jacobian_sparsity(tests, _N_PARAMETERS, n_shared)
    # The residuals determine the noise, which weighs them against the errors of the ruler.
    noise *= max(least_squares(residuals, parameters, expected_data, sparsity=sparsity).rms, 0.1)
    estimate = least_squares(residuals, parameters, expected_data, unit_variance=True, sparsity=sparsity)
    (dark, floor, diffuse), receivers = split_values(estimate.values)
    _, intervals = split_values(estimate.intervals)
    update = {
        "heading_deg": tuple(np.round(receivers[:, 0], 1).tolist()),
        "gain_counts_mm2_per_w": tuple(np.round(receivers[:, 1], -3).tolist()),
        "lobe_exponent": tuple(np.round(receivers[:, 2], 4).tolist()),
        "dark_counts": round(dark, 1),
        "floor_counts": round(floor, 1),
        "diffuse": round(diffuse, 5),
    }
    lag_deg = max(CONFIDENCE * math.degrees(test.placement.turn_rate * SCAN_LAG_S) for test in tests)
    ambient = initial.model_copy(update=update)
    relative_gain_widths = intervals[:, 1] / receivers[:, 1]
    widths = {
        "heading_deg": np.hypot(intervals[:, 0], lag_deg),
        "gain_counts_mm2_per_w": relative_gain_widths * ambient.gain_counts_mm2_per_w,
        "lobe_exponent": intervals[:, 2],
    }
    values = [
        FittedValue(("ambient", key, sensor), getattr(ambient, key)[sensor], width)
        for key, sensor_widths in widths.items()
        for sensor, width in enumerate(sensor_widths.tolist())
    ]
    for key, width in zip(("dark_counts", "diffuse"), estimate.intervals.tolist(), strict=False):
        values.append(FittedValue(("ambient", key), getattr(ambient, key), width))
    calibration = start.model_copy(update={"ambient": ambient})
    rms = (estimate.rms * noise,)
    return SensorsFit(calibration, tuple(values), rms, tuple(misplacements(estimate.values[n_levels:])))


def _shared_parameters(initial: AmbientCalibration, is_saturated: bool, largest: int) -> list[Parameter]:
    """Return the parameters that all receivers share."""
    floor = Parameter("level of the brightest light", initial.floor_counts, 20, 20, " counts", 0, largest)
    return [
        Parameter("dark level", initial.dark_counts, 20, 20, " counts", 0, largest),
        Parameter("diffuse part", initial.diffuse, 0.1, 0.1, "", 0, 1),
        *([floor] if is_saturated else []),
    ]


def _receiver_parameters(initial: AmbientCalibration, names: Sequence[str]) -> list[Parameter]:
    """Return the parameters of each receiver in turn."""
    parameters: list[Parameter] = []
    for sensor, name in enumerate(names):
        gain = initial.gain_counts_mm2_per_w[sensor]
        parameters += [
            Parameter(f"{name}: heading to lamps", initial.heading_deg[sensor], 10, 10, " deg"),
            Parameter(f"{name}: gain for lamps", gain, gain / 4, gain / 5, " counts mm2/W", 0.0),
            Parameter(f"{name}: width for lamps", initial.lobe_exponent[sensor], 0.5, 1, "", 0, 20),
        ]
    return parameters


def _counts(
    lamp: LampPositions,
    channel: int,
    receiver: tuple[float, ...],
    levels: tuple[float, float, float],
    offset_mm: float,
) -> Floats:
    """Return clipped counts; a receiver is heading [deg], gain, exponent; levels: dark, floor, diffuse."""
    (heading_deg, gain, exponent), (dark, floor, diffuse) = receiver, levels
    offsets = lamp.positions - np.array([*lamp.receivers[channel], 0.0])
    distances = np.sqrt((offsets**2).sum(axis=1))
    heading = np.radians(heading_deg)
    cosines = (offsets[:, 0] * np.cos(heading) + offsets[:, 1] * np.sin(heading)) / distances
    direct = np.where(cosines > 0, np.abs(cosines) ** exponent, 0)
    lobe = (1 - diffuse) * direct + diffuse * (1 + cosines) / 2
    light = gain * lamp.power * lobe / np.maximum(distances * 1e3 - offset_mm, 1) ** 2
    return np.maximum(dark - light, floor)
