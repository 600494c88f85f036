"""Noise of the particles' motion, which takes nothing off what it pushes."""

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.planar import plane as flat
from khep_twin.shadow.planes import Planes

Floats = NDArray[np.float64]

PLACE_NOISE, TURN_NOISE = 1e-3, 0.015
"""Noise of the motion in a second's square root, besides wheels [m, rad] (assumed)."""

SLIP_NOISE = 2.0, 2.0, 6.0
"""Factors of that noise along x, y and in turning where a tyre slips or something is touched (assumed: a
robot in MuJoCo and one in the plane are 5 to 25 mm and 15 degrees apart after 3 to 10 s of pushing)."""

STANDING = 0.05
"""Speed of both wheels below which a robot stands, and does not slip [rad/s] (assumed)."""


def moves(planes: Planes, passed_s: float, jolts: Floats, rough: Floats, rng: np.random.Generator) -> Floats:
    """Draw moves of twins x, y [m] and in turning [rad] (n, 3).

    Args:
        planes: Twins.
        passed_s: Time since the last moves [s].
        jolts: Variances by changes of speed at times that are not certain (3,) [m^2, rad^2].
        rough: Deviations that come to those of the noise (3,) [m, rad].
        rng: Random stream.
    """
    turning = np.abs(planes.robots["speeds"][:, flat.LEFT_ANGLE :]).max(axis=1) > STANDING
    slips = turning & (planes.robots["last"][:, flat.SLIPS] != 0)
    noise = np.sqrt(np.square((PLACE_NOISE, PLACE_NOISE, TURN_NOISE)) * passed_s + jolts)
    moved: Floats = rng.standard_normal((len(planes), 3))
    moved *= noise * np.where(slips[:, None], SLIP_NOISE, 1.0) + rough
    # What pushes stays in touch: off a thing, it would neither be turned by it nor held.
    push = planes.pushes
    moved[:, :2] -= (moved[:, :2] * push).sum(axis=1, keepdims=True) * push
    return moved
