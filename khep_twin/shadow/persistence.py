"""Errors of the sensor model, which persist: the part of a reading that is new."""

import math

SENSOR_RADIUS = 0.025
"""Distance of the sensors from the centre, about [m]."""

PERSISTENCE = 0.004
"""Way of a sensor over which errors of the model persist [m] (assumed)."""

LEAST_NEW = 0.05
"""Power of the likelihood of a reading where the robot stands (assumed)."""


def part_new(way: float, persistence: float, vague: float = 0.0) -> float:
    """Return the part of a reading that is new after a sensor's way, with that of its errors [m].

    Errors persist: a reading counts by how far their correlation, exp(-way / persistence), has fallen. The
    sensor was somewhere on the last part of its way, which is vague [m].
    """
    return max(math.tanh(way / (2 * persistence)), LEAST_NEW) * (persistence / (persistence + vague))
