"""Noise of the particles' motion, which does not break their contact with obstacles."""

import numpy as np

from khep_twin.episodes.planar import plane as planar
from khep_twin.shadow.planes import Floats, Twins

PLACE_NOISE, HEADING_NOISE = 1e-3, 0.015
"""Noise of the motion per square root of a second, besides that of wheels [m, rad] (assumed)."""

SLIP_FACTORS = 2.0, 2.0, 6.0
"""Factors of the noise along x, y and in turning where a tyre slips or something is touched (assumed: a
robot in MuJoCo and one in the plane are 5 to 25 mm and 15 degrees apart after 3 to 10 s of pushing)."""

STANDING_SPEED = 0.05
"""Speed of both wheels below which a robot stands, and does not slip [rad/s] (assumed)."""


def draw_moves(
    twins: Twins, passed_s: float, timing_variances: Floats, roughening: Floats, rng: np.random.Generator
) -> Floats:
    """Return random moves of twins along x, y [m] and in heading [rad] (n, 3).

    Args:
        twins: Twins.
        passed_s: Time since the last moves [s].
        timing_variances: Variances due to changes of speed at uncertain times (3,) [m^2, rad^2].
        roughening: Standard deviations that are added to those of the noise (3,) [m, rad].
        rng: Random stream.
    """
    is_driving = np.abs(twins.robots["speeds"][:, planar.LEFT_ANGLE :]).max(axis=1) > STANDING_SPEED
    is_slipping = is_driving & (twins.robots["last_step"][:, planar.SLIPS] != 0)
    noise = np.sqrt(np.square((PLACE_NOISE, PLACE_NOISE, HEADING_NOISE)) * passed_s + timing_variances)
    steps: Floats = rng.standard_normal((len(twins), 3))
    steps *= noise * np.where(is_slipping[:, None], SLIP_FACTORS, 1.0) + roughening
    # A robot that pushes an obstacle stays in contact: without it, the obstacle would not turn or hold it.
    directions = twins.push_directions
    steps[:, :2] -= (steps[:, :2] * directions).sum(axis=1, keepdims=True) * directions
    return steps
