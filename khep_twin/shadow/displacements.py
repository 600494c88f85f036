"""Hypotheses of a robot that someone has moved: pushed a little, which is no fault, or put elsewhere."""

import math

import numpy as np

from khep_twin.shadow.hypotheses import Placed
from khep_twin.shadow.particles import Particles

_DISPLACEMENT = 0.012, 0.012, math.radians(12)
"""Standard deviations by which a robot is displaced [m, rad] (assumed)."""

_POSE_JITTER = 0.002, 0.002, math.radians(2)
"""Standard deviations of the jitter of a pose [m, rad] (assumed)."""

_TURN_PER_METRE = 10.0
"""Standard deviation of roughened headings over that of positions [rad/m] (assumed)."""


class Relocated(Placed):
    """A robot at another pose; its odds are per onset of unexpected replies, not per second."""

    needs_search = True

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Do nothing: replies must first show where it is."""

    def end(self, particles: Particles) -> None:
        """Do nothing: its former pose is no longer known."""

    def roughen(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Add noise to the pose."""
        _perturb(particles, (spread, spread, _TURN_PER_METRE * spread), rng)


class Displaced(Relocated):
    """A robot a little away from its estimate, as it was pushed, slid or was located wrongly: no fault."""

    log_odds_against = 6.0
    quota = 300
    is_fault = False

    @property
    def name(self) -> str:
        """Name of the alarm."""
        return "robot displaced"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Move the robot."""
        _perturb(particles, _DISPLACEMENT, rng)


class Lifted(Relocated):
    """A robot that someone lifted and put elsewhere; `Search` draws its pose."""

    log_odds_against = 10.0
    quota = 600

    @property
    def name(self) -> str:
        """Name of the alarm."""
        return "robot lifted"

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the pose."""
        _perturb(particles, _POSE_JITTER, rng)


def _perturb(particles: Particles, deviations: tuple[float, float, float], rng: np.random.Generator) -> None:
    """Add noise of these standard deviations to the poses [m, rad]."""
    twins = particles.twins
    twins.move(twins.poses + rng.standard_normal((len(particles), 3)) * deviations)
