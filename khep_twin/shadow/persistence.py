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
"""Counts, and part of the larger reading, by which a reading and its error change where both are new, however
little the twins have moved: the robot was lifted, or moves where they are stuck (assumed)."""


def has_changed(before: Floats, after: Floats) -> NDArray[np.bool_]:
    """Return which sensors' readings, and what they are beyond those expected, have changed (2, 8) to (8,)."""
    least, part = CHANGED
    most = np.maximum(least, part * np.maximum(before[0], after[0]))
    return (np.abs(after - before) > most).all(axis=0)


def part_new(way: float, persistence: float, vague: float = 0.0) -> float:
    """Return the part of a reading that is new after a sensor's way, with that of its errors [m].

    Errors persist: a reading counts by how far their correlation, exp(-way / persistence), has fallen. The
    sensor was somewhere on the last part of its way, which is vague [m].
    """
    return max(math.tanh(way / (2 * persistence)), LEAST_NEW) * (persistence / (persistence + vague))
