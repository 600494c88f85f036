"""Particles of a filter: planar twins with weights, and with estimates of wheels and sensors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.planes import Floats, Twins

FORGETTING_S = 60.0
"""Time constant of the decay of learned values, which contain model errors, to the prior (assumed) [s]."""


class Prior(NamedTuple):
    """Knowledge of a robot before it drives.

    Attributes:
        wheels: Standard deviations of wheels' mean radius, ratio and base, as parts (3,).
        gain: Standard deviation of the logarithm of the sensors' common gain.
        traits: Covariances of each sensor's traits (s, 3, 3).
    """

    wheels: Floats
    gain: float
    traits: Floats


def value_names(sensors: Sequence[str]) -> list[str]:
    """Return the names of the values of a row, multiples of the calibration's, for a robot's sensors."""
    wheels = [
        f"{part}{name}" for part in ("", "deviation of ") for name in ("radius", "right over left", "base")
    ]
    return wheels + [f"{part}gain {name}" for part in ("", "deviation of log ") for name in sensors]


class LearnedValues(NamedTuple):
    """Wheels and gains as multiples of those of the calibration, with standard deviations.

    Attributes:
        wheels: Mean radius, ratio right over left, and base (3,).
        wheel_deviations: Their standard deviations (3,).
        gains: Gains of the sensors' proximity, geometric means (s,).
        gain_deviations: Standard deviations of their logarithms (s,).
    """

    wheels: Floats
    wheel_deviations: Floats
    gains: Floats
    gain_deviations: Floats

    @property
    def row(self) -> Floats:
        """Row of all values (6 + 2 s,), as `value_names` names them."""
        return np.concatenate(self)

    @classmethod
    def from_row(cls, row: Floats) -> Self:
        """Return the values of a row."""
        return cls(*np.split(row, [3, 6, 3 + len(row) // 2]))


@dataclass(slots=True)
class Particles:
    """Particles of a filter.

    Attributes:
        twins: Their twins.
        prior: Knowledge of the robot before it drives.
        log_weights: Logarithms of their weights (n,).
        wheels: Wheels' mean radius, ratio and base, as multiples of the calibration's (n, 3).
        traits: Logarithm of each sensor's gain, its turn [rad] and its threshold [counts], beyond those of
            the calibration (n, s, 3).
        covariances: Their covariances (n, s, 3, 3).
        counter_offsets: Counters of the last reply less those of the twins (n, 2) [pulses]; NaN before any.
        changes: Number of the change (of `ParticleFilter.changes`) that each has; 0 for none (n,).
        since_ns: Time since when each has its change (n,) [ns].
    """

    twins: Twins
    prior: Prior
    log_weights: Floats
    wheels: Floats
    traits: Floats
    covariances: Floats
    counter_offsets: Floats
    changes: NDArray[np.int64]
    since_ns: NDArray[np.int64]

    def select(self, indices: NDArray[np.intp] | slice) -> "Particles":
        """Return copies of particles at these indices, or views of those of a slice."""
        rest = (getattr(self, field.name)[indices] for field in fields(self)[2:])
        return Particles(self.twins.select(indices), self.prior, *rest)

    def concatenate(self, other: "Particles") -> "Particles":
        """Return these particles and others of the same time."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self)[2:])
        rest = (np.concatenate(pair) for pair in pairs)
        return Particles(self.twins.concatenate(other.twins), self.prior, *rest)

    def resample(self, count: int, offset: float) -> "Particles":
        """Return equally probable copies by systematic resampling with an offset of 0 to 1."""
        weights = np.exp(self.log_weights - self.log_weights.max())
        copies = self.select(resample_indices(weights, count, offset))
        copies.log_weights = np.full(count, -math.log(count))
        return copies

    def follow_counters(self, counters: NDArray[np.int64]) -> Floats:
        """Move the particles by counters (2,); return the residuals beyond commands (n, 2) [pulses]."""
        offsets = counters - self.twins.counters
        residuals = offsets - np.where(np.isnan(self.counter_offsets), offsets, self.counter_offsets)
        self.twins.roll_wheels(residuals)
        self.counter_offsets[:] = offsets
        return residuals

    def forget(self, passed_s: float, rng: np.random.Generator, is_in_sight: bool = True) -> None:
        """Let learned wheels decay to the prior, and sensors with something in sight, by a time [s]."""
        retention = math.exp(-passed_s / FORGETTING_S)
        drift = rng.standard_normal((len(self), 4)) * math.sqrt(1 - retention * retention)
        self.wheels = 1 + (self.wheels - 1) * retention + drift[:, :3] * self.prior.wheels
        self.twins.set_wheels(*self.wheels.T)
        if not is_in_sight:
            return  # Nothing false is learned of sensors without readings.
        self.traits *= retention
        self.traits[:, :, 0] += drift[:, 3:] * self.prior.gain
        self.covariances *= retention * retention
        self.covariances += (1 - retention * retention) * self.prior.traits

    def learned(self) -> LearnedValues:
        """Return the values learned so far: weighted means, and standard deviations."""
        weights = np.exp(self.log_weights)
        wheels = weights @ self.wheels
        gains = self.traits[:, :, 0]
        log_gains = weights @ gains
        wheel_variances = weights @ (self.wheels - wheels) ** 2
        # A gain's variance is that within each particle plus that between them.
        gain_variances = weights @ (self.covariances[:, :, 0, 0] + (gains - log_gains) ** 2)
        return LearnedValues(wheels, np.sqrt(wheel_variances), np.exp(log_gains), np.sqrt(gain_variances))

    def __len__(self) -> int:
        return len(self.log_weights)


def resample_indices(weights: Floats, count: int, offset: float) -> NDArray[np.intp]:
    """Return sorted indices by weights, of systematic resampling with an offset of 0 to 1 (count,)."""
    positions: Floats = (np.arange(count) + offset) / count * weights.sum()
    return np.minimum(np.searchsorted(np.cumsum(weights), positions), len(weights) - 1)
