"""What a shadow has learned of its robot: wheels and the gains of its sensors, with their deviations."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particle_filter import Particles
from khep_twin.shadow.shadow import Shadow

Floats = NDArray[np.float64]


class Learned(NamedTuple):
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


def learned(shadow: Shadow) -> Learned:
    """Return what a shadow has learned so far."""
    return of_particles(shadow._filter.particles)  # pyright: ignore[reportPrivateUsage]


def of_particles(particles: Particles) -> Learned:
    """Return what particles have learned: means by their weights, and what is left of their spread."""
    weights = np.exp(particles.logs)
    wheels = weights @ particles.wheels
    logs = weights @ particles.gains
    apart = weights @ (particles.wheels - wheels) ** 2
    # A gain's variance: that within each particle, and that between them.
    gain_apart = weights @ (particles.variances + (particles.gains - logs) ** 2)
    return Learned(wheels, np.sqrt(apart), np.exp(logs), np.sqrt(gain_apart))
