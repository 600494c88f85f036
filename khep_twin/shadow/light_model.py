"""The likelihood of ambient readings, with estimates of each sensor's gain and heading.

Where lamps shine with E [counts] on a sensor, command O reads dark - E, but at least the sensor's floor. The
likelihood of a reading z, with the part e of outliers, is

    (1 - e) N(z; dark - E, s^2) + e / (dark - floor),    s^2 = noise^2 + STRAY^2 + (MODEL E)^2 + J P J' + v

with the covariance P of the sensor's traits (log gain, turn), derivatives J of E by them and the variance
v due to the lamp's place; near the floor it is the probability of lower readings. That of a whole reply is
the mean over twins of the product over sensors, as all sensors share the error of the pose.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.calibration import HEADING_SPREAD_DEG, LAMP_SPREAD
from khep_twin.shadow.planes import Booleans, Floats, Twins

MODEL_DEVIATION = 0.08
"""Relative deviation of a lamp's light from the model's, besides the sensors' traits (assumed)."""

STRAY_DEVIATION = 5.0
"""Standard deviation of the light from the model's, even where lamps hardly shine [counts] (assumed)."""

MIN_POSE_NOVELTY = 0.12
"""Novelty of a reading where the error of the pose is larger than all others (assumed)."""

OUTLIERS = 0.02
"""Part of the readings that are outliers (assumed)."""

MIN_DEVIATIONS = 0.02, math.radians(0.5)
"""Least standard deviations of a gain and a heading [rad] (assumed)."""

_CLIP_DEVIATIONS = 3.0
"""Standard deviations of the noise within which a reading is clipped at the floor."""

_TURN = math.radians(1)
"""Turn for which the change of light is computed [rad]."""

_FLOOR_OUTLIERS = 0.05
"""Part of the outliers that are at the floor (assumed)."""


class LightModel:
    """Likelihood of replies to O.

    Args:
        twins: Twins of the robot.

    Attributes:
        traits: Logarithm of each sensor's gain and its turn [rad], beyond those of the calibration (s, 2).
        covariances: Their covariances (s, 2, 2).
    """

    def __init__(self, twins: Twins) -> None:
        ambient = twins.ambient
        self._dark, self._floor = float(ambient["dark"]), float(ambient["floor"])
        self._noise = float(ambient["noise"])
        self.traits: Floats = np.zeros((twins.n_sensors, 2))
        spread = np.diag(np.square([LAMP_SPREAD, math.radians(HEADING_SPREAD_DEG)]))
        self.covariances: Floats = np.tile(spread, (twins.n_sensors, 1, 1))

    @property
    def turns(self) -> tuple[Floats, Floats]:
        """Turns of the sensors for which `light` needs the light (s,) [rad]."""
        return self.traits[:, 1], self.traits[:, 1] + _TURN

    def light(self, straight: Floats, turned: Floats) -> Floats:
        """Return the light, of these values for both turns (n, s, ...), with its slope (2, n, s, ...)."""
        gains = np.exp(self.traits[:, 0]).reshape(-1, *[1] * (straight.ndim - 2))
        return np.stack([straight * gains, (turned - straight) * (gains / _TURN)])

    def expected(self, light: Floats) -> Floats:
        """Return the readings for light (s,) [counts]."""
        return np.maximum(self._dark - light, self._floor)

    def novelty(self, light: Floats) -> Floats:
        """Return the novelty of each reading (s,), by the spread of light with its slope (2, n, s)."""
        pose_variance = light[0].var(axis=0)
        sensor_variance = self._variance(light.mean(axis=1)[..., None])[:, 0]
        return 1 - (1 - MIN_POSE_NOVELTY) * pose_variance / (pose_variance + sensor_variance)

    def log_likelihoods(
        self, readings: NDArray[np.int64], light: Floats, novelty: Floats, variance: Floats | float = 0.0
    ) -> Floats:
        """Return the log likelihoods of a reply for light with its slope (2, n, s, m), of each twin (n, m).

        `novelty` is that of each reading (s,), `variance` that of the light (n, s, m).
        """
        likelihood = self._likelihoods(readings, light, variance)[0]
        return np.einsum("nsm,s->nm", np.log(likelihood), novelty)

    def learn(self, readings: NDArray[np.int64], light: Floats, probability: float, novelty: float) -> None:
        """Update the traits by a reply for light (2, n, s) of a belief: a Kalman filter for each sensor."""
        mean, pose_variance = light.mean(axis=1), light[0].var(axis=0)
        mean_light = mean[:, None, :, None]
        likelihood, inlier, is_clipped = self._likelihoods(readings, mean_light, pose_variance[:, None])
        trust = np.where(is_clipped, 0, probability * (1 - OUTLIERS) * inlier[0, :, 0] / likelihood[0, :, 0])
        # The less novel an observation is, the larger is the variance of its noise.
        noise = self._noise**2 + STRAY_DEVIATION**2 + (MODEL_DEVIATION * mean[0]) ** 2
        noise = (noise + pose_variance / MIN_POSE_NOVELTY) / novelty
        jacobian = -mean.T
        covariance = np.einsum("sij,sj->si", self.covariances, jacobian)
        gain = trust[:, None] * covariance / (noise + (covariance * jacobian).sum(axis=1))[:, None]
        self.traits += gain * (readings - self._dark + mean[0])[:, None]
        self.covariances -= gain[:, :, None] * covariance[:, None]
        for trait, min_deviation in enumerate(MIN_DEVIATIONS):
            variance = self.covariances[:, trait, trait]
            np.maximum(variance, min_deviation * min_deviation, out=variance)

    def _variance(self, light: Floats) -> Floats:
        """Return the variances of readings for light with its slope (2, ..., s, m)."""
        (gain, gain_turn), (_, turn) = self.covariances.transpose(1, 2, 0)[:, :, :, None]
        bright, slope = light
        relative = MODEL_DEVIATION * MODEL_DEVIATION + gain
        variance = bright * (bright * relative + 2 * gain_turn * slope) + turn * slope * slope
        return self._noise**2 + STRAY_DEVIATION**2 + np.maximum(variance, 0)

    def _likelihoods(
        self, readings: NDArray[np.int64], light: Floats, extra_variance: Floats | float
    ) -> tuple[Floats, Floats, Booleans]:
        """Return likelihoods of readings, those of inliers (n, s, m), and whether they are clipped (s,)."""
        bright = light[0]
        variance = self._variance(light) + extra_variance
        clip_limit = self._floor + _CLIP_DEVIATIONS * self._noise
        is_clipped = readings <= clip_limit
        innovation = (np.maximum(readings, clip_limit)[:, None] - self._dark + bright) / np.sqrt(variance)
        inlier = np.exp(-0.5 * innovation * innovation) / np.sqrt(math.tau * variance)
        inlier[:, is_clipped] = 1 / (1 + np.exp(-np.clip(1.702 * innovation[:, is_clipped], -500, 500)))
        outlier = np.where(is_clipped, _FLOOR_OUTLIERS, 1 / (self._dark - self._floor))[:, None]
        return (1 - OUTLIERS) * inlier + OUTLIERS * outlier, inlier, is_clipped
