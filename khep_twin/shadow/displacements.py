"""Robots that someone has moved: pushed a little, which is no fault, or put elsewhere."""

import math

import numpy as np

from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.particles import Particles

_DISPLACED = 0.012, 0.012, math.radians(12)
"""Standard deviations by which a robot is displaced [m, rad] (assumed)."""

_PLACE_REFINED = 0.002, 0.002, math.radians(2)
"""Standard deviations by which a pose is drawn anew [m, rad] (assumed)."""


class Displaced(Hypothesis):
    """A robot that is a little off, as it was pushed, slid or was taken for elsewhere: no fault."""

    channel, rare, quota, is_found, is_fault = "proximity", 8.0, 300, True, False

    @property
    def name(self) -> str:
        """Name of what has happened."""
        return "robot displaced"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Move the robot."""
        _push(particles, _DISPLACED, rng)

    def end(self, particles: Particles) -> None:
        """Do nothing: it is not moved back."""


class Lifted(Hypothesis):
    """A robot that was put elsewhere at once; `Search` has the places where that may be."""

    channel, rare, quota, is_found = "proximity", 14.0, 600, True

    @property
    def name(self) -> str:
        """Name of what has happened."""
        return "robot lifted"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Do nothing: no place is likely before replies have told one."""

    def end(self, particles: Particles) -> None:
        """Do nothing: where it was is not known any more."""

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its pose anew, close to what it is."""
        _push(particles, _PLACE_REFINED, rng)


def _push(particles: Particles, by: tuple[float, float, float], rng: np.random.Generator) -> None:
    """Move the robots by these standard deviations [m, rad]."""
    planes = particles.planes
    planes.move(planes.poses + rng.standard_normal((len(particles), 3)) * by)
