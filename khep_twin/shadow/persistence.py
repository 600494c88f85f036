"""Novelty of a reading: the share of new information in it, as errors of the sensor model persist."""

import math

SENSOR_RADIUS = 0.025
"""Distance of a Khepera's sensors from the centre, about [m]."""

PERSISTENCE = 0.004
"""Travel of a sensor over which errors of the model persist [m] (assumed)."""

MIN_NOVELTY = 0.05
"""Novelty of a reading where the robot stands (assumed)."""


def novelty_of(travel: float, persistence: float, uncertain_travel: float = 0.0) -> float:
    """Return the novelty of a reading, the power of its likelihood, after a sensor's travel [m].

    Errors of two readings correlate by exp(-travel / persistence); novelty is large where it is low.
    A part of the travel is uncertain [m].
    """
    novelty = max(math.tanh(travel / (2 * persistence)), MIN_NOVELTY)
    return novelty * (persistence / (persistence + uncertain_travel))
