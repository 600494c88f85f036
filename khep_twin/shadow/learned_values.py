"""Values that a shadow has learned: wheels and the gains of the sensors, with their deviations."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles
from khep_twin.shadow.shadow import Shadow
from khep_twin.units import N_SENSORS, SENSOR_LABELS

Floats = NDArray[np.float64]


VALUE_NAMES = [
    *(f"{part}{name}" for part in ("", "deviation of ") for name in ("radius", "right over left", "base")),
    *(f"{part}gain {name}" for part in ("", "deviation of log ") for name in SENSOR_LABELS),
]
"""Numbers of a row, in this order, as parts of the calibration's values."""


class LearnedValues(NamedTuple):
    """Wheels and gains as parts of those of the calibration, with standard deviations.

    Attributes:
        wheels: Mean radius, ratio right over left, and base (3,).
        wheel_deviations: Their standard deviations (3,).
        gains: Gains of the sensors' proximity, geometric means (8,).
        gain_deviations: Standard deviations of their logarithms (8,).
    """

    wheels: Floats
    wheel_deviations: Floats
    gains: Floats
    gain_deviations: Floats

    @property
    def row(self) -> Floats:
        """Row of all values (22,), as `VALUE_NAMES` names them."""
        return np.concatenate(self)

    @classmethod
    def of_row(cls, row: Floats) -> Self:
        """Return what a row has."""
        return cls(*np.split(row, np.cumsum([3, 3, N_SENSORS])))


def values_learned(shadow: Shadow) -> LearnedValues:
    """Return what a shadow has learned so far."""
    return of_particles(shadow._diagnosis.filter.particles)  # pyright: ignore[reportPrivateUsage]


def of_particles(particles: Particles) -> LearnedValues:
    """Return what particles have learned: means by their weights, and what is left of their spread."""
    weights = np.exp(particles.logs)
    wheels = weights @ particles.wheels
    gains = particles.traits[:, :, 0]
    logs = weights @ gains
    apart = weights @ (particles.wheels - wheels) ** 2
    # A gain's variance: that within each particle, and that between them.
    gain_apart = weights @ (particles.covariances[:, :, 0, 0] + (gains - logs) ** 2)
    return LearnedValues(wheels, np.sqrt(apart), np.exp(logs), np.sqrt(gain_apart))
