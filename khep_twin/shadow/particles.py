"""Particles of a filter: planar twins with their own weights, wheels and gains, and what they learned."""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.shadow.planes import Planes
from khep_twin.units import N_SENSORS, SENSOR_LABELS

Floats = NDArray[np.float64]

FORGOTTEN_S = 60.0
"""Time constant with which what was learned of wheels and sensors gives way to what was known before: errors
of the model were learned, too (assumed) [s]."""

_POSITIONS = [kernel.LEFT + kernel.Wheel.POSITION, kernel.RIGHT + kernel.Wheel.POSITION]


class Prior(NamedTuple):
    """Knowledge of a robot before it drives.

    Attributes:
        wheels: Standard deviations of wheels' mean radius, ratio and base, as parts (3,).
        gain: Standard deviation of the logarithm of the sensors' common gain.
        traits: Covariances of each sensor's traits (8, 3, 3).
    """

    wheels: Floats
    gain: float
    traits: Floats


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


@dataclass(slots=True)
class Particles:
    """Particles of a filter.

    Attributes:
        planes: Their twins.
        prior: What is known of the robot before it drives.
        logs: Logarithms of their weights (n,).
        wheels: Wheels' mean radius, ratio and base, as parts of the calibration's (n, 3).
        traits: Logarithm of each sensor's gain, its turn [rad] and its threshold [counts], beyond those of
            the calibration (n, 8, 3).
        covariances: Their covariances (n, 8, 3, 3).
        counted: Counters as replied last, less the twins' own (n, 2) [pulses]; NaN before the first reply.
        changes: What each has, among the changes that a filter considers; 0 for none of them (n,).
        since_ns: Time since when it has that (n,) [ns].
    """

    planes: Planes
    prior: Prior
    logs: Floats
    wheels: Floats
    traits: Floats
    covariances: Floats
    counted: Floats
    changes: NDArray[np.int64]
    since_ns: NDArray[np.int64]

    def taken(self, indices: NDArray[np.intp] | slice) -> "Particles":
        """Return copies of particles at these indices, or those of a slice themselves."""
        rest = (getattr(self, each.name)[indices] for each in fields(self)[2:])
        return Particles(self.planes.taken(indices), self.prior, *rest)

    def joined(self, other: "Particles") -> "Particles":
        """Return these and others of the same time."""
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self)[2:])
        rest = (np.concatenate(pair) for pair in pairs)
        return Particles(self.planes.joined(other.planes), self.prior, *rest)

    def drawn(self, count: int, offset: float) -> "Particles":
        """Return copies drawn by the weights, at equal distances from an offset of 0 to 1."""
        made = self.taken(drawn(np.exp(self.logs - self.logs.max()), count, offset))
        made.logs = np.full(count, -math.log(count))
        return made

    def count(self, counters: NDArray[np.int64]) -> Floats:
        """Move the particles as counters tell (2,); return what they tell beyond commands (n, 2) [pulses]."""
        off = counters - self.planes.registers[:, _POSITIONS].astype(np.float64)
        beyond = off - np.where(np.isnan(self.counted), off, self.counted)
        self.planes.roll(beyond)
        self.counted[:] = off
        return beyond

    def forget(self, passed_s: float, rng: np.random.Generator) -> None:
        """Forget a part of what was learned of wheels and sensors, by the time since the last call [s]."""
        kept = math.exp(-passed_s / FORGOTTEN_S)
        drift = rng.standard_normal((len(self), 4)) * math.sqrt(1 - kept * kept)
        self.wheels = 1 + (self.wheels - 1) * kept + drift[:, :3] * self.prior.wheels
        self.planes.set_wheels(*self.wheels.T)
        self.traits *= kept
        self.traits[:, :, 0] += drift[:, 3:] * self.prior.gain
        self.covariances *= kept * kept
        self.covariances += (1 - kept * kept) * self.prior.traits

    def learned(self) -> LearnedValues:
        """Return what was learned so far: means by the weights, and what is left of their spread."""
        weights = np.exp(self.logs)
        wheels = weights @ self.wheels
        gains = self.traits[:, :, 0]
        logs = weights @ gains
        apart = weights @ (self.wheels - wheels) ** 2
        # A gain's variance: that within each particle, and that between them.
        gain_apart = weights @ (self.covariances[:, :, 0, 0] + (gains - logs) ** 2)
        return LearnedValues(wheels, np.sqrt(apart), np.exp(logs), np.sqrt(gain_apart))

    def __len__(self) -> int:
        return len(self.logs)


def drawn(weights: Floats, count: int, offset: float) -> NDArray[np.intp]:
    """Return indices by weights, in order, at equal distances from an offset of 0 to 1 (count,)."""
    edges: Floats = (np.arange(count) + offset) / count * weights.sum()
    return np.minimum(np.searchsorted(np.cumsum(weights), edges), len(weights) - 1)
