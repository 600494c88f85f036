"""The likelihood of proximity readings, and estimates of each sensor's gain, heading and threshold.

Each particle has an estimate of these traits of each sensor, with their covariance P, which a Kalman filter
updates by the readings. The likelihood of a reading z, where the twin predicts c = gain light - threshold, is

    (1 - e) N(z; c, s^2) + e / 1024,    s^2 = noise^2 + (MODEL c)^2 + J P J'

with the derivatives J of c by the traits; for a reading that is clipped, at the limit or at the noise floor,
it is the probability of readings beyond. For the traits, the variance of noise and errors of the model is
larger the lower the novelty of the reading is (`persistence`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Floats, Particles
from khep_twin.shadow.planes import Booleans, SensorLaw, Twins

OUTLIERS = 0.02
"""Part of the readings that are outliers (assumed)."""

MODEL_DEVIATION = 0.1
"""Relative deviation of readings from the twin's, besides the sensors' traits (assumed)."""

MIN_DEVIATIONS = 0.03, math.radians(0.5), 10.0
"""Least standard deviations of a gain, a turn [rad] and a threshold [counts] (assumed)."""

UNLIT = 0.97
"""Usable part of its range above which no lamp shines on a sensor (assumed)."""

_MIN_LAMP_SHARE = 0.1
"""Part of the range from which a lamp's light matters."""


class SensorModel:
    """Likelihood of proximity readings.

    Attributes:
        quiet: Highest reading with nothing in reach [counts]; below all of sensors that rest above 0.
        limit: Highest reading [counts].
        usable_range: Part of each sensor's range that the lamps left at the last reply (s,).
    """

    def __init__(self, twins: Twins) -> None:
        proximity = twins.proximity
        quantum = int(proximity["quantum"])
        self.limit = int(proximity["limit"])
        self._near = twins.entry.body.near_counts
        self.usable_range: Floats = np.ones(twins.n_sensors)
        self._expected: Floats = np.zeros(twins.n_sensors)
        # A sensor that rests above 0 has no quiet reading: 0 is that of a dead one.
        is_resting = proximity["threshold"].max() < 0
        idle, floor = float(proximity["idle"]), float(proximity["floor"])
        self.quiet = min(floor, 0.0) - 1 if is_resting else 10 * max(idle, floor)
        noise = np.square(proximity["noise"]) + quantum * quantum / 12
        self._law = SensorLaw(
            proximity["threshold"].astype(np.float64),
            noise.astype(np.float64),
            np.square(MIN_DEVIATIONS),
            self.limit,
            self.quiet,
            self.limit * (1 - _MIN_LAMP_SHARE if twins.lamps.names else 1),
            MODEL_DEVIATION,
            OUTLIERS,
        )

    def observe(
        self, particles: Particles, readings: NDArray[np.int64], is_used: Booleans, novelty: float = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Update the traits of the particles' sensors by readings (s,) [counts] with a novelty.

        Sensors that are not used (s,) have likelihood 1.

        Returns expected counts (s,), surprisals (s,), which are log likelihood ratios of the most probable
        reading and the actual one, and the log likelihoods (n, s).
        """
        believed_range = lamp_range = usable_range(particles.twins)
        if particles.twins.has_other_robots:
            # An unexpected obstacle may be another robot.
            is_used = is_used & ((readings <= self.quiet) | (self._expected > self._near))
        if particles.twins.lamps_are_unknown:
            # Of a sensor that a lamp may blind, only readings with something in sight count.
            is_lit = lamp_range.min(axis=0) < UNLIT
            is_used = is_used & ~(is_lit & (readings <= self.quiet))
            believed_range = np.ones_like(lamp_range)
        traits = particles.traits, particles.covariances
        inputs = believed_range, readings, is_used, novelty
        counts, deviations, likelihood = particles.twins.observe(*traits, self._law, *inputs)
        weights = np.exp(particles.log_weights - log_sum_exp(particles.log_weights))
        self._expected = expected = np.clip(weights @ counts, 0, self.limit)
        self.usable_range = weights @ lamp_range
        is_clipped = (readings <= self.quiet) | (readings >= self._law.full)
        highest = np.where(is_clipped, 1.0, 1 / (weights @ deviations * math.sqrt(math.tau)))
        surprisal = np.where(is_used, np.log(np.maximum(highest / (weights @ likelihood), 1.0)), 0.0)
        return expected, surprisal, np.where(is_used, np.log(likelihood), 0.0)


def usable_range(twins: Twins) -> Floats:
    """Return the part of each sensor's range that the lamps leave (n, s)."""
    if not twins.lamps.names:
        return np.ones((len(twins), twins.n_sensors))
    full_range = float(twins.ambient["dark"] - twins.ambient["floor"])
    return np.clip(1 - twins.lamplight(_MIN_LAMP_SHARE * full_range).sum(axis=2) / full_range, 0, 1)


def min_usable_range(particles: Particles) -> Floats:
    """Return that part at the most probable pose, if no obstacle were in the light of any lamp (s,)."""
    best_twin = particles.twins.select(np.array([np.argmax(particles.log_weights)]))
    best_twin.remove_obstacles()
    return usable_range(best_twin)[0]


def log_sum_exp(log_values: Floats) -> float:
    """Return the logarithm of a sum of numbers, by their logarithms (n,)."""
    largest = float(log_values.max())
    return largest + math.log(float(np.exp(log_values - largest).sum()))
