"""Values that a shadow has learned: wheels, and the traits of the sensors, with their deviations."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles
from khep_twin.shadow.shadow import Shadow
from khep_twin.units import N_SENSORS, Sensor

Floats = NDArray[np.float64]


_SENSORS = [sensor.name.lower().replace("_", " ") for sensor in Sensor]

_TRAITS = ("gain", "log gain"), ("turn", "turn"), ("threshold", "threshold")
"""Names of a sensor's traits, and of what their deviations are of."""

LEARNED = [
    *(f"{part}{name}" for part in ("", "deviation of ") for name in ("radius", "right over left", "base")),
    *(
        f"{name} {sensor}"
        for trait, log in _TRAITS
        for name in (trait, f"deviation of {log}")
        for sensor in _SENSORS
    ),
]
"""Numbers of a row, in this order: wheels and gains as parts of the calibration's, turns in radians and
thresholds in counts beyond it."""


class Learned(NamedTuple):
    """Wheels and traits of the sensors beside those of the calibration, with standard deviations.

    Attributes:
        wheels: Mean radius, ratio right over left, and base, as parts (3,).
        wheel_deviations: Their standard deviations (3,).
        gains: Gains of the sensors' proximity as parts, geometric means (8,).
        gain_deviations: Standard deviations of their logarithms (8,).
        turns: Turns of the sensors from their headings (8,) [rad].
        turn_deviations: Their standard deviations (8,) [rad].
        thresholds: Thresholds beyond the calibration's (8,) [counts].
        threshold_deviations: Their standard deviations (8,) [counts].
    """

    wheels: Floats
    wheel_deviations: Floats
    gains: Floats
    gain_deviations: Floats
    turns: Floats
    turn_deviations: Floats
    thresholds: Floats
    threshold_deviations: Floats

    @property
    def row(self) -> Floats:
        """All values (54,), as `LEARNED` names them."""
        return np.concatenate(self)

    @classmethod
    def of_row(cls, row: Floats) -> Self:
        """Return what a row has."""
        return cls(*np.split(row, np.cumsum([3, 3, *[N_SENSORS] * (2 * len(_TRAITS) - 1)])))


def learned(shadow: Shadow) -> Learned:
    """Return what a shadow has learned so far."""
    return of_particles(shadow._diagnosis.filter.particles)  # pyright: ignore[reportPrivateUsage]


def of_particles(particles: Particles) -> Learned:
    """Return what particles have learned: means by their weights, and what is left of their spread."""
    weights = np.exp(particles.logs)
    wheels = weights @ particles.wheels
    apart = weights @ (particles.wheels - wheels) ** 2
    means = np.einsum("n,nst->st", weights, particles.traits)
    # A trait's variance: that within each particle, and that between them.
    within = np.einsum("nstt->nst", particles.covariances)
    variances = np.einsum("n,nst->st", weights, within + (particles.traits - means) ** 2)
    (gain, turn, threshold), deviations = means.T, np.sqrt(variances).T
    return Learned(
        wheels,
        np.sqrt(apart),
        np.exp(gain),
        deviations[0],
        turn,
        deviations[1],
        threshold,
        deviations[2],
    )
