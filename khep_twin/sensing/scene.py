"""Queries of the stepping core to a scene: motion, joints, and rays of the robots' sensors.

In plain code a query calls the scene's method of that name. In compiled code numba replaces it with a
function for each kind of scene: `khep_twin.simulation.mujoco_calls` for MuJoCo, and
`khep_twin.episodes.planar.compiled` for the plane. Core and sensors are the same for all kinds.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self, cast

import numpy as np

from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.seen_surfaces import Chip

COARSE, FINE = 0, 1
"""Density of the points on a bulb: 9 points decide whether it is partly hidden, 64 give the visible part."""

MAX_SPEED = 1000.0
"""Highest speed of a joint in a playpen [m/s or rad/s]; beyond it the simulation has diverged."""

Triple = tuple[float, float, float]


class Beams(NamedTuple):
    """Rays from a point, buffers of `cast_rays`.

    Attributes:
        vectors: Unit vectors of the rays (3 * n,).
        lengths: Their lengths [m], below 0 without an obstacle (n,).
        normals: Normals of the obstacles (3 * n,).
        geoms: Indices of the obstacles (n,).
    """

    vectors: Vector[float]
    lengths: Vector[float]
    normals: Vector[float]
    geoms: Vector[int]

    @classmethod
    def of(cls, n_rays: int) -> Self:
        """Return buffers for a number of rays."""
        arrays = (np.zeros(n) for n in (3 * n_rays, n_rays, 3 * n_rays))
        vectors, lengths, normals = (cast("Vector[float]", array) for array in arrays)
        return cls(vectors, lengths, normals, np.zeros(n_rays, np.int64))


class SceneMotion(Protocol):
    """Motion of a scene."""

    def step(self) -> None:
        """Implement the query `step`."""

    def in_bounds(self, limit: float) -> bool:
        """Implement the query `in_bounds`."""
        ...

    def has_warned(self) -> bool:
        """Implement the query `has_warned`."""
        ...

    def pose(self, index: int) -> tuple[float, float, float, float]:
        """Implement the query `pose`."""
        ...


class SceneJoints(Protocol):
    """Joints and motors of a scene, by their indices."""

    def joint_position(self, index: int) -> float:
        """Implement the query `joint_position`."""
        ...

    def joint_speed(self, index: int) -> float:
        """Implement the query `joint_speed`."""
        ...

    def motor_torque(self, index: int) -> float:
        """Implement the query `motor_torque`."""
        ...

    def set_motor(self, index: int, voltage: float) -> None:
        """Implement the query `set_motor`."""


class SceneSight(Protocol):
    """Poses of the sensors in a scene."""

    def body_frame(self, sensors: RobotSensors) -> Sequence[float]:
        """Implement the query `body_frame`."""
        ...

    def position(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Implement the query `position`."""
        ...

    def chip(self, sensors: RobotSensors, channel: int) -> Chip:
        """Implement the query `chip`."""
        ...


class SceneRays(Protocol):
    """Surfaces and rays of the sensors in a scene."""

    def surfaces(self, sensors: RobotSensors, channel: int, chip: Chip, min_light: float) -> int:
        """Implement the query `surfaces`."""
        ...

    def is_blocked(self, sensors: RobotSensors, channel: int, ray: Triple, glass: float) -> bool:
        """Implement the query `is_blocked`."""
        ...

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
        ...


class Scene(SceneMotion, SceneJoints, SceneSight, SceneRays, Protocol):
    """A scene with its robots."""


class BeamScene(Scene, Protocol):
    """A scene for robots that record moments, and whose rays meet the floor or form beams."""

    def update_frames(self) -> None:
        """Implement the query `update_frames`."""

    def save_moment(self, moment: int, powers: Sequence[float]) -> None:
        """Implement the query `save_moment`."""

    def copy_moment(self, source: int, destination: int) -> None:
        """Implement the query `copy_moment`."""

    def sensor_frame(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Implement the query `sensor_frame`."""
        ...

    def ray(self, sensors: RobotSensors, start: Triple, direction: Triple) -> tuple[float, float]:
        """Implement the query `ray`."""
        ...

    def cast_rays(self, sensors: RobotSensors, beams: Beams, start: Triple, reach: float) -> None:
        """Implement the query `cast_rays`."""


def step(scene: Scene) -> None:
    """Advance the physics by one step."""
    scene.step()


def in_bounds(scene: Scene, limit: float) -> bool:
    """Return whether all positions are finite and within `limit` [m], and the speeds within `MAX_SPEED`."""
    return scene.in_bounds(limit)


def has_warned(scene: Scene) -> bool:
    """Return whether the physics engine has issued a warning."""
    return scene.has_warned()


def pose(scene: Scene, index: int) -> tuple[float, float, float, float]:
    """Return x, y [m], and cosine and sine of the heading of an upright robot, by the index of its pose."""
    return scene.pose(index)


def joint_position(scene: Scene, index: int) -> float:
    """Return the position of a joint [m or rad]."""
    return scene.joint_position(index)


def joint_speed(scene: Scene, index: int) -> float:
    """Return the speed of a joint [m/s or rad/s]."""
    return scene.joint_speed(index)


def motor_torque(scene: Scene, index: int) -> float:
    """Return the torque of a motor in the last step [N m]."""
    return scene.motor_torque(index)


def set_motor(scene: Scene, index: int, voltage: float) -> None:
    """Set the voltage of a motor [V]."""
    scene.set_motor(index, voltage)


def body_frame(scene: Scene, sensors: RobotSensors) -> Sequence[float]:
    """Return the rotation matrix of a robot, row by row (9,)."""
    return scene.body_frame(sensors)


def position(scene: Scene, sensors: RobotSensors, channel: int) -> Sequence[float]:
    """Return the position of a sensor (3,) [m]."""
    return scene.position(sensors, channel)


def chip(scene: Scene, sensors: RobotSensors, channel: int) -> Chip:
    """Return the pose of a sensor's chip, which `surfaces` requires."""
    return scene.chip(sensors, channel)


def surfaces(scene: Scene, sensors: RobotSensors, channel: int, chip: Chip, min_light: float) -> int:
    """Write the surfaces in range of a sensor to `proximity.surfaces`; return their number.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        chip: Chip of the sensor.
        min_light: Smallest light that matters [counts]; the result may be 0 if by `proximity.bound` all
            surfaces are too far away to reflect as much.
    """
    return scene.surfaces(sensors, channel, chip, min_light)


def is_blocked(scene: Scene, sensors: RobotSensors, channel: int, ray: Triple, glass: float) -> bool:
    """Return whether an obstacle blocks a ray from a sensor [m] before the fraction `glass` of its length."""
    return scene.is_blocked(sensors, channel, ray, glass)


def hidden_part(
    scene: Scene,
    sensors: RobotSensors,
    channel: int,
    disc: int,
    left: Triple,
    up: Triple,
    ray: Triple,
    glass: float,
) -> float:
    """Return the part of the rays from a sensor to points of a bulb that is blocked before its glass.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        disc: COARSE or FINE points.
        left: Vector from the bulb's centre to its left edge, as seen from the sensor [m].
        up: Vector from the bulb's centre to its upper edge [m].
        ray: Vector from the sensor to the bulb's centre [m].
        glass: Distance of the bulb's surface, in lengths of `ray`.
    """
    return scene.hidden_part(sensors, channel, disc, left, up, ray, glass)


def update_frames(scene: BeamScene) -> None:
    """Move all bodies and sensors to the present positions of the joints, which the next step does, too."""
    scene.update_frames()


def save_moment(scene: BeamScene, moment: int, powers: Sequence[float]) -> None:
    """Record the positions of all joints and the powers of the lamps [W] as a moment, by its number."""
    scene.save_moment(moment, powers)


def copy_moment(scene: BeamScene, source: int, destination: int) -> None:
    """Copy a recorded moment."""
    scene.copy_moment(source, destination)


def sensor_frame(scene: BeamScene, sensors: RobotSensors, channel: int) -> Sequence[float]:
    """Return the rotation matrix of a sensor, row by row (9,); it looks along its -z axis."""
    return scene.sensor_frame(sensors, channel)


def ray(scene: BeamScene, sensors: RobotSensors, start: Triple, direction: Triple) -> tuple[float, float]:
    """Return length [m] and reflectance of a ray's end, floor and paint included; a length of -1 for none."""
    return scene.ray(sensors, start, direction)


def cast_rays(scene: BeamScene, sensors: RobotSensors, beams: Beams, start: Triple, reach: float) -> None:
    """Cast rays from a point, up to a length [m]; the floor is no obstacle.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot, which the rays ignore.
        beams: Vectors of the rays; the other buffers are filled in.
        start: Point.
        reach: Longest length [m].
    """
    scene.cast_rays(sensors, beams, start, reach)
