"""Estimate of a pose from weighted poses."""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MIN_DEVIATIONS = 5e-4, 5e-4, 2e-3
"""Least standard deviations of a pose [m, rad] (assumed), those of a robot's body: twins that lean against a
wall agree exactly on their distance from it."""


class PoseEstimate(NamedTuple):
    """Estimate of a pose x, y [m] and heading [rad] at a time [ns]: mean and covariance (3, 3)."""

    time_ns: int
    pose: tuple[float, float, float]
    covariance: Floats

    @classmethod
    def of(cls, time_ns: int, poses: Floats, weights: Floats) -> Self:
        """Return the estimate from poses at a time [ns] (n, 3) with weights, whose sum is 1 (n,)."""
        x, y = float(weights @ poses[:, 0]), float(weights @ poses[:, 1])
        heading = math.atan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
        deviations: Floats = poses - np.array([x, y, heading])
        deviations[:, 2] = (deviations[:, 2] + math.pi) % math.tau - math.pi
        covariance = (deviations * weights[:, None]).T @ deviations + np.diag(np.square(MIN_DEVIATIONS))
        return cls(time_ns, (x, y, heading), covariance)
