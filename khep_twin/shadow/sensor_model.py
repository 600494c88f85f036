"""The likelihood of proximity readings, and the estimate of each sensor's gain by them.

Each particle has an estimate of the logarithm of each sensor's gain, with a variance, which a Kalman filter
updates by the readings. The likelihood of a reading z, where the twin predicts c = gain light - threshold, is

    (1 - e) N(z; c, s^2) + e / 1024,    s^2 = noise^2 + (MODEL c)^2 + (gain light)^2 var(log gain)

and where the reading is clipped, at the limit or by the noise floor, the probability of what is beyond.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planes import Planes

Floats = NDArray[np.float64]

OUTLIERS = 0.02
"""Part of the readings that the twins cannot explain (assumed)."""

MODEL = 0.25
"""Relative deviation of readings from the twin's, besides their gain: headings, lobes (assumed)."""

GAIN_DEVIATION = 0.25
"""Standard deviation of the logarithm of one sensor's gain, besides the common one: its own 13 %, and what a
wrong heading does to it."""

GAIN_LEAST = 0.03
"""Standard deviation below which no gain is taken for known: the model is no better."""


class SensorModel:
    """Likelihood of proximity readings.

    Args:
        planes: Twins of the robot.

    Attributes:
        quiet: Highest reading with nothing in reach [counts].
        limit: Highest reading [counts].
        range_left: Part of each sensor's range that the lamps left at the last reply (8,).
    """

    def __init__(self, planes: Planes) -> None:
        proximity = planes.proximity
        self._threshold: Floats = proximity["threshold"]
        self._noise: Floats = proximity["noise"]
        self._quantum = int(proximity["quantum"])
        self.limit = int(proximity["limit"])
        self.range_left: Floats = np.ones(8)
        self.quiet = 4 * max(float(proximity["idle"]), float(proximity["floor"]))

    def explain(
        self, particles: Particles, readings: NDArray[np.int64], use: NDArray[np.bool_]
    ) -> tuple[Floats, Floats, Floats]:
        """Learn the particles' gains from readings.

        Returns expected counts (8,), what each reading was less likely than an expected one (8,), and the log
        likelihoods (n, 8).

        Args:
            particles: Particles.
            readings: Proximity (8,) [counts].
            use: Sensors to rely on (8,); the others have likelihood 1.
        """
        scaled = particles.planes.illuminate() * np.exp(particles.gains)
        range_left = self._range_left(particles)
        counts = np.minimum(scaled - self._threshold, self.limit * range_left)
        apart = MODEL * np.maximum(counts, 0)
        noise = self._noise * self._noise + self._quantum * self._quantum / 12 + apart * apart
        total_variance = noise + scaled * scaled * particles.variances
        deviation = np.sqrt(total_variance)
        low, high = readings <= self.quiet, readings >= self.limit
        clipped = low | high
        z = (readings - counts) / deviation
        inside = np.exp(-0.5 * z * z) / (deviation * math.sqrt(math.tau))
        explained = (1 - OUTLIERS) * np.where(clipped, below(np.where(high, -z, z)), inside)
        likelihood = explained + OUTLIERS * np.where(clipped, 1.0, 1 / (self.limit + 1))
        weights = np.exp(particles.logs - particles.logs.max())
        weights /= weights.sum()
        expected = np.clip(weights @ counts, 0, self.limit)
        self.range_left = weights @ range_left
        best = np.where(clipped, 1.0, 1 / (weights @ deviation * math.sqrt(math.tau)))
        surprise = np.where(
            use, particles.temper * np.log(np.maximum(best / (weights @ likelihood), 1.0)), 0.0
        )
        # The gains, where a reading is inside of the range and explained.
        trust = np.where(clipped | ~use | (range_left < 1), 0.0, explained / likelihood)
        step = trust * scaled * particles.variances / total_variance
        particles.gains += step * (readings - counts)
        particles.variances = np.maximum(particles.variances * (1 - step * scaled), GAIN_LEAST**2)
        return expected, surprise, particles.temper * np.where(use, np.log(likelihood), 0.0)

    def _range_left(self, particles: Particles) -> Floats:
        """Return the part of each sensor's range that the lamps leave (n, 8)."""
        if not particles.planes.lamps.names:
            return np.ones(particles.gains.shape)
        ambient = particles.planes.ambient
        reach = float(ambient["dark"] - ambient["floor"])
        return np.clip(1 - particles.planes.lamplight(_BRIGHT * reach).sum(axis=2) / reach, 0, 1)


def log_of_sum(logs: Floats) -> float:
    """Return the logarithm of the sum of numbers with these logarithms (n,)."""
    most = float(logs.max())
    return most + math.log(float(np.exp(logs - most).sum()))


def below(z: Floats) -> Floats:
    """Return the probability of a normal number below z, to 0.01."""
    return 1 / (1 + np.exp(-np.clip(1.702 * z, -500, 500)))


_BRIGHT = 0.2
"""Part of the range from which on a lamp's light matters."""
