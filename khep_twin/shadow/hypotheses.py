"""Hypotheses of what may be wrong: each makes twins with a fault of sound ones, and sound ones of those.

Those of wheels are in `wheel_faults`, those of things in `thing_faults`, of a robot that is elsewhere in
`displacements`.
"""

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles

Floats = NDArray[np.float64]

QUOTA = 150
"""Particles of a change at the least."""

REFINED = 0.2
"""Part of their deviation by which values are drawn anew (assumed)."""


class Hypothesis(ABC):
    """One fault.

    Attributes:
        channel: Channel in which it shows.
        rare: Logarithm of the odds against it, in a second (assumed).
        quota: Particles that consider it, at the least.
        is_found: True if only a search can tell where it leads: it does not begin, or end, by itself.
        is_fault: True unless nobody needs to be told.
    """

    channel: ClassVar[str]
    rare: ClassVar[float]
    quota: ClassVar[int] = QUOTA
    is_found: ClassVar[bool] = False
    is_fault: ClassVar[bool] = True

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the fault."""

    @property
    def alike(self) -> str:
        """Name of all faults that look like it."""
        return self.name

    @abstractmethod
    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Give particles the fault."""

    @abstractmethod
    def end(self, particles: Particles) -> None:
        """Take it from them."""

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw what differs among equally probable particles with the fault anew, close to what it is."""
        return  # by default nothing does


class Placed(Hypothesis):
    """One fault that has a place, which a search makes probable step by step."""

    @abstractmethod
    def draw_near(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Draw the place of each particle anew, within a standard deviation of what it is [m]."""


def refined(values: Floats, least: float, rng: np.random.Generator) -> Floats:
    """Return values drawn anew, each close to one of these, with the same mean and deviation (n, ...).

    There is a least deviation, as few may have been drawn many times by their weights.
    """
    mean, deviation = values.mean(axis=0), np.maximum(values.std(axis=0), least)
    kept = math.sqrt(1 - REFINED * REFINED)
    return mean + kept * (values - mean) + REFINED * deviation * rng.standard_normal(values.shape)
