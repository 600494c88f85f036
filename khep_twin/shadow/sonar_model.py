"""The likelihood of ultrasonic readings, which are distances, or the codes of a near obstacle or of no echo.

The likelihood of a reading z, where the twin expects a distance d, is

    (1 - e) N(z; d, s^2) + e u

with a uniform density u. For a code it is 1 - e + e / N where the twin expects the same one, otherwise e / N.
A small turn decides whether a wall is heard at all, so e is large; such errors persist (`persistence`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.robots.model import RobotModel
from khep_twin.shadow.planar_bodies import Floats

DEVIATION = 0.025
"""Standard deviation of a distance from the twin's [m] (manual: 20 mm; the rest is motion)."""

OUTLIERS = 0.1
"""Part of the readings that are outliers (assumed)."""

PERSISTENCE = 0.05
"""Travel over which errors of the model persist [m] (assumed)."""

_OUTLIER_DENSITY, _CODE_SHARE = 0.4, 1 / 3
"""Density of outliers in a range of 2.5 m [1/m], and share of each code (assumed)."""


def distances_of(model: RobotModel, readings: NDArray[np.int64]) -> Floats:
    """Return readings as distances (n,) [m]: 0 too near, infinity for no echo, NaN for a disabled sensor."""
    sonar = model.body.sonar
    distances: Floats = readings.astype(np.float64) * model.sonar_unit
    for code, distance in zip(() if sonar is None else sonar.codes, (0.0, math.inf, math.nan), strict=False):
        distances[readings == code] = distance
    return distances


def sonar_likelihoods(expected: Floats, distances: Floats) -> tuple[Floats, Floats]:
    """Return the likelihoods of distances (m,) where twins expect some (n, m), and their largest values (m,).

    Those of a disabled sensor are 1.
    """
    is_distance = np.isfinite(distances) & (distances > 0)
    peak = np.where(is_distance, (1 - OUTLIERS) / (DEVIATION * math.sqrt(math.tau)), 1 - OUTLIERS)
    outliers = OUTLIERS * np.where(is_distance, _OUTLIER_DENSITY, _CODE_SHARE)
    with np.errstate(invalid="ignore"):
        fits = np.exp(-0.5 * np.square((expected - distances) / DEVIATION)) * (expected > 0)
    fits = np.where(is_distance, fits, expected == distances)
    is_enabled = ~np.isnan(distances)
    return np.where(is_enabled, peak * fits + outliers, 1.0), np.where(is_enabled, peak + outliers, 1.0)
