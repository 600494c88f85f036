"""Hypotheses of faults: each injects its fault into particles (simulated robots), and removes it.

`wheel_faults` has those of wheels, `thing_faults` of obstacles, `displacements` of a robot that was moved.
"""

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from khep_twin.shadow.particles import Floats, Particles

QUOTA = 150
"""Least number of particles of a change."""

JITTER = 0.2
"""Noise of resampled values, as a part of their standard deviation (assumed)."""


class Hypothesis(ABC):
    """One fault.

    Attributes:
        channel: Channel in which it shows.
        log_odds_against: Logarithm of the odds against its start within a second (assumed).
        quota: Least number of particles that have it.
        needs_search: True if only a search injects it; others may start and end at any resampling.
        is_fault: False if it has no alarm.
    """

    channel: ClassVar[str] = "proximity"
    log_odds_against: ClassVar[float]
    quota: ClassVar[int] = QUOTA
    needs_search: ClassVar[bool] = False
    is_fault: ClassVar[bool] = True

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the fault."""

    @property
    def group(self) -> str:
        """Name of its ambiguity group: all faults that look like it."""
        return self.name

    @abstractmethod
    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Inject the fault into particles."""

    @abstractmethod
    def end(self, particles: Particles) -> None:
        """Remove the fault from particles."""

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the fault's values in equally probable particles; by default there are none."""
        return


class Placed(Hypothesis):
    """A fault with an unknown place, of the robot or of an obstacle, which a search samples by tempering."""

    @abstractmethod
    def roughen(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Add noise of a standard deviation to the place of each particle [m]."""


def shrink_and_jitter(values: Floats, min_deviation: float, rng: np.random.Generator) -> Floats:
    """Return values with noise, shrunk to the mean so that mean and deviation remain the same (n, ...).

    This is the kernel smoothing of Liu and West. `min_deviation` serves values that were drawn many times.
    """
    mean, deviation = values.mean(axis=0), np.maximum(values.std(axis=0), min_deviation)
    shrinkage = math.sqrt(1 - JITTER * JITTER)
    return mean + shrinkage * (values - mean) + JITTER * deviation * rng.standard_normal(values.shape)
