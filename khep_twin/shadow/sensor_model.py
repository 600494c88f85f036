"""The likelihood of proximity readings, and estimates of each sensor's gain, heading and threshold.

Each particle has an estimate of these traits of each sensor, with their covariance P, which a Kalman filter
updates by the readings. The likelihood of a reading z, where the twin predicts c = gain light - threshold, is

    (1 - e) N(z; c, s^2) + e / 1024,    s^2 = noise^2 + (MODEL c)^2 + J P J'

with the derivatives J of c by the traits; where the reading is clipped, at the limit or by the noise floor,
it is the probability of what is beyond. Of a reading that is new in part only, as the robot has hardly
moved since the last, noise and errors of the model have so much larger a variance for the traits.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planes import Planes, SensorLaw
from khep_twin.shadow.thresholds import THRESHOLDS

Floats = NDArray[np.float64]

OUTLIERS = 0.02
"""Part of the readings that the twins cannot explain (assumed)."""

MODEL = 0.1
"""Relative deviation of readings from the twin's, besides the sensors' traits (assumed)."""

LEAST = 0.03, math.radians(0.5), 10.0
"""Standard deviations below which no gain, turn [rad] and threshold [counts] is taken for known: the model is
no better (assumed)."""


UNLIT = 0.97
"""Part of its range above which no lamp shines on a sensor (assumed)."""


class SensorModel:
    """Likelihood of proximity readings.

    Attributes:
        quiet: Highest reading with nothing in reach [counts].
        limit: Highest reading [counts].
        range_left: Part of each sensor's range that the lamps left at the last reply (8,).
    """

    def __init__(self, planes: Planes) -> None:
        proximity = planes.proximity
        quantum = int(proximity["quantum"])
        self.limit = int(proximity["limit"])
        self.range_left: Floats = np.ones(8)
        self._expected: Floats = np.zeros(8)
        self.quiet = 10 * max(float(proximity["idle"]), float(proximity["floor"]))
        noise = np.square(proximity["noise"]) + quantum * quantum / 12
        self._law = SensorLaw(
            proximity["threshold"].astype(np.float64),
            noise.astype(np.float64),
            np.square(LEAST),
            self.limit,
            self.quiet,
            self.limit * (1 - _BRIGHT if planes.lamps.names else 1),
            MODEL,
            OUTLIERS,
        )

    def explain(
        self, particles: Particles, readings: NDArray[np.int64], use: NDArray[np.bool_], new: float = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Learn the traits of the particles' sensors from readings (8,) [counts], of which a part is new.

        Sensors that are not to be relied on (8,) have likelihood 1.

        Returns expected counts (8,), what each reading was less likely than an expected one (8,), and the log
        likelihoods (n, 8).
        """
        told = left = range_left(particles.planes)
        if particles.planes.others:
            # What is seen where nothing was expected may be another robot.
            use = use & ((readings <= self.quiet) | (self._expected > THRESHOLDS.in_sight))
        if particles.planes.lamps_are_unknown:
            # A sensor that a lamp may blind tells only what it sees.
            is_lit = left.min(axis=0) < UNLIT
            use = use & ~(is_lit & (readings <= self.quiet))
            told = np.ones_like(left)
        counts, deviations, likelihood = particles.planes.explain(
            particles.traits, particles.covariances, self._law, told, readings, use, new
        )
        weights = np.exp(particles.logs - log_of_sum(particles.logs))
        self._expected = expected = np.clip(weights @ counts, 0, self.limit)
        self.range_left = weights @ left
        clipped = (readings <= self.quiet) | (readings >= self._law.full)
        best = np.where(clipped, 1.0, 1 / (weights @ deviations * math.sqrt(math.tau)))
        surprise = np.where(use, np.log(np.maximum(best / (weights @ likelihood), 1.0)), 0.0)
        return expected, surprise, np.where(use, np.log(likelihood), 0.0)


def range_left(planes: Planes) -> Floats:
    """Return the part of each sensor's range that the lamps leave (n, 8)."""
    if not planes.lamps.names:
        return np.ones((len(planes), 8))
    reach = float(planes.ambient["dark"] - planes.ambient["floor"])
    return np.clip(1 - planes.lamplight(_BRIGHT * reach).sum(axis=2) / reach, 0, 1)


def range_left_at_least(particles: Particles) -> Floats:
    """Return that part, where the robot probably is, if nothing stood in the light of any lamp (8,)."""
    one = particles.planes.taken(np.array([np.argmax(particles.logs)]))
    one.clear_away()
    return range_left(one)[0]


def log_of_sum(logs: Floats) -> float:
    """Return the logarithm of the sum of numbers with these logarithms (n,)."""
    most = float(logs.max())
    return most + math.log(float(np.exp(logs - most).sum()))


_BRIGHT = 0.1
"""Part of the range from which on a lamp's light matters."""
