"""The likelihood of ambient readings, with what is learned of each sensor's gain and heading.

Where lamps shine with E on a sensor, O reads dark - E, at the least its floor. The likelihood of a reading z
is

    (1 - e) N(z; dark - E, s^2) + e / (dark - floor),    s^2 = noise^2 + STRAY^2 + (MODEL E)^2 + J P J' + v

with the covariance P of the sensor's traits, the derivatives J of E by them and a variance v of the lamp's
place; near the floor it is the probability of what lies below. That of a reply is the mean over twins of the
product over sensors, as the error of a pose is common to all of them.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.calibration import HEADING_SPREAD_DEG, LAMP_SPREAD
from khep_twin.shadow.planes import Planes
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]

MODEL = 0.08
"""Relative deviation of a lamp's light from the model's, besides the sensors' traits (assumed)."""

STRAY = 5.0
"""Deviation of the light from the model's where lamps hardly shine [counts] (assumed)."""

PERSISTING = 0.12
"""Part of a reading that is new where the error of the pose is more than all others (assumed)."""

OUTLIERS = 0.02
"""Part of the readings that nothing explains (assumed)."""

LEAST = 0.02, math.radians(0.5)
"""Standard deviations below which no gain and heading [rad] is taken for known (assumed)."""

_CLIPPED = 3.0
"""Deviations of the noise within which a reading is taken for one at the floor."""

_TURN = math.radians(1)
"""Turn for which the change of light is computed [rad]."""


class LightModel:
    """Likelihood of replies to O.

    Args:
        planes: Twins of the robot.

    Attributes:
        traits: Logarithm of each sensor's gain and its turn [rad], beyond those of the calibration (8, 2).
        covariances: Their covariances (8, 2, 2).
    """

    def __init__(self, planes: Planes) -> None:
        ambient = planes.ambient
        self._dark, self._floor = float(ambient["dark"]), float(ambient["floor"])
        self._noise = float(ambient["noise"])
        self.traits: Floats = np.zeros((N_SENSORS, 2))
        spread = np.diag(np.square([LAMP_SPREAD, math.radians(HEADING_SPREAD_DEG)]))
        self.covariances: Floats = np.tile(spread, (N_SENSORS, 1, 1))

    @property
    def turns(self) -> tuple[Floats, Floats]:
        """Turns of the sensors for which `light` needs the light (8,) [rad]."""
        return self.traits[:, 1], self.traits[:, 1] + _TURN

    def light(self, straight: Floats, turned: Floats) -> Floats:
        """Return light that has these values for both turns (n, 8, ...), and its slopes (2, n, 8, ...)."""
        gains = np.exp(self.traits[:, 0]).reshape(-1, *[1] * (straight.ndim - 2))
        return np.stack([straight * gains, (turned - straight) * (gains / _TURN)])

    def expected(self, light: Floats) -> Floats:
        """Return the readings where lamps shine so brightly (8,) [counts]."""
        return np.maximum(self._dark - light, self._floor)

    def new(self, light: Floats) -> Floats:
        """Return the part of each reading that is new (8,), by the spread of light with slope (2, n, 8)."""
        apart, own = light[0].var(axis=0), self._variance(light.mean(axis=1)[..., None])[:, 0]
        return 1 - (1 - PERSISTING) * apart / (apart + own)

    def logs(
        self, readings: NDArray[np.int64], light: Floats, new: Floats, vague: Floats | float = 0.0
    ) -> Floats:
        """Return the log likelihoods of a reply for light with its slope (2, n, 8, m), of each twin (n, m).

        Of each reading a part is new (8,), `vague` is the variance of the light (n, 8, m).
        """
        chance = self._chances(readings, light, vague)[0]
        return np.einsum("nsm,s->nm", np.log(chance), new)

    def learn(self, readings: NDArray[np.int64], light: Floats, part: float, new: float) -> None:
        """Learn the traits from a reply for light (2, n, 8), believed in part, of which a part is new."""
        mean, apart = light.mean(axis=1), light[0].var(axis=0)
        chance, inside, clipped = self._chances(readings, mean[:, None, :, None], apart[:, None])
        trust = np.where(clipped, 0, part * (1 - OUTLIERS) * inside[0, :, 0] / chance[0, :, 0])
        # Of an observation that is new in part, its own variance counts as much more.
        own = (self._noise**2 + STRAY**2 + (MODEL * mean[0]) ** 2 + apart / PERSISTING) / new
        by = -mean.T
        along = np.einsum("sij,sj->si", self.covariances, by)
        step = trust[:, None] * along / (own + (along * by).sum(axis=1))[:, None]
        self.traits += step * (readings - self._dark + mean[0])[:, None]
        self.covariances -= step[:, :, None] * along[:, None]
        for trait, least in enumerate(LEAST):
            variance = self.covariances[:, trait, trait]
            np.maximum(variance, least * least, out=variance)

    def _variance(self, light: Floats) -> Floats:
        """Return the variances of readings for light with its slope (2, ..., 8, m)."""
        (gain, both), (_, turn) = self.covariances.transpose(1, 2, 0)[:, :, :, None]
        bright, slope = light
        variance = bright * (bright * (MODEL * MODEL + gain) + 2 * both * slope) + turn * slope * slope
        return self._noise**2 + STRAY**2 + np.maximum(variance, 0)

    def _chances(
        self, readings: NDArray[np.int64], light: Floats, vague: Floats | float
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return probabilities of readings, also without outliers (n, 8, m), and which are clipped (8,)."""
        bright = light[0]
        variance = self._variance(light) + vague
        edge = self._floor + _CLIPPED * self._noise
        clipped = readings <= edge
        off = (np.maximum(readings, edge)[:, None] - self._dark + bright) / np.sqrt(variance)
        inside = np.exp(-0.5 * off * off) / np.sqrt(math.tau * variance)
        inside[:, clipped] = 1 / (1 + np.exp(-np.clip(1.702 * off[:, clipped], -500, 500)))
        rest = np.where(clipped, _AT_FLOOR, 1 / (self._dark - self._floor))[:, None]
        return (1 - OUTLIERS) * inside + OUTLIERS * rest, inside, clipped


_AT_FLOOR = 0.05
"""Part of what nothing explains that is at the floor (assumed)."""
