"""Sight lines to lamps that nothing stands in: where no ray is needed to know a bulb to be in full sight.

Seen from a lamp, each fixed thing lies between two directions. A place in another direction, or nearer to the
lamp than the thing, sees all of the bulb past it; the bulb's radius is allowed for on both sides. Where
something may move into the way, such as another robot, nothing is known beforehand.
"""

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from khep_twin.units import BULB_RADIUS, SENSOR_HEIGHT

_AROUND = frozenset(("wall_left", "wall_right", "wall_bottom", "wall_top", "floor"))
"""Of a rectangular arena: nothing inside it is behind them."""

_OWN = ("base", "left_wheel", "right_wheel")


class SightLines:
    """Of one robot's receivers to the lamps of a scene; `optics.clear` goes by them.

    Args:
        model: the scene.
        prefix: of the robot's names in it.
        lamps: places of the bulbs' centres [m].

    Attributes:
        lamps: places of the bulbs' centres [m].
        known: whether all that stops light stands still, the robot itself left aside.
        hidden: what may hide each lamp: the middle and half of the angle that it takes [rad], and how near it
            is [m].
    """

    def __init__(self, model: mujoco.MjModel, prefix: str, lamps: list[tuple[float, float, float]]) -> None:
        self.lamps = lamps
        self.known = _nothing_else_moves(model, prefix)
        self.hidden = [list(_directions(model, lamp)) for lamp in lamps] if self.known else []


def _nothing_else_moves(model: mujoco.MjModel, prefix: str) -> bool:
    """Whether all that stops light stands still, the robot itself left aside."""
    own = {0, *(model.body(prefix + name).id for name in _OWN)}
    return not {int(body) for body in model.geom_bodyid} - own


def _directions(
    model: mujoco.MjModel, lamp: tuple[float, float, float]
) -> Iterator[tuple[float, float, float]]:
    """What may hide a lamp: the middle and half of the angle that it takes [rad], and how near it is [m]."""
    lowest = min(SENSOR_HEIGHT, lamp[2] - BULB_RADIUS)
    for geom in np.flatnonzero(model.geom_bodyid == 0).tolist():
        size, centre = model.geom_size[geom].tolist(), model.geom_pos[geom].tolist()
        box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        height = centre[2] + (size[2] if box else size[1])
        if model.geom(geom).name in _AROUND or height <= lowest:
            continue
        x, y = centre[0] - lamp[0], centre[1] - lamp[1]
        w, _, _, z = model.geom_quat[geom].tolist()
        angle = 2 * math.atan2(z, w)
        half_length, half_width = (size[0], size[1]) if box else (size[0], size[0])
        if not box:
            angle = math.atan2(y, x)  # the square around a circle, turned to the lamp
        along = x * math.cos(angle) + y * math.sin(angle)
        across = -x * math.sin(angle) + y * math.cos(angle)
        nearest = math.hypot(max(abs(along) - half_length, 0), max(abs(across) - half_width, 0))
        if nearest <= 2 * BULB_RADIUS:
            yield 0.0, math.inf, 0.0  # right at the bulb: it may hide it from anywhere
            continue
        middle = math.atan2(across, along)
        corners = [
            math.atan2(across + side * half_width, along + end * half_length) - middle
            for side in (-1, 1)
            for end in (-1, 1)
        ]
        half = max(abs((corner + math.pi) % _TURN - math.pi) for corner in corners)
        yield middle + angle, half + math.asin(BULB_RADIUS / nearest), nearest - BULB_RADIUS


_TURN = 2 * math.pi
