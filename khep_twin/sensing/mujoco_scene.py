"""MuJoCo's scene for plain code: calls of MuJoCo's Python module, and positions read as lists.

`khep_twin.simulation.mujoco_calls` has the same functions for compiled code.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import view
from khep_twin.sensing.optics import RobotSensors
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import FASTEST, FEW, LENGTH_AND_NORMAL, MANY, Triple

Floats = NDArray[np.float64]


class Disc(NamedTuple):
    """Points of a disc of radius 1, and buffers for rays to them.

    Attributes:
        across: Coordinate of each point to the left (n, 1).
        up: Coordinate of each point upwards (n, 1).
        geoms: Geoms that the rays have hit (n,).
        hits: Lengths of the rays (n,).
    """

    across: Floats
    up: Floats
    geoms: NDArray[np.int32]
    hits: Floats


class MujocoScene:
    """A compiled scene, a `scene.Scene`.

    Args:
        model: Model of the scene.
        data: State of the scene.
        robots: Indices of its robots.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, robots: Sequence[RobotIndices]) -> None:
        self._model, self._data = model, data
        self._warnings: NDArray[np.int32] = data.warning.number
        self._places: Floats = data.xpos.ravel()
        self._qpos, self._qvel = data.qpos, data.qvel
        self._joints, self._speeds = view(data.qpos), view(data.qvel)
        self._ctrl, self._force = view(data.ctrl), view(data.actuator_force)
        self._body_frames: list[Floats] = list(data.xmat)
        self.positions: list[Floats] = list(data.cam_xpos)
        self._frames: list[Floats] = list(data.cam_xmat)
        self._rays: dict[int, Floats] = {
            camera: data.sensordata[part]
            for robot in robots
            for camera, part in zip(robot.cameras, robot.rays, strict=True)
        }
        n_rays = max((len(rays) // LENGTH_AND_NORMAL for rays in self._rays.values()), default=0)
        self._reflectances: Floats = model.geom_user[:, 0]
        self._geoms, self._lengths = np.zeros(n_rays, np.int32), np.zeros(n_rays)
        self._discs = [_disc(points_of_a_bulb(number)) for number in (FEW, MANY)]

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

    def sensor_frame(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Answer the query `sensor_frame`."""
        return self._frames[sensors.cameras[channel]].tolist()

    def direction(self, frame: Sequence[float], channel: int, ray: int, tangential: float) -> Triple:
        """Answer the query `direction`."""
        return through(frame, tangential)

    def rays(self, sensors: RobotSensors, channel: int, level: float) -> int:
        """Answer the query `rays`."""
        # The rangefinders have cast them already; compiled code casts them where something may be near.
        found = sensors.proximity.found
        found[:] = self._rays[sensors.cameras[channel]].tolist()
        return len(found)

    def surfaces(self, sensors: RobotSensors, channel: int, cutoff: float) -> None:
        """Answer the query `surfaces`."""
        # The rays are cast again, as rangefinders do not report what they hit.
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self.positions[sensors.cameras[channel]],
            np.array(sensors.proximity.directions),
            None,
            True,
            sensors.base,
            self._geoms,
            self._lengths,
            None,
            len(self._geoms),
            cutoff,
        )
        sensors.proximity.reflectances[:] = self._reflectances[self._geoms].tolist()

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
        cutoff: float,
        glass: float,
    ) -> float:
        """Answer the query `blocked`."""
        points = self._discs[disc]
        # Element by element, so that the result is the same to the last bit on any machine.
        frame = np.array((left, up, way))
        ways = points.across * frame[0] + points.up * frame[1] + frame[2]
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self.positions[sensors.cameras[channel]],
            ways.ravel(),
            None,
            True,
            sensors.base,
            points.geoms,
            points.hits,
            None,
            len(points.hits),
            cutoff,
        )
        stopped = 0
        for hit in points.hits.tolist():
            stopped += 0 <= hit < glass
        return stopped / len(points.hits)


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


@compilable
def through(frame: Sequence[float], tangential: float) -> Triple:
    """Return the unit vector of a ray at a tangent off the axis of a frame."""
    x, y = frame[0] * tangential - frame[2], frame[3] * tangential - frame[5]
    z = frame[6] * tangential - frame[8]
    scale = 1 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


def _disc(points: Floats) -> Disc:
    count = len(points)
    return Disc(points[:, :1].copy(), points[:, 1:].copy(), np.zeros(count, np.int32), np.zeros(count))
