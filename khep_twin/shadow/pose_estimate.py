"""Estimate of a pose from weighted poses."""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST_DEVIATION = 5e-4, 5e-4, 2e-3
"""Least standard deviations of a pose [m, rad] (assumed): twins that lean against a wall agree on their
distance from it, but no robot's body is known better."""


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
        off: Floats = poses - np.array([x, y, heading])
        off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
        covariance = (off * weights[:, None]).T @ off + np.diag(np.square(LEAST_DEVIATION))
        return cls(time_ns, (x, y, heading), covariance)
