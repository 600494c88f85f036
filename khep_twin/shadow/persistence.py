"""Errors of the sensor model, which persist: the part of a reading that is new."""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SENSOR_RADIUS = 0.025
"""Distance of the sensors from the centre, about [m]."""

PERSISTENCE = 0.004
"""Way of a sensor over which errors of the model persist [m] (assumed)."""

LEAST_NEW = 0.05
"""Power of the likelihood of a reading where the robot stands (assumed)."""

CHANGED = 100.0, 0.25
"""Counts and part of the larger reading by which one changes that is new however far the robot went: a robot
that was lifted, or that moves where the twins are stuck (assumed)."""


def parts_new(way: float, vague: float, before: NDArray[np.int64], readings: NDArray[np.int64]) -> Floats:
    """Return the parts of proximity readings that are new, after those before (8,); see `part_new`."""
    least, part = CHANGED
    changed = np.abs(readings - before) > np.maximum(least, part * np.maximum(readings, before))
    of_changed, of_others = (part_new(each, PERSISTENCE, vague) for each in (math.inf, way))
    return np.where(changed, of_changed, of_others)


def part_new(way: float, persistence: float, vague: float = 0.0) -> float:
    """Return the part of a reading that is new after a sensor's way, with that of its errors [m].

    Errors persist: a reading counts by how far their correlation, exp(-way / persistence), has fallen. The
    sensor was somewhere on the last part of its way, which is vague [m].
    """
    return max(math.tanh(way / (2 * persistence)), LEAST_NEW) * (persistence / (persistence + vague))
