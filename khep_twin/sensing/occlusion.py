"""Free lines of sight to lamps: positions from which a bulb is in full sight, found without casting rays.

Seen from a lamp, each fixed object covers a sector of directions. A position outside the sector, or nearer to
the lamp than the object, sees the whole bulb past it; the sector includes a margin for the bulb's radius. If
other objects can move, for example another robot, no line of sight is precomputed.
"""

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from khep_twin.sensing.mujoco_scene import GROUND_GROUP
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.units import BULB_RADIUS, SENSOR_HEIGHT

_WALLS = frozenset(("wall_left", "wall_right", "wall_bottom", "wall_top"))
"""Walls of a rectangular arena: nothing is behind them, but they hide a bulb inside them."""


class SightLines:
    """Sight lines of one robot's receivers to the lamps of a scene, for `light.is_clear`.

    Attributes:
        lamps: Positions of the bulbs' centres [m].
        is_static: True if nothing but the robot can move.
        obstacles: Objects that may hide each lamp: middle and half of their sector [rad], and distance [m].
    """

    def __init__(
        self, model: mujoco.MjModel, robot: RobotIndices, lamps: list[tuple[float, float, float]]
    ) -> None:
        self.lamps = lamps
        self.is_static = not {int(body) for body in model.geom_bodyid} - {0, robot.base, *robot.wheels}
        self.obstacles = [list(_find_obstacles(model, lamp)) for lamp in lamps] if self.is_static else []


def _find_obstacles(
    model: mujoco.MjModel, lamp: tuple[float, float, float]
) -> Iterator[tuple[float, float, float]]:
    """Yield the objects that may hide a lamp: middle and half of their sector [rad], and distance [m]."""
    lowest_ray = min(SENSOR_HEIGHT, lamp[2] - BULB_RADIUS)
    if lamp[2] < BULB_RADIUS:
        yield 0.0, math.inf, 0.0  # the floor hides a part of the bulb in all directions
        return
    for geom in np.flatnonzero(model.geom_bodyid == 0).tolist():
        size, centre = model.geom_size[geom].tolist(), model.geom_pos[geom].tolist()
        is_box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        height = centre[2] + (size[2] if is_box else size[1])
        name = model.geom(geom).name
        if name == "floor" or model.geom_group[geom] == GROUND_GROUP or height <= lowest_ray:
            continue
        x, y = centre[0] - lamp[0], centre[1] - lamp[1]
        w, _, _, z = model.geom_quat[geom].tolist()
        angle = 2 * math.atan2(z, w)
        half_length, half_width = (size[0], size[1]) if is_box else (size[0], size[0])
        if not is_box:
            angle = math.atan2(y, x)  # the square around a circle, facing the lamp
        along = x * math.cos(angle) + y * math.sin(angle)
        across = -x * math.sin(angle) + y * math.cos(angle)
        distance = math.hypot(max(abs(along) - half_length, 0), max(abs(across) - half_width, 0))
        if name in _WALLS and distance >= BULB_RADIUS:
            continue
        if distance <= 2 * BULB_RADIUS:
            yield 0.0, math.inf, 0.0  # it touches the bulb, and may hide it in all directions
            continue
        middle = math.atan2(across, along)
        corners = [
            math.atan2(across + side * half_width, along + end * half_length) - middle
            for side in (-1, 1)
            for end in (-1, 1)
        ]
        half_angle = max(abs((corner + math.pi) % math.tau - math.pi) for corner in corners)
        yield middle + angle, half_angle + math.asin(BULB_RADIUS / distance), distance - BULB_RADIUS
