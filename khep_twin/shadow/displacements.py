"""Robots that someone has moved: pushed a little, which is no fault, or put elsewhere."""

import math

import numpy as np

from khep_twin.shadow.hypotheses import Placed
from khep_twin.shadow.particles import Particles

_DISPLACED = 0.012, 0.012, math.radians(12)
"""Standard deviations by which a robot is displaced [m, rad] (assumed)."""

_PLACE_REFINED = 0.002, 0.002, math.radians(2)
"""Standard deviations by which a pose is drawn anew [m, rad] (assumed)."""

_TURN = 10.0
"""Deviation of headings drawn anew, as a multiple of that of places [rad/m] (assumed)."""


class Elsewhere(Placed):
    """A robot that is elsewhere; its odds are those at a time when replies surprise, not in a second."""

    channel, is_found = "proximity", True

    def draw_near(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Draw its pose anew."""
        _push(particles, (spread, spread, _TURN * spread), rng)


class Displaced(Elsewhere):
    """A robot that is a little off, as it was pushed, slid or was taken for elsewhere: no fault."""

    rare, quota, is_fault = 6.0, 300, False

    @property
    def name(self) -> str:
        """Name of what has happened."""
        return "robot displaced"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Move the robot."""
        _push(particles, _DISPLACED, rng)

    def end(self, particles: Particles) -> None:
        """Do nothing: it is not moved back."""


class Lifted(Elsewhere):
    """A robot that was put elsewhere at once; `Search` has the places where that may be."""

    rare, quota = 10.0, 600

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
