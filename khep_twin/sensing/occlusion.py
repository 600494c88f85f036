"""Free sight lines to lamps: positions from which a bulb is in full sight without casting a ray.

Seen from a lamp, each fixed object lies between two directions. A position in another direction, or nearer to
the lamp than the object, sees all of the bulb past it; the bulb's radius is allowed for on both sides. Where
other objects can move, such as another robot, no sight line is known in advance.
"""

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from khep_twin.sensing.mujoco_scene import GROUND_GROUP
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.units import BULB_RADIUS, SENSOR_HEIGHT

_WALLS = frozenset(("wall_left", "wall_right", "wall_bottom", "wall_top"))
"""Walls of a rectangular arena: nothing is behind them, but they hide a bulb within them."""


class SightLines:
    """Sight lines of one robot's receivers to the lamps of a scene, for `light.clear`.

    Args:
        model: Model of the scene.
        robot: Indices of the robot.
        lamps: Positions of the bulbs' centres [m].

    Attributes:
        lamps: Positions of the bulbs' centres [m].
        known: True if all that stops light stands still, apart from the robot itself.
        hidden: Objects that may hide each lamp: middle and half of their angle [rad], and distance [m].
    """

    def __init__(
        self, model: mujoco.MjModel, robot: RobotIndices, lamps: list[tuple[float, float, float]]
    ) -> None:
        self.lamps = lamps
        self.known = not {int(body) for body in model.geom_bodyid} - {0, robot.base, *robot.wheels}
        self.hidden = [list(_directions(model, lamp)) for lamp in lamps] if self.known else []


def _directions(
    model: mujoco.MjModel, lamp: tuple[float, float, float]
) -> Iterator[tuple[float, float, float]]:
    """Yield the objects that may hide a lamp: middle and half of their angle [rad], and distance [m]."""
    lowest = min(SENSOR_HEIGHT, lamp[2] - BULB_RADIUS)
    if lamp[2] < BULB_RADIUS:
        yield 0.0, math.inf, 0.0  # the floor hides a part of it from anywhere
        return
    for geom in np.flatnonzero(model.geom_bodyid == 0).tolist():
        size, centre = model.geom_size[geom].tolist(), model.geom_pos[geom].tolist()
        box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        height = centre[2] + (size[2] if box else size[1])
        name = model.geom(geom).name
        if name == "floor" or model.geom_group[geom] == GROUND_GROUP or height <= lowest:
            continue
        x, y = centre[0] - lamp[0], centre[1] - lamp[1]
        w, _, _, z = model.geom_quat[geom].tolist()
        angle = 2 * math.atan2(z, w)
        half_length, half_width = (size[0], size[1]) if box else (size[0], size[0])
        if not box:
            angle = math.atan2(y, x)  # the square around a circle, facing the lamp
        along = x * math.cos(angle) + y * math.sin(angle)
        across = -x * math.sin(angle) + y * math.cos(angle)
        nearest = math.hypot(max(abs(along) - half_length, 0), max(abs(across) - half_width, 0))
        if name in _WALLS and nearest >= BULB_RADIUS:
            continue
        if nearest <= 2 * BULB_RADIUS:
            yield 0.0, math.inf, 0.0  # right at the bulb: it may hide it from anywhere
            continue
        middle = math.atan2(across, along)
        corners = [
            math.atan2(across + side * half_width, along + end * half_length) - middle
            for side in (-1, 1)
            for end in (-1, 1)
        ]
        half = max(abs((corner + math.pi) % math.tau - math.pi) for corner in corners)
        yield middle + angle, half + math.asin(BULB_RADIUS / nearest), nearest - BULB_RADIUS
