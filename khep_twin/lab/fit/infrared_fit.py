"""The infrared sensors of one robot, from readings in front of a wall or a cylinder.

Gain and threshold of each sensor by least squares, the shape of its optics taken from another calibration. A
reading that is cut off at either end still tells something: what is compared is the mean that a noisy sensor
would give there,

    E[clip(x + s z, 0, limit)],  z normal,

with level x and the calibration's noise s, by how well the reading tells it.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from khep_twin.errors import FitError
from khep_twin.lab.fit.infrared import TANGENTS, Floats, Optics, Table, level
from khep_twin.lab.fit.least_squares import Parameter, estimate
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS, Sensor

_LEAST_READINGS = 10
"""Readings that are cut off at neither end, without which a sensor is refused."""

_WISH = "readings at several distances between 10 and 40 mm"

_BLUR = 8.0
"""What a reading may be off by without noise [counts], as no robot is quite where one thinks (assumed)."""

_WIDEST = 0.15
"""Half the confidence interval of a gain, relative, beyond which the readings do not tell it."""


@dataclass(frozen=True, slots=True)
class SensorFit:
    """One sensor found.

    Attributes:
        optics: of it.
        gain_interval: half the width of the gain's 95 % confidence interval, relative.
        threshold_interval: that of the threshold's [counts].
        rms: of what is left [counts].
    """

    optics: Optics
    gain_interval: float
    threshold_interval: float
    rms: float


def fit_infrared(tables: Sequence[Table], start: Calibration) -> list[SensorFit]:
    """Finds the gains and thresholds with which the readings were made, one fit a sensor.

    Raises:
        FitError: the readings cannot tell a sensor's gain.
    """
    return [_fit_sensor(tables, sensor, start) for sensor in range(N_SENSORS)]


def fitted(start: Calibration, fits: Sequence[SensorFit]) -> Calibration:
    """A calibration with what was found."""
    found = {
        "gain_counts_mm2": tuple(round(fit.optics.gain_counts_mm2) for fit in fits),
        "threshold_counts": tuple(round(fit.optics.threshold_counts, 1) for fit in fits),
    }
    return start.model_copy(update={"proximity": start.proximity.model_copy(update=found)})


def expected(levels: Floats, noise: float, limit: float) -> Floats:
    """Mean reading of a sensor with noise that is cut off at 0 and at a limit."""
    if noise <= 0:
        return np.clip(levels, 0, limit)
    low, high = -levels / noise, (limit - levels) / noise
    return noise * (_bell(low) - _bell(high)) + levels * (ndtr(high) - ndtr(low)) + limit * ndtr(-high)


def deviation(levels: Floats, noise: float, limit: float) -> Floats:
    """Standard deviation of such a reading: little where it is cut off."""
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


def _fit_sensor(tables: Sequence[Table], sensor: int, start: Calibration) -> SensorFit:
    name = Sensor(sensor).name.lower().replace("_", " ")
    before, proximity = Optics.of(start.proximity, sensor), start.proximity
    views = [table.view(sensor, float(np.radians(start.heading_deg[sensor]))) for table in tables]
    counts = np.concatenate([table.counts[:, sensor] for table in tables])
    noise, limit = proximity.noise_counts, proximity.limit_counts
    told = int(((counts > noise) & (counts < limit - noise)).sum())
    if told < _LEAST_READINGS:
        raise FitError(
            f"{name}: the gain cannot be told: {told} readings are neither 0 nor saturated; right are "
            f"{_LEAST_READINGS} and more such {_WISH}"
        )

    def levels(x: Floats) -> Floats:
        optics = replace(before, gain_counts_mm2=x[0], threshold_counts=x[1])
        return np.concatenate([level(view, TANGENTS, optics) for view in views])

    weights = np.ones(len(counts))

    def left(x: Floats) -> Floats:
        return (expected(levels(x), noise, limit) - counts) * weights

    gain = before.gain_counts_mm2
    parameters = [
        Parameter(f"{name}: gain", gain, gain / 4, _WIDEST * gain, " counts mm2"),
        Parameter(f"{name}: threshold", before.threshold_counts, 100, 300, " counts"),
    ]
    # A few readings beside the rest, such as those taken while somebody walked by, shall not count for much.
    first = estimate(left, parameters, _WISH, "soft_l1", 3 * max(noise, _BLUR))
    weights = 1 / np.hypot(deviation(levels(np.array(first.values)), noise, limit), _BLUR)
    found = estimate(left, parameters, _WISH, "soft_l1", 3.0, unit_variance=True)
    (gain, threshold), (gain_interval, threshold_interval) = found.values, found.intervals
    weights = np.ones(len(counts))
    rms = float(np.sqrt(np.mean(left(np.array(found.values)) ** 2)))
    optics = replace(before, gain_counts_mm2=gain, threshold_counts=threshold)
    return SensorFit(optics, gain_interval / gain, threshold_interval, rms)


def _bell(z: Floats) -> Floats:
    return np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
