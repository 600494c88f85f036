"""MuJoCo's scene for plain code: calls of MuJoCo's Python module, and positions read as lists.

`khep_twin.simulation.mujoco_calls` has the same functions for compiled code.
"""

import math
from collections.abc import Sequence
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import view
from khep_twin.sensing.robot_sensors import RobotSensors, chip_behind
from khep_twin.sensing.scene import FASTEST, FEW, MANY, Triple
from khep_twin.sensing.seen_surfaces import Chip, Upright, add_upright

Floats = NDArray[np.float64]

PAINT = 0.0005
"""Height up to which a fixed thing is paint on the floor, which the sensors do not see [m]."""

GROUND_GROUP = 1
"""Group of geoms to drive on, which the sensors do not see either."""

_ROUNDING = 1e-9
"""Margin for rounding [m]."""

_AROUND = 0.1
"""Way of a robot's sensors after which the fixed geoms around them are looked up again [m]."""

_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)
_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class MujocoScene:
    """A compiled scene, a `scene.Scene`.

    Args:
        model: Model of the scene.
        data: State of the scene.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._warnings: NDArray[np.int32] = data.warning.number
        self._places: Floats = data.xpos.ravel()
        self._qpos, self._qvel = data.qpos, data.qvel
        self._joints, self._speeds = view(data.qpos), view(data.qvel)
        self._ctrl, self._force = view(data.ctrl), view(data.actuator_force)
        self._body_frames: list[Floats] = list(data.xmat)
        self.positions: list[Floats] = list(data.cam_xpos)
        self._frames: list[Floats] = list(data.cam_xmat)
        seen = visible(model)
        self._shapes = [fixed(model, geom) for geom in seen]
        self._bodies: NDArray[np.int32] = model.geom_bodyid[seen]
        self._bounds: Floats = model.geom_rbound[seen]
        circles: Floats = np.column_stack([model.geom_pos[seen, :2], self._bounds])
        self._circles: list[tuple[float, float, float]] = circles.tolist()
        # By the body of the robot: where the fixed geoms around it were looked up, those, and all that move.
        self._around: dict[int, tuple[float, float, list[int], NDArray[np.int64]]] = {}
        self._reflectances: list[float] = model.geom_user[seen, 0].tolist()
        self._geoms = np.array(seen, np.int64)
        self._discs = [points_of_a_bulb(number) for number in (FEW, MANY)]

    def step(self) -> None:
        """Answer the query `step`."""
        mujoco.mj_step(self._model, self._data)

    def in_bounds(self, limit: float) -> bool:
        """Answer the query `in_bounds`."""
        # Sums of squares are the fastest check that also finds NaN.
        places, speeds, joints = self._places, self._qvel, self._qpos
        if not places.dot(places) <= len(places) * limit**2:
            return False
        return bool(speeds.dot(speeds) <= len(speeds) * FASTEST**2 and joints.dot(joints) < math.inf)

    def warned(self) -> bool:
        """Answer the query `warned`."""
        return bool(self._warnings.any())

    def pose(self, index: int) -> tuple[float, float, float, float]:
        """Answer the query `pose`."""
        px, py, _, w, x, y, z = self._joints[index : index + 7]
        return px, py, 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)

    def joint_position(self, index: int) -> float:
        """Answer the query `joint_position`."""
        return self._joints[index]

    def joint_speed(self, index: int) -> float:
        """Answer the query `joint_speed`."""
        return self._speeds[index]

    def motor_torque(self, index: int) -> float:
        """Answer the query `motor_torque`."""
        return self._force[index]

    def set_motor(self, index: int, voltage: float) -> None:
        """Answer the query `set_motor`."""
        self._ctrl[index] = voltage

    def body_frame(self, sensors: RobotSensors) -> Sequence[float]:
        """Answer the query `body_frame`."""
        return self._body_frames[sensors.base].tolist()

    def position(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Answer the query `position`."""
        return self.positions[sensors.cameras[channel]].tolist()

    def chip(self, sensors: RobotSensors, channel: int) -> Chip:
        """Answer the query `chip`."""
        camera = sensors.cameras[channel]
        place, frame = self.positions[camera].tolist(), self._frames[camera].tolist()
        return chip_behind(place, frame, sensors.proximity, channel)

    def surfaces(self, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
        """Answer the query `surfaces`."""
        found, count, model, data = sensors.proximity.found, 0, self._model, self._data
        still, others = self._geoms_around(sensors, chip)
        away: list[tuple[int, float]] = []
        for index in still:
            x, y, bound = self._circles[index]
            dx, dy = x - chip.x, y - chip.y
            away.append((index, math.sqrt(dx * dx + dy * dy) - bound))
        if len(others):
            ways: Floats = data.geom_xpos[self._geoms[others], :2] - (chip.x, chip.y)
            distances: Floats = np.sqrt((ways * ways).sum(axis=1)) - self._bounds[others]
            away = sorted([*away, *zip(others.tolist(), distances.tolist(), strict=True)])
        near = math.sqrt(sensors.proximity.bound[channel] / needed) if needed else math.inf
        if not any(distance <= near + _ROUNDING for _, distance in away):
            return 0
        for index, distance in away:
            if distance > chip.reach + _ROUNDING:
                continue
            shape = self._shapes[index]
            if shape is None:
                geom = int(self._geoms[index])
                place, matrix = data.geom_xpos[geom].tolist(), data.geom_xmat[geom].tolist()
                shape = upright(int(model.geom_type[geom]), model.geom_size[geom].tolist(), place, matrix)
            count = add_upright(found, count, chip, shape, self._reflectances[index])
        return count

    def _geoms_around(self, sensors: RobotSensors, chip: Chip) -> tuple[list[int], NDArray[np.int64]]:
        """Return the fixed geoms that a chip may see, and those of other bodies that move."""
        x, y, still, others = self._around.get(sensors.base, (math.inf, 0.0, [], np.empty(0, np.int64)))
        if not math.hypot(x - chip.x, y - chip.y) <= _AROUND:
            x, y = chip.x, chip.y
            far = max(sensors.proximity.reach) + 2 * _AROUND
            near = [math.hypot(each - x, other - y) - bound <= far for each, other, bound in self._circles]
            still = np.flatnonzero(np.array(near, np.bool_) & (self._bodies == 0)).tolist()
            others = np.flatnonzero((self._bodies != 0) & (self._bodies != sensors.base))
            self._around[sensors.base] = x, y, still, others
        return still, others

    def stopped(self, sensors: RobotSensors, channel: int, way: Triple, glass: float) -> bool:
        """Answer the query `stopped`."""
        place = self.positions[sensors.cameras[channel]]
        hit = mujoco.mj_ray(self._model, self._data, place, np.array(way), None, True, sensors.base, None)
        return 0 <= hit < glass

    def blocked(
        self,
        sensors: RobotSensors,
        channel: int,
        disc: int,
        left: Triple,
        up: Triple,
        way: Triple,
        glass: float,
    ) -> float:
        """Answer the query `blocked`."""
        points, base, place = self._discs[disc], sensors.base, self.positions[sensors.cameras[channel]]
        # Element by element, so that the result is the same to the last bit on any machine.
        frame, stopped = np.array((left, up, way)), 0
        for ray in points[:, :1] * frame[0] + points[:, 1:] * frame[1] + frame[2]:
            # One by one: `mj_multiRay`, which is no faster, misses some corners that are near.
            hit = mujoco.mj_ray(self._model, self._data, place, ray, None, True, base, None)
            stopped += 0 <= hit < glass
        return stopped / len(points)


@cache
def points_of_a_bulb(number: int) -> Floats:
    """Return points of a disc of radius 1 (n, 2): FEW decide between all and nothing, MANY give the part."""
    if number == FEW:  # its centre, and points near its edge
        turns = np.arange(8) * math.pi / 4
        return np.concatenate([[[0.0, 0.0]], 0.97 * np.column_stack([np.cos(turns), np.sin(turns)])])
    # A sunflower pattern, evenly spread and symmetric.
    seeds = np.arange(32)
    turns, radii = seeds * math.pi * (3 - math.sqrt(5)), np.sqrt((seeds + 0.5) / len(seeds))
    half = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)])
    return np.concatenate([half, half * (-1, 1)])


def visible(model: mujoco.MjModel) -> list[int]:
    """Return the geoms that sensors see: all that are drawn, but floor and paint."""
    paint = (model.geom_bodyid == 0) & (model.geom_pos[:, 2] < PAINT)
    paint |= model.geom_group == GROUND_GROUP
    seen = (model.geom_rgba[:, 3] > 0) & (model.geom_type != _PLANE) & ~paint
    return np.flatnonzero(seen).tolist()


def fixed(model: mujoco.MjModel, geom: int) -> Upright | None:
    """Return the shape of a geom that cannot move; None for one that can."""
    if model.geom_bodyid[geom] != 0:
        return None
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    place, size = model.geom_pos[geom].tolist(), model.geom_size[geom].tolist()
    return upright(int(model.geom_type[geom]), size, place, turn.tolist())


@compilable
def upright(kind: int, size: Sequence[float], place: Sequence[float], turn: Sequence[float]) -> Upright:
    """Return a geom as the upright box or cylinder that it is, or that it resembles when it has tipped over.

    Args:
        kind: Type of the geom.
        size: Its size (3,).
        place: Its position (3,) [m].
        turn: Its orientation (9,).
    """
    long, wide, high = size[0], size[1], size[2]
    if kind == _SPHERE:
        wide = high = long
    elif kind not in (_BOX, _ELLIPSOID):  # they have a radius, and half a length along their third axis
        high, wide = (wide + long if kind == _CAPSULE else wide), long
    up = 2
    if abs(turn[6]) > abs(turn[8]) or abs(turn[7]) > abs(turn[8]):
        up = 0 if abs(turn[6]) > abs(turn[7]) else 1
    if up == 2:
        along, half, width, height = 0, long, wide, high
        if kind != _BOX:
            width = -1.0
    elif up == 0:
        along, half, width, height = 1, wide, high, long
    else:
        along, half, width, height = 2, high, long, wide
    c, s = turn[along], turn[3 + along]
    scale = 1 / math.sqrt(max(c * c + s * s, 1e-12))
    return (place[0], place[1]), (c * scale, s * scale), (half, width), (place[2] - height, place[2] + height)
