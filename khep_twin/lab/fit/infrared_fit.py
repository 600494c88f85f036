"""Fit of one robot's infrared sensors to readings in front of a wall or a cylinder.

Gain and threshold of each sensor are found by least squares, the shape of its optics is taken from another
calibration. A clipped reading still carries information: it is compared with the mean of a noisy sensor,

    E[clip(x + s z, 0, limit)],  z normal,

with level x and the calibration's noise s, weighted by the reading's precision.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from khep_twin.errors import FitError
from khep_twin.lab.fit.infrared import TANGENTS, Floats, MeasuredTable, Optics, level
from khep_twin.lab.fit.least_squares import Parameter, least_squares
from khep_twin.lab.sensor_test.sensor_test import SENSORS
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS

_LEAST_READINGS = 10
"""Least number of unclipped readings to fit a sensor."""

_WISH = "readings at several distances between 10 and 40 mm"

_BLUR = 8.0
"""Error of a reading beside its noise, from the uncertain pose of the robot [counts] (assumed)."""

_WIDEST = 0.15
"""Largest half of a gain's confidence interval, relative, for which a fit is accepted."""


@dataclass(frozen=True, slots=True)
class SensorFit:
    """Fit of one sensor.

    Attributes:
        optics: Fitted optics.
        gain_interval: Half of the gain's 95 % confidence interval, relative.
        threshold_interval: Half of the threshold's 95 % confidence interval [counts].
        rms: Root mean square of the residuals [counts].
    """

    optics: Optics
    gain_interval: float
    threshold_interval: float
    rms: float


def fit_infrared(tables: Sequence[MeasuredTable], start: Calibration) -> list[SensorFit]:
    """Fit gain and threshold of each sensor to the readings.

    Raises:
        FitError: The readings do not determine a sensor's gain.
    """
    return [_fit_sensor(tables, sensor, start) for sensor in range(N_SENSORS)]


def fitted(start: Calibration, fits: Sequence[SensorFit]) -> Calibration:
    """Return a calibration with the fitted values."""
    found = {
        "gain_counts_mm2": tuple(round(fit.optics.gain_counts_mm2) for fit in fits),
        "threshold_counts": tuple(round(fit.optics.threshold_counts, 1) for fit in fits),
    }
    return start.model_copy(update={"proximity": start.proximity.model_copy(update=found)})


def expected(levels: Floats, noise: float, limit: float) -> Floats:
    """Return the mean reading of a noisy sensor that is clipped to 0 and a limit."""
    if noise <= 0:
        return np.clip(levels, 0, limit)
    low, high = -levels / noise, (limit - levels) / noise
    return noise * (_bell(low) - _bell(high)) + levels * (ndtr(high) - ndtr(low)) + limit * ndtr(-high)


def deviation(levels: Floats, noise: float, limit: float) -> Floats:
    """Return the standard deviation of such a reading, which is small where it is clipped."""
    if noise <= 0:
        return np.zeros_like(levels)
    low, high = -levels / noise, (limit - levels) / noise
    inside = ndtr(high) - ndtr(low)
    squares = (
        (levels**2 + noise**2) * inside
        + 2 * levels * noise * (_bell(low) - _bell(high))
        + noise**2 * (low * _bell(low) - high * _bell(high))
        + limit**2 * ndtr(-high)
    )
    return np.sqrt(np.maximum(squares - expected(levels, noise, limit) ** 2, 0))


def _fit_sensor(tables: Sequence[MeasuredTable], sensor: int, start: Calibration) -> SensorFit:
    name, proximity = SENSORS[sensor], start.proximity
    before = Optics.of(proximity, sensor)
    views = [table.view(sensor, float(np.radians(start.heading_deg[sensor]))) for table in tables]
    counts = np.concatenate([table.counts[:, sensor] for table in tables])
    noise, limit = proximity.noise_counts, proximity.limit_counts
    told = int(((counts > noise) & (counts < limit - noise)).sum())
    if told < _LEAST_READINGS:
        raise FitError(
            f"{name}: the gain cannot be determined: {told} readings are neither 0 nor saturated; expected "
            f"at least {_LEAST_READINGS} such {_WISH}"
        )

    def levels(x: Floats) -> Floats:
        optics = replace(before, gain_counts_mm2=x[0], threshold_counts=x[1])
        return np.concatenate([level(view, TANGENTS, optics) for view in views])

    weights: float | Floats = 1.0

    def left(x: Floats) -> Floats:
        return (expected(levels(x), noise, limit) - counts) * weights

    gain = before.gain_counts_mm2
    parameters = [
        Parameter(f"{name}: gain", gain, gain / 4, _WIDEST * gain, " counts mm2"),
        Parameter(f"{name}: threshold", before.threshold_counts, 100, 300, " counts"),
    ]
    # A robust loss limits the influence of outliers, such as readings while someone walks by.
    first = least_squares(left, parameters, _WISH, "soft_l1", 3 * max(noise, _BLUR))
    weights = 1 / np.hypot(deviation(levels(np.array(first.values)), noise, limit), _BLUR)
    found = least_squares(left, parameters, _WISH, "soft_l1", 3.0, unit_variance=True)
    (gain, threshold), (gain_interval, threshold_interval) = found.values, found.intervals
    weights = 1.0
    rms = float(np.sqrt(np.mean(left(np.array(found.values)) ** 2)))
    optics = replace(before, gain_counts_mm2=gain, threshold_counts=threshold)
    return SensorFit(optics, gain_interval / gain, threshold_interval, rms)


def _bell(z: Floats) -> Floats:
    return np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
