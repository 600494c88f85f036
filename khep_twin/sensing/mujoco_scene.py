"""Queries of `sensing.scene` to MuJoCo's scene in plain code, by MuJoCo's Python module.

`khep_twin.simulation.mujoco_calls` implements them for compiled code.
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
from khep_twin.sensing.scene import COARSE, FINE, MAX_SPEED, Beams, Triple
from khep_twin.sensing.seen_surfaces import Chip, Upright, add_upright

Floats = NDArray[np.float64]

PAINT_HEIGHT = 0.0005
"""Height up to which a fixed geom is paint on the floor, invisible to the sensors [m]."""

FRAME_UPDATES = mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight
"""Functions that move bodies, geoms and cameras to the positions of the joints."""

GROUND_GROUP = 1
"""Group of geoms to drive on, also invisible to the sensors."""

_MARGIN = 1e-9
"""Margin for rounding [m]."""

_LOOKUP_DISTANCE = 0.1
"""Distance by which a robot's sensor moves before the fixed geoms around it are searched again [m]."""

_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)
_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class MujocoScene:
    """A compiled scene with its state, which implements `scene.BeamScene`.

    Args:
        model: Compiled scene.
        data: State of the scene.
        moments: Recorded moments: positions of joints, then powers of lamps (n, n_qpos + n_powers).
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, moments: Floats | None = None) -> None:
        self._moments = np.zeros((0, 0)) if moments is None else moments
        self._is_floor = is_floor(model)
        self._model, self._data = model, data
        self._warnings: NDArray[np.int32] = data.warning.number
        self._body_positions: Floats = data.xpos.ravel()
        self._qpos, self._qvel = data.qpos, data.qvel
        self._joints, self._speeds = view(data.qpos), view(data.qvel)
        self._ctrl, self._force = view(data.ctrl), view(data.actuator_force)
        self._body_frames: list[Floats] = list(data.xmat)
        self.positions: list[Floats] = list(data.cam_xpos)
        self._frames: list[Floats] = list(data.cam_xmat)
        geoms = visible_geoms(model)
        self._shapes = [fixed_shape(model, geom) for geom in geoms]
        self._bodies: NDArray[np.int32] = model.geom_bodyid[geoms]
        self._bounds: Floats = model.geom_rbound[geoms]
        circles: Floats = np.column_stack([model.geom_pos[geoms, :2], self._bounds])
        self._bounding_circles: list[tuple[float, float, float]] = circles.tolist()
        # By the robot's body: position of the last search, fixed geoms around it, and all moving geoms.
        self._nearby_geoms: dict[int, tuple[float, float, list[int], NDArray[np.int64]]] = {}
        self._reflectances: list[float] = model.geom_user[geoms, 0].tolist()
        self._geoms = np.array(geoms, np.int64)
        self._geom = np.zeros(1, np.int32)
        self._bulb_points = [bulb_points(disc) for disc in (COARSE, FINE)]

    def step(self) -> None:
        """Implement the query `step`."""
        mujoco.mj_step(self._model, self._data)

    def in_bounds(self, limit: float) -> bool:
        """Implement the query `in_bounds`."""
        # Sums of squares are the fastest check that also finds NaN.
        positions, speeds, joints = self._body_positions, self._qvel, self._qpos
        if not positions.dot(positions) <= len(positions) * limit**2:
            return False
        return bool(speeds.dot(speeds) <= len(speeds) * MAX_SPEED**2 and joints.dot(joints) < math.inf)

    def has_warned(self) -> bool:
        """Implement the query `has_warned`."""
        return bool(self._warnings.any())

    def pose(self, index: int) -> tuple[float, float, float, float]:
        """Implement the query `pose`."""
        px, py, _, w, x, y, z = self._joints[index : index + 7]
        return px, py, 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)

    def joint_position(self, index: int) -> float:
        """Implement the query `joint_position`."""
        return self._joints[index]

    def joint_speed(self, index: int) -> float:
        """Implement the query `joint_speed`."""
        return self._speeds[index]

    def motor_torque(self, index: int) -> float:
        """Implement the query `motor_torque`."""
        return self._force[index]

    def set_motor(self, index: int, voltage: float) -> None:
        """Implement the query `set_motor`."""
        self._ctrl[index] = voltage

    def body_frame(self, sensors: RobotSensors) -> Sequence[float]:
        """Implement the query `body_frame`."""
        return self._body_frames[sensors.base].tolist()

    def position(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Implement the query `position`."""
        return self.positions[sensors.cameras[channel]].tolist()

    def chip(self, sensors: RobotSensors, channel: int) -> Chip:
        """Implement the query `chip`."""
        camera = sensors.cameras[channel]
        position, frame = self.positions[camera].tolist(), self._frames[camera].tolist()
        return chip_behind(position, frame, sensors.proximity, channel)

    def surfaces(self, sensors: RobotSensors, channel: int, chip: Chip, min_light: float) -> int:
        """Implement the query `surfaces`."""
        buffer, count, model, data = sensors.proximity.surfaces, 0, self._model, self._data
        fixed_geoms, moving_geoms = self._find_geoms(sensors, chip)
        distances: list[tuple[int, float]] = []
        for index in fixed_geoms:
            x, y, bound = self._bounding_circles[index]
            dx, dy = x - chip.x, y - chip.y
            distances.append((index, math.sqrt(dx * dx + dy * dy) - bound))
        if len(moving_geoms):
            offsets: Floats = data.geom_xpos[self._geoms[moving_geoms], :2] - (chip.x, chip.y)
            moving_distances: Floats = np.sqrt((offsets * offsets).sum(axis=1)) - self._bounds[moving_geoms]
            distances += zip(moving_geoms.tolist(), moving_distances.tolist(), strict=True)
            distances.sort()
        max_distance = math.sqrt(sensors.proximity.bound[channel] / min_light) if min_light else math.inf
        if not any(distance <= max_distance + _MARGIN for _, distance in distances):
            return 0
        for index, distance in distances:
            if distance > chip.reach + _MARGIN:
                continue
            shape = self._shapes[index]
            if shape is None:
                geom = int(self._geoms[index])
                position, matrix = data.geom_xpos[geom].tolist(), data.geom_xmat[geom].tolist()
                size = model.geom_size[geom].tolist()
                shape = upright_shape(int(model.geom_type[geom]), size, position, matrix)
            count = add_upright(buffer, count, chip, shape, self._reflectances[index])
        return count

    def _find_geoms(self, sensors: RobotSensors, chip: Chip) -> tuple[list[int], NDArray[np.int64]]:
        """Return the fixed geoms in range of a chip, and the moving geoms of other bodies."""
        no_lookup = math.inf, 0.0, list[int](), np.empty(0, np.int64)
        x, y, fixed_geoms, moving_geoms = self._nearby_geoms.get(sensors.base, no_lookup)
        if not math.hypot(x - chip.x, y - chip.y) <= _LOOKUP_DISTANCE:
            x, y = chip.x, chip.y
            max_distance = max(sensors.proximity.reach) + 2 * _LOOKUP_DISTANCE
            circles = self._bounding_circles
            is_near = [math.hypot(cx - x, cy - y) - bound <= max_distance for cx, cy, bound in circles]
            fixed_geoms = np.flatnonzero(np.array(is_near, np.bool_) & (self._bodies == 0)).tolist()
            moving_geoms = np.flatnonzero((self._bodies != 0) & (self._bodies != sensors.base))
            self._nearby_geoms[sensors.base] = x, y, fixed_geoms, moving_geoms
        return fixed_geoms, moving_geoms

    def is_blocked(self, sensors: RobotSensors, channel: int, ray: Triple, glass: float) -> bool:
        """Implement the query `is_blocked`."""
        origin = self.positions[sensors.cameras[channel]]
        hit = mujoco.mj_ray(self._model, self._data, origin, np.array(ray), None, True, sensors.base, None)
        return 0 <= hit < glass

    def hidden_part(
        self,
        sensors: RobotSensors,
        channel: int,
        disc: int,
        left: Triple,
        up: Triple,
        ray: Triple,
        glass: float,
    ) -> float:
        """Implement the query `hidden_part`."""
        points, base, origin = self._bulb_points[disc], sensors.base, self.positions[sensors.cameras[channel]]
        # Element by element, so that the result is the same to the last bit on any machine.
        frame, n_blocked = np.array((left, up, ray)), 0
        for point_ray in points[:, :1] * frame[0] + points[:, 1:] * frame[1] + frame[2]:
            # Not `mj_multiRay`, which is no faster and misses some near corners.
            hit = mujoco.mj_ray(self._model, self._data, origin, point_ray, None, True, base, None)
            n_blocked += 0 <= hit < glass
        return n_blocked / len(points)

    def update_frames(self) -> None:
        """Implement the query `update_frames`."""
        for update in FRAME_UPDATES:
            update(self._model, self._data)

    def save_moment(self, moment: int, powers: Sequence[float]) -> None:
        """Implement the query `save_moment`."""
        row, n_qpos = self._moments[moment], len(self._qpos)
        row[:n_qpos] = self._qpos
        row[n_qpos : n_qpos + len(powers)] = powers

    def copy_moment(self, source: int, destination: int) -> None:
        """Implement the query `copy_moment`."""
        self._moments[destination] = self._moments[source]

    def sensor_frame(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Implement the query `sensor_frame`."""
        return self._frames[sensors.cameras[channel]].tolist()

    def ray(self, sensors: RobotSensors, start: Triple, direction: Triple) -> tuple[float, float]:
        """Implement the query `ray`."""
        model, geom, vector = self._model, self._geom, np.array(direction)
        length = mujoco.mj_ray(model, self._data, np.array(start), vector, None, True, sensors.base, geom)
        return length, float(model.geom_user[geom[0], 0]) if length >= 0 else 0.0

    def cast_rays(self, sensors: RobotSensors, beams: Beams, start: Triple, reach: float) -> None:
        """Implement the query `cast_rays`."""
        lengths, normals, vectors = map(np.asarray, (beams.lengths, beams.normals, beams.vectors))
        geoms, origin, base = np.zeros(len(lengths), np.int32), np.array(start), sensors.base
        outputs = geoms, lengths, normals, len(lengths), reach
        mujoco.mj_multiRay(self._model, self._data, origin, vectors, None, True, base, *outputs)
        lengths[self._is_floor[geoms]] = -1


@cache
def bulb_points(disc: int) -> Floats:
    """Return the COARSE or FINE points of a disc of radius 1 (n, 2)."""
    if disc == COARSE:  # its centre, and points near its edge
        angles = np.arange(8) * math.pi / 4
        return np.concatenate([[[0.0, 0.0]], 0.97 * np.column_stack([np.cos(angles), np.sin(angles)])])
    # A symmetric sunflower pattern of uniform density.
    indices = np.arange(32)
    angles, radii = indices * math.pi * (3 - math.sqrt(5)), np.sqrt((indices + 0.5) / len(indices))
    half = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    return np.concatenate([half, half * (-1, 1)])


def is_floor(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which geoms are floor or paint on it."""
    return (model.geom_bodyid == 0) & (model.geom_pos[:, 2] < PAINT_HEIGHT)


def visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms that sensors see: all visible ones except floor and paint."""
    is_paint = is_floor(model)
    is_paint |= model.geom_group == GROUND_GROUP
    is_visible = (model.geom_rgba[:, 3] > 0) & (model.geom_type != _PLANE) & ~is_paint
    return np.flatnonzero(is_visible).tolist()


def fixed_shape(model: mujoco.MjModel, geom: int) -> Upright | None:
    """Return the shape of a fixed geom; None for one that can move."""
    if model.geom_bodyid[geom] != 0:
        return None
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    position, size = model.geom_pos[geom].tolist(), model.geom_size[geom].tolist()
    return upright_shape(int(model.geom_type[geom]), size, position, rotation.tolist())


@compilable
def upright_shape(
    geom_type: int, size: Sequence[float], position: Sequence[float], rotation: Sequence[float]
) -> Upright:
    """Return a geom as an upright box or cylinder; one that has tipped over as the most similar one.

    Args:
        geom_type: Type of the geom.
        size: Its size (3,).
        position: Its position (3,) [m].
        rotation: Its rotation matrix (9,).
    """
    size_x, size_y, size_z = size[0], size[1], size[2]
    if geom_type == _SPHERE:
        size_y = size_z = size_x
    elif geom_type not in (_BOX, _ELLIPSOID):  # they have a radius, and half a length along their third axis
        size_z, size_y = (size_y + size_x if geom_type == _CAPSULE else size_y), size_x
    up_axis = 2
    if abs(rotation[6]) > abs(rotation[8]) or abs(rotation[7]) > abs(rotation[8]):
        up_axis = 0 if abs(rotation[6]) > abs(rotation[7]) else 1
    if up_axis == 2:
        axis, half, width, height = 0, size_x, size_y, size_z
        if geom_type != _BOX:
            width = -1.0
    elif up_axis == 0:
        axis, half, width, height = 1, size_y, size_z, size_x
    else:
        axis, half, width, height = 2, size_z, size_x, size_y
    c, s = rotation[axis], rotation[3 + axis]
    scale = 1 / math.sqrt(max(c * c + s * s, 1e-12))
    x, y, z = position[0], position[1], position[2]
    return (x, y), (c * scale, s * scale), (half, width), (z - height, z + height)
