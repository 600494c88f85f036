"""Fit of one robot's infrared sensors to readings in front of a wall or a cylinder.

Gain, threshold, heading, lobe exponent and noise of each sensor are found by least squares, together with
the errors of the ruler in each test; the rest of the optics is taken from another calibration. Heading and
lobe exponent stay as they are there if the readings do not determine them. A clipped reading still carries
information: it is compared with the mean of a noisy sensor,

    E[clip(x + s z, 0, limit)],  z normal,

with level x and the sensor's noise s, weighted by the reading's precision.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.infrared import Optics, View, level
from khep_twin.lab.fit.least_squares import (
    CONFIDENCE,
    Floats,
    Parameter,
    deviation,
    expected,
    least_squares,
)
from khep_twin.lab.fit.placement import (
    IN_PLACE,
    SCAN_LAG_S,
    Misplacement,
    Placement,
    Readings,
    Ruler,
    misplacements,
    owners_of,
    unknowns,
)
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS, SENSOR_LABELS, SENSOR_POSITIONS

HEADING_SPREAD_DEG, LOBE_SPREAD = 5.0, 0.5
"""Standard deviations of a sensor's heading and lobe exponent around those of another robot (assumed: the
sampled robot's headings are up to 9 degrees off the manual's)."""

_LEAST_READINGS = 10
"""Least number of unclipped readings to fit a sensor."""

_LEAST_NOISY = 50
"""Least number of readings far from both ends that determine a sensor's noise."""

_WISH = "readings at several distances between 10 and 40 mm"

_BLUR = 8.0
"""Error of a reading beside its noise, from what the model of the optics leaves out [counts] (assumed)."""

_OUTLIER = 3.0
"""Residual from which on a reading counts as an outlier, in its standard deviation."""

_WIDEST = 0.3
"""Largest half of a gain's confidence interval, relative, for which a fit is accepted."""

_OWN = 4
"""Number of parameters of a sensor: gain, threshold, heading, lobe exponent."""


@dataclass(frozen=True, slots=True)
class SensorFit:
    """Fit of one sensor; each interval is half of the 95 % confidence interval.

    Attributes:
        optics: Fitted optics.
        heading_deg: Heading, counter-clockwise from ahead [deg].
        noise_counts: Standard deviation of a reading [counts].
        gain_interval: Interval of the gain, relative.
        threshold_interval: Interval of the threshold [counts].
        heading_interval: Interval of the heading [deg]; None if it stayed as it was.
        lobe_interval: Interval of the lobe exponent; None if it stayed as it was.
        noise_interval: Interval of the noise [counts]; None if it stayed as it was.
        rms: Root mean square of the residuals [counts].
    """

    optics: Optics
    heading_deg: float
    noise_counts: float
    gain_interval: float
    threshold_interval: float
    heading_interval: float | None
    lobe_interval: float | None
    noise_interval: float | None
    rms: float


@dataclass(frozen=True, slots=True)
class InfraredFit:
    """Fit of all sensors, and where the objects stood in each test."""

    sensors: tuple[SensorFit, ...]
    moved: tuple[Misplacement, ...]


def unclipped(
    sensor: int, heading_deg: float, optics: Optics, seen: tuple[Floats, Floats], radius: float
) -> Floats:
    """Return the counts of a sensor before an object, without noise and before they are clipped (n,).

    Args:
        sensor: Number of the sensor.
        heading_deg: Heading of the sensor, counter-clockwise from ahead [deg].
        optics: Calibration of the sensor.
        seen: Distances from the robot's edge [m] and bearings, counter-clockwise [rad], of the object.
        radius: Radius of the cylinder, 0 for a wall [m].
    """
    return level(View.of(SENSOR_POSITIONS[sensor], math.radians(heading_deg), *seen, radius), optics)


def levels(placement: Placement, robot: Calibration, moved: Misplacement = IN_PLACE) -> Floats:
    """Return the proximity of a calibration without noise and clipping (n, 8)."""
    seen = placement.seen(moved)
    optics = [Optics.of(robot.proximity, sensor) for sensor in range(N_SENSORS)]
    columns = [
        unclipped(sensor, heading_deg, optics[sensor], seen, placement.radius)
        for sensor, heading_deg in enumerate(robot.heading_deg)
    ]
    return np.column_stack(columns)


def fit_infrared(tests: Sequence[Readings], start: Calibration, ruler: Ruler | None = None) -> InfraredFit:
    """Fit the sensors to the readings.

    Args:
        tests: Readings before walls and cylinders.
        start: Initial values, and the rest of the optics.
        ruler: Precision of the objects' places; None for the usual one.

    Raises:
        FitError: The readings do not determine a sensor's gain.
    """
    near = start.proximity
    counts = np.concatenate([test.counts for test in tests])
    _check(counts, np.array(near.noise_counts), near.limit_counts)
    before = [Optics.of(near, sensor) for sensor in range(N_SENSORS)]
    parameters = [*_parameters(before, start.heading_deg), *unknowns(tests, ruler or Ruler())]
    owners = owners_of(tests, _OWN)

    def found_levels(x: Floats) -> Floats:
        own, errors = x[: _OWN * N_SENSORS].reshape(N_SENSORS, _OWN), x[_OWN * N_SENSORS :]
        seen = [
            (test.placement.seen(moved), test.placement.radius)
            for test, moved in zip(tests, misplacements(errors), strict=True)
        ]
        columns = [
            np.concatenate([unclipped(sensor, row[2], _optics(old, row), *each) for each in seen])
            for sensor, (row, old) in enumerate(zip(own, before, strict=True))
        ]
        return np.column_stack(columns)

    noise = np.array(near.noise_counts)
    weights: Floats = 1 / np.hypot(noise, _BLUR)

    def left(x: Floats) -> Floats:
        return ((expected(found_levels(x), noise, near.limit_counts) - counts) * weights).ravel()

    # A robust loss limits the influence of outliers, such as readings while someone walks by.
    first = least_squares(left, parameters, _WISH, _OUTLIER, unit_variance=True, owners=owners)
    level, off = found_levels(first.values), left(first.values).reshape(counts.shape) / weights
    noise, noisy = _noise(level, off, noise, near.limit_counts)
    spread = np.hypot(deviation(level, noise, near.limit_counts), _BLUR)
    weights = (1 + (off / spread / _OUTLIER) ** 2) ** -0.25 / spread
    found = least_squares(left, parameters, _WISH, unit_variance=True, owners=owners)
    own, widths = (x[: _OWN * N_SENSORS].reshape(N_SENSORS, _OWN) for x in (found.values, found.intervals))
    held = found.held[: _OWN * N_SENSORS].reshape(N_SENSORS, _OWN)
    weights = np.ones(N_SENSORS)
    left_over = left(found.values).reshape(counts.shape)
    lag = max(CONFIDENCE * math.degrees(test.placement.turning * SCAN_LAG_S) for test in tests)
    fits = [
        SensorFit(
            _optics(old, row),
            float(row[2]),
            float(noise[sensor]),
            float(width[0] / row[0]),
            float(width[1]),
            None if kept[2] else math.hypot(width[2], lag),
            None if kept[3] else float(width[3]),
            CONFIDENCE * float(noise[sensor]) / math.sqrt(2 * noisy[sensor]) if noisy[sensor] else None,
            float(np.sqrt(np.mean(left_over[:, sensor] ** 2))),
        )
        for sensor, (row, width, kept, old) in enumerate(zip(own, widths, held, before, strict=True))
    ]
    return InfraredFit(tuple(fits), tuple(misplacements(found.values[_OWN * N_SENSORS :])))


def fitted(start: Calibration, found: InfraredFit) -> Calibration:
    """Return a calibration with the fitted values; it has one noise for all sensors."""
    fits = found.sensors
    update = {
        "gain_counts_mm2": tuple(round(fit.optics.gain_counts_mm2) for fit in fits),
        "threshold_counts": tuple(round(fit.optics.threshold_counts, 1) for fit in fits),
        "lobe_exponent": tuple(round(fit.optics.lobe_exponent, 3) for fit in fits),
        "noise_counts": tuple(round(fit.noise_counts, 1) for fit in fits),
    }
    headings = tuple(round(fit.heading_deg, 2) for fit in fits)
    proximity = start.proximity.model_copy(update=update)
    return start.model_copy(update={"heading_deg": headings, "proximity": proximity})


def _check(counts: Floats, noise: Floats, limit: float) -> None:
    """Raise a `FitError` for a sensor with hardly a reading between both ends."""
    between = ((counts > noise) & (counts < limit - noise)).sum(axis=0)
    for name, told in zip(SENSOR_LABELS, between.tolist(), strict=True):
        if told < _LEAST_READINGS:
            raise FitError(
                f"{name}: the gain cannot be determined: {told} readings are neither 0 nor saturated; "
                f"expected at least {_LEAST_READINGS} such {_WISH}"
            )


def _parameters(before: Sequence[Optics], headings_deg: Sequence[float]) -> list[Parameter]:
    found: list[Parameter] = []
    for name, old, heading_deg in zip(SENSOR_LABELS, before, headings_deg, strict=True):
        gain, spread, lobe = old.gain_counts_mm2, HEADING_SPREAD_DEG, LOBE_SPREAD
        found += [
            Parameter(f"{name}: gain", gain, gain / 4, _WIDEST * gain, " counts mm2", gain / 20),
            Parameter(f"{name}: threshold", old.threshold_counts, 100, 500, " counts"),
            Parameter(f"{name}: heading", heading_deg, spread, prior=spread, optional=True),
            Parameter(f"{name}: lobe", old.lobe_exponent, lobe, low=0, prior=lobe, optional=True),
        ]
    return found


def _optics(before: Optics, x: Floats) -> Optics:
    gain, threshold, _, lobe = x.tolist()
    return replace(before, gain_counts_mm2=gain, threshold_counts=threshold, lobe_exponent=lobe)


def _noise(levels: Floats, off: Floats, noise: Floats, limit: float) -> tuple[Floats, list[int]]:
    """Return each sensor's noise [counts], and of how many readings far from both ends; 0 if too few."""
    inside = (levels > 2 * noise) & (levels < limit - 2 * noise)
    numbers = inside.sum(axis=0)
    # Each sensor's four parameters have taken their part of the residuals.
    squares = np.where(inside, off**2, 0).sum(axis=0) / np.maximum(numbers - _OWN, 1)
    enough = numbers >= _LEAST_NOISY
    return np.where(enough, np.sqrt(squares), noise), np.where(enough, numbers, 0).tolist()
