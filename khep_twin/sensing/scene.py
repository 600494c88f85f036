"""Queries of the stepping core to a scene: motion, joints, and rays of the robots' sensors.

A query is a function that in plain code calls the scene's method of that name, as `Scene` and `BeamScene`
describe them. In compiled code numba replaces it with a function for each kind of scene:
`khep_twin.simulation.mujoco_calls` for MuJoCo, and `khep_twin.episodes.planar.compiled` for the plane. Core
and sensors are the same for all kinds.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import NamedTuple, ParamSpec, Protocol, Self, TypeVar, cast

import numpy as np

from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.seen_surfaces import Chip

COARSE, FINE = 0, 1
"""Density of the points on a bulb: 9 points decide whether it is partly hidden, 64 give the visible part."""

MAX_SPEED = 1000.0
"""Highest speed of a joint in a playpen [m/s or rad/s]; beyond it the simulation has diverged."""

Triple = tuple[float, float, float]

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


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


class Scene(Protocol):
    """A scene with its robots."""

    def step(self) -> None:
        """Advance the physics by one step."""

    def in_bounds(self, limit: float) -> bool:
        """Return whether all positions are finite and within `limit` [m], and speeds within `MAX_SPEED`."""
        ...

    def has_warned(self) -> bool:
        """Return whether the physics engine has issued a warning."""
        ...

    def pose(self, index: int) -> tuple[float, float, float, float]:
        """Return x, y [m], cosine and sine of the heading of an upright robot, by the index of its pose."""
        ...

    def joint_position(self, index: int) -> float:
        """Return the position of a joint [m or rad]."""
        ...

    def joint_speed(self, index: int) -> float:
        """Return the speed of a joint [m/s or rad/s]."""
        ...

    def motor_torque(self, index: int) -> float:
        """Return the torque of a motor in the last step [N m]."""
        ...

    def set_motor(self, index: int, voltage: float) -> None:
        """Set the voltage of a motor [V]."""

    def body_frame(self, sensors: RobotSensors) -> Sequence[float]:
        """Return the rotation matrix of a robot, row by row (9,)."""
        ...

    def position(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Return the position of a sensor (3,) [m]."""
        ...

    def chip(self, sensors: RobotSensors, channel: int) -> Chip:
        """Return the pose of a sensor's chip, which `surfaces` requires."""
        ...

    def surfaces(self, sensors: RobotSensors, channel: int, chip: Chip, min_light: float) -> int:
        """Write the surfaces in range of a sensor to `proximity.surfaces`; return their number.

        Args:
            sensors: Sensors of the robot.
            channel: Number of the sensor.
            chip: Chip of the sensor.
            min_light: Smallest light that matters [counts]; the result may be 0 if by `proximity.bound` all
                surfaces are too far away to reflect as much.
        """
        ...

    def is_blocked(self, sensors: RobotSensors, channel: int, ray: Triple, glass: float) -> bool:
        """Return whether an obstacle blocks a ray from a sensor [m] before its fraction `glass`."""
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
        """Return the part of the rays from a sensor to points of a bulb that is blocked before its glass.

        Args:
            sensors: Sensors of the robot.
            channel: Number of the sensor.
            disc: COARSE or FINE points.
            left: Vector from the bulb's centre to its left edge, as seen from the sensor [m].
            up: Vector from the bulb's centre to its upper edge [m].
            ray: Vector from the sensor to the bulb's centre [m].
            glass: Distance of the bulb's surface, in lengths of `ray`.
        """
        ...

    def ray(self, sensors: RobotSensors, start: Triple, direction: Triple) -> tuple[float, float]:
        """Return length [m] and reflectance of a ray's end, floor and paint included; length -1 for none."""
        ...


class BeamScene(Scene, Protocol):
    """A scene for robots that record moments, and whose rays form beams."""

    def update_frames(self) -> None:
        """Move all bodies and sensors to the present positions of the joints, as the next step does."""

    def save_moment(self, moment: int, powers: Sequence[float]) -> None:
        """Record the positions of all joints and the powers of the lamps [W] as a moment, by its number."""

    def copy_moment(self, source: int, destination: int) -> None:
        """Copy a recorded moment."""

    def sensor_frame(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Return the rotation matrix of a sensor, row by row (9,); it looks along its -z axis."""
        ...

    def cast_rays(self, sensors: RobotSensors, beams: Beams, start: Triple, reach: float) -> None:
        """Cast rays from a point, up to a length [m]; the floor is no obstacle.

        Args:
            sensors: Sensors of the robot, which the rays ignore.
            beams: Vectors of the rays; the other buffers are filled in.
            start: Point.
            reach: Longest length [m].
        """


def _query(method: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Return the query of a method: a function that calls that of the scene, its first argument."""
    name = method.__name__

    @wraps(method)
    def call(scene: object, *arguments: object) -> _Result:
        return getattr(scene, name)(*arguments)

    return cast(Callable[_Parameters, _Result], call)


step = _query(Scene.step)
in_bounds = _query(Scene.in_bounds)
has_warned = _query(Scene.has_warned)
pose = _query(Scene.pose)
joint_position = _query(Scene.joint_position)
joint_speed = _query(Scene.joint_speed)
motor_torque = _query(Scene.motor_torque)
set_motor = _query(Scene.set_motor)
body_frame = _query(Scene.body_frame)
position = _query(Scene.position)
chip = _query(Scene.chip)
surfaces = _query(Scene.surfaces)
is_blocked = _query(Scene.is_blocked)
hidden_part = _query(Scene.hidden_part)
update_frames = _query(BeamScene.update_frames)
save_moment = _query(BeamScene.save_moment)
copy_moment = _query(BeamScene.copy_moment)
sensor_frame = _query(BeamScene.sensor_frame)
ray = _query(Scene.ray)
cast_rays = _query(BeamScene.cast_rays)
