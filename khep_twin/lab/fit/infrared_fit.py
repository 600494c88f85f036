"""Fit of one robot's infrared sensors to readings in front of a wall or a cylinder.

Gain, threshold, heading, lobe exponent and noise of each sensor are fitted by least squares, together with
the errors of the ruler in each test. The other parameters of the optics are those of an initial calibration.
Heading and lobe exponent keep their initial values if the readings do not determine them. A reading that is
clipped to the sensor's floor or limit still has information: it is compared with the mean of a noisy sensor,

    E[clip(x + s z, floor, limit)],  z normal,

with the counts x before clipping and the noise s there, weighted by the reading's precision.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.infrared import Optics, View, unclipped_counts
from khep_twin.lab.fit.least_squares import (
    CONFIDENCE,
    Floats,
    Parameter,
    expected_readings,
    least_squares,
    reading_deviations,
)
from khep_twin.lab.fit.placement import (
    IN_PLACE,
    SCAN_LAG_S,
    FittedValue,
    Misplacement,
    Placement,
    Readings,
    Ruler,
    SensorsFit,
    error_parameters,
    jacobian_sparsity,
    misplacements,
)
from khep_twin.sensing.calibration import Calibration, ProximityCalibration

HEADING_SPREAD_DEG, LOBE_SPREAD = 5.0, 0.5
"""Standard deviations of a sensor's heading and lobe exponent between robots (assumed: the sampled robot's
headings are up to 9 degrees off the manual's)."""

_MIN_READINGS = 10
"""Smallest number of unclipped readings to fit a sensor."""
_MIN_NOISE_READINGS = 50
"""Smallest number of readings far from both ends that determine a sensor's noise."""

_MODEL_ERROR = 8.0
"""Error of a reading in addition to its noise, by simplifications of the optics' model [counts] (assumed)."""
_OUTLIER = 3.0
"""Residual above which a reading is an outlier, in standard deviations."""
_MAX_INTERVAL = 0.3
"""Largest accepted half width of a gain's confidence interval, relative."""
_N_PARAMETERS = 4
"""Number of parameters of a sensor: gain, threshold, heading, lobe exponent."""

_PATHS = (
    ("proximity", "gain_counts_mm2"),
    ("proximity", "threshold_counts"),
    ("", "heading_deg"),
    ("proximity", "lobe_exponent"),
    ("proximity", "noise_counts"),
)
"""Locations of these parameters and of the noise in a calibration."""


def sensor_counts(
    placement: Placement, sensor: int, heading_deg: float, optics: Optics, position: tuple[Floats, Floats]
) -> Floats:
    """Return the counts of a sensor in front of an object, without noise and clipping (n,).

    Args:
        placement: Object and model of the robot.
        sensor: Number of the sensor.
        heading_deg: Heading of the sensor, counter-clockwise from ahead [deg].
        optics: Calibration of the sensor.
        position: Distances from the robot's edge [m] and bearings, counter-clockwise [rad], of the object.
    """
    body, height = placement.model.body, placement.model.fit_bench.height_mm / 1e3
    face, heading = body.sensor_positions[sensor], math.radians(heading_deg)
    view = View.of(face, heading, *position, placement.radius, body.radius)
    heights = height - body.sensor_height, -height - body.sensor_height
    return unclipped_counts(replace(view, heights=heights), optics)


def mean_counts(placement: Placement, robot: Calibration, misplacement: Misplacement = IN_PLACE) -> Floats:
    """Return the proximity of a calibration without noise and clipping (n, n_sensors)."""
    object_position = placement.object_positions(misplacement)
    columns = [
        sensor_counts(placement, sensor, heading_deg, Optics.of(robot.proximity, sensor), object_position)
        for sensor, heading_deg in enumerate(robot.heading_deg)
    ]
    return np.column_stack(columns)


def convert(
    levels: Floats, thresholds: Sequence[float] | Floats, proximity: ProximityCalibration
) -> tuple[Floats, Floats]:
    """Return counts without noise and clipping, and their noise in that of a dark sensor (n, n_sensors).

    Args:
        levels: Counts before saturation (n, n_sensors).
        thresholds: Counts that were subtracted from the light (n_sensors,).
        proximity: Saturation and growth of the noise.
    """
    growth = 1 + proximity.noise_growth * np.maximum(levels + thresholds, 0)
    if not proximity.saturates:
        return levels, growth
    excess = 1 + (np.maximum(levels, 0) / proximity.limit_counts) ** 4
    return levels / excess**0.25, growth / excess**1.25


def expected_counts(counts: Floats, noise: Floats, proximity: ProximityCalibration) -> Floats:
    """Return the means of readings, by counts before clipping and their noise."""
    floor = proximity.floor_counts
    return expected_readings(counts - floor, noise, proximity.limit_counts - floor) + floor


def count_deviations(counts: Floats, noise: Floats, proximity: ProximityCalibration) -> Floats:
    """Return the standard deviations of readings, by counts before clipping and their noise."""
    floor = proximity.floor_counts
    return reading_deviations(counts - floor, noise, proximity.limit_counts - floor)


def fit_infrared(tests: Sequence[Readings], start: Calibration, ruler: Ruler | None = None) -> SensorsFit:
    """Fit the sensors to the readings.

    Args:
        tests: Readings in front of walls and cylinders.
        start: Initial values, and the other parameters of the optics.
        ruler: Precision of the objects' positions; None for the default.

    Raises:
        FitError: The readings do not determine a sensor's gain.
    """
    proximity, model, n_sensors = start.proximity, tests[0].placement.model, len(start.heading_deg)
    low_mm, *_, high_mm = model.fit_bench.walls_mm
    data_text = f"readings at several distances between {low_mm:g} and {high_mm:g} mm"
    counts = np.concatenate([test.counts for test in tests])
    _check_readings(counts, start, model.body.ring_sensors, data_text)
    initial = [Optics.of(proximity, sensor) for sensor in range(n_sensors)]
    sensor_parameters = _sensor_parameters(initial, start.heading_deg, model.body.ring_sensors)
    parameters = [*sensor_parameters, *error_parameters(tests, ruler or Ruler())]
    sparsity = jacobian_sparsity(tests, _N_PARAMETERS)
    n_values = _N_PARAMETERS * n_sensors

    def model_counts(x: Floats) -> tuple[Floats, Floats]:
        rows = x[:n_values].reshape(n_sensors, -1)
        objects = [
            (test.placement, test.placement.object_positions(misplacement))
            for test, misplacement in zip(tests, misplacements(x[n_values:]), strict=True)
        ]
        pairs = [(row[2], _replace_values(old, row)) for row, old in zip(rows, initial, strict=True)]
        columns = [
            np.concatenate([sensor_counts(place, sensor, heading, optics, spot) for place, spot in objects])
            for sensor, (heading, optics) in enumerate(pairs)
        ]
        return convert(np.column_stack(columns), rows[:, 1], proximity)

    noise = np.array(proximity.noise_counts)
    weights: Floats = 1 / np.hypot(noise, _MODEL_ERROR)

    def residuals(x: Floats) -> Floats:
        clean_counts, growth = model_counts(x)
        return ((expected_counts(clean_counts, noise * growth, proximity) - counts) * weights).ravel()

    # A robust loss limits the influence of outliers, for example of readings while someone walks by.
    robust = least_squares(residuals, parameters, data_text, _OUTLIER, unit_variance=True, sparsity=sparsity)
    robust_counts, growth = model_counts(robust.values)
    differences = residuals(robust.values).reshape(counts.shape) / weights
    noise, n_used = _fit_noise(robust_counts, differences / growth, noise, proximity)
    deviations = np.hypot(count_deviations(robust_counts, noise * growth, proximity), _MODEL_ERROR)
    weights = (1 + (differences / deviations / _OUTLIER) ** 2) ** -0.25 / deviations
    estimate = least_squares(residuals, parameters, data_text, unit_variance=True, sparsity=sparsity)
    weights = np.ones(n_sensors)  # residuals in counts
    final_residuals = residuals(estimate.values).reshape(counts.shape)
    lag_deg = max(CONFIDENCE * math.degrees(test.placement.turn_rate * SCAN_LAG_S) for test in tests)
    arrays = estimate.values, estimate.intervals, estimate.fixed
    values, widths, fixed = (x[:n_values].reshape(n_sensors, -1) for x in arrays)
    widths = np.where(fixed, np.nan, np.hypot(widths, [0, 0, lag_deg, 0]))
    noise_widths = CONFIDENCE * noise / np.sqrt(2 * n_used)
    rows = zip(np.column_stack([values, noise]), np.column_stack([widths, noise_widths]), strict=True)
    fitted_values = tuple(
        FittedValue((*path, sensor), value, width)
        for sensor, (row, row_widths) in enumerate(rows)
        for path, value, width in zip(_PATHS, row.tolist(), row_widths.tolist(), strict=True)
        if math.isfinite(width)
    )
    gains, thresholds, headings, lobes = values.T.tolist()
    update = {
        "gain_counts_mm2": tuple(map(round, gains)),
        "threshold_counts": tuple(round(threshold, 1) for threshold in thresholds),
        "lobe_exponent": tuple(round(lobe, 3) for lobe in lobes),
        "noise_counts": tuple(round(sd, 1) for sd in noise.tolist()),
    }
    calibration = start.model_copy(
        update={
            "heading_deg": tuple(round(heading, 2) for heading in headings),
            "proximity": proximity.model_copy(update=update),
        }
    )
    rms = tuple(np.sqrt(np.mean(final_residuals**2, axis=0)).tolist())
    return SensorsFit(calibration, fitted_values, rms, tuple(misplacements(estimate.values[n_values:])))


def _check_readings(counts: Floats, start: Calibration, names: Sequence[str], data_text: str) -> None:
    """Raise a `FitError` for a sensor with too few readings between both ends."""
    noise, limit = np.array(start.proximity.noise_counts), start.proximity.limit_counts
    n_unclipped = ((counts > noise) & (counts < limit - noise)).sum(axis=0)
    for name, n_readings in zip(names, n_unclipped.tolist(), strict=True):
        if n_readings < _MIN_READINGS:
            raise FitError(
                f"{name}: the gain cannot be determined: {n_readings} readings are neither 0 nor saturated; "
                f"expected at least {_MIN_READINGS} such {data_text}"
            )


def _sensor_parameters(
    initial: Sequence[Optics], headings_deg: Sequence[float], names: Sequence[str]
) -> list[Parameter]:
    """Return gain, threshold, heading [deg] and lobe exponent of each sensor in turn."""
    parameters: list[Parameter] = []
    for name, optics, heading_deg in zip(names, initial, headings_deg, strict=True):
        gain, heading_sd, lobe_sd = optics.gain_counts_mm2, HEADING_SPREAD_DEG, LOBE_SPREAD
        parameters += [
            Parameter(f"{name}: gain", gain, gain / 4, gain * _MAX_INTERVAL, " counts mm2", gain / 20),
            Parameter(f"{name}: threshold", optics.threshold_counts, 100, 500, " counts"),
            Parameter(f"{name}: heading", heading_deg, heading_sd, prior=heading_sd, optional=True),
            Parameter(f"{name}: lobe", optics.lobe_exponent, lobe_sd, low=0, prior=lobe_sd, optional=True),
        ]
    return parameters


def _replace_values(initial: Optics, x: Floats) -> Optics:
    """Return a sensor's optics with the values x of its parameters; the heading is no part of them."""
    gain, threshold, _, lobe = x.tolist()
    return replace(initial, gain_counts_mm2=gain, threshold_counts=threshold, lobe_exponent=lobe)


def _fit_noise(
    counts: Floats, residuals: Floats, noise: Floats, proximity: ProximityCalibration
) -> tuple[Floats, Floats]:
    """Return each sensor's noise [counts], and its number of readings far from both ends; NaN if too few."""
    is_inside = counts > proximity.floor_counts + 2 * noise
    is_inside &= counts < proximity.limit_counts - 2 * noise
    n_readings = is_inside.sum(axis=0)
    # Degrees of freedom: the readings less the sensor's four parameters.
    variances = np.where(is_inside, residuals**2, 0).sum(axis=0) / np.maximum(n_readings - _N_PARAMETERS, 1)
    is_enough = n_readings >= _MIN_NOISE_READINGS
    return np.where(is_enough, np.sqrt(variances), noise), np.where(is_enough, n_readings, np.nan)
