"""A scene as the stepping core queries it: motion, joints, and rays of its robots' sensors.

Plain code calls a scene's own methods. Compiled code has a function in place of each of these for every kind
of scene: `khep_twin.simulation.mujoco_calls` calls MuJoCo, `khep_twin.episodes.planar.compiled` the plane.
The core and the sensors' arithmetic are the same for all of them.
"""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from khep_twin.board.kernel import AMBIENT, PROXIMITY, Registers
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.seen_surfaces import Chip

FEW, MANY = 0, 1
"""Numbers of points on a bulb: 9 or 64."""

FASTEST = 1000.0
"""Highest speed of a joint in a playpen [m/s or rad/s]; beyond it the simulation has diverged."""

Triple = tuple[float, float, float]


class SceneMotion(Protocol):
    """Motion of a scene."""

    def step(self) -> None:
        """Answer the query `step`."""
        ...

    def in_bounds(self, limit: float) -> bool:
        """Answer the query `in_bounds`."""
        ...

    def warned(self) -> bool:
        """Answer the query `warned`."""
        ...

    def pose(self, index: int) -> tuple[float, float, float, float]:
        """Answer the query `pose`."""
        ...


class SceneJoints(Protocol):
    """Joints and motors of a scene, by their indices."""

    def joint_position(self, index: int) -> float:
        """Answer the query `joint_position`."""
        ...

    def joint_speed(self, index: int) -> float:
        """Answer the query `joint_speed`."""
        ...

    def motor_torque(self, index: int) -> float:
        """Answer the query `motor_torque`."""
        ...

    def set_motor(self, index: int, voltage: float) -> None:
        """Answer the query `set_motor`."""
        ...


class SceneSight(Protocol):
    """Poses of the sensors in a scene."""

    def body_frame(self, sensors: RobotSensors) -> Sequence[float]:
        """Answer the query `body_frame`."""
        ...

    def position(self, sensors: RobotSensors, channel: int) -> Sequence[float]:
        """Answer the query `position`."""
        ...

    def chip(self, sensors: RobotSensors, channel: int) -> Chip:
        """Answer the query `chip`."""
        ...


class SceneRays(Protocol):
    """Surfaces and rays of the sensors in a scene."""

    def surfaces(self, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
        """Answer the query `surfaces`."""
        ...

    def stopped(self, sensors: RobotSensors, channel: int, way: Triple, glass: float) -> bool:
        """Answer the query `stopped`."""
        ...

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
        ...


class Scene(SceneMotion, SceneJoints, SceneSight, SceneRays, Protocol):
    """A scene with its robots."""


def step(scene: Scene) -> None:
    """Advance the physics by one step."""
    scene.step()


def in_bounds(scene: Scene, limit: float) -> bool:
    """Return whether all positions are finite and within `limit` [m], and the speeds within `FASTEST`."""
    return scene.in_bounds(limit)


def warned(scene: Scene) -> bool:
    """Return whether the physics has warned."""
    return scene.warned()


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
    """Return the orientation of a robot: rows of a matrix (9,)."""
    return scene.body_frame(sensors)


def position(scene: Scene, sensors: RobotSensors, channel: int) -> Sequence[float]:
    """Return the position of a sensor (3,) [m]."""
    return scene.position(sensors, channel)


def chip(scene: Scene, sensors: RobotSensors, channel: int) -> Chip:
    """Return the place of a sensor's chip, in the frame in which `surfaces` finds what it sees."""
    return scene.chip(sensors, channel)


def surfaces(scene: Scene, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
    """Fill in `proximity.found` with the surfaces that a sensor may see; return their number.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        chip: Chip of the sensor.
        needed: Light that matters [counts]; 0 may be returned where all is so far off that, by
            `proximity.bound`, none gives as much.
    """
    return scene.surfaces(sensors, channel, chip, needed)


def stopped(scene: Scene, sensors: RobotSensors, channel: int, way: Triple, glass: float) -> bool:
    """Return whether light along a way from a sensor [m] is stopped before a part of it, 0 to 1."""
    return scene.stopped(sensors, channel, way, glass)


def blocked(
    scene: Scene,
    sensors: RobotSensors,
    channel: int,
    disc: int,
    left: Triple,
    up: Triple,
    way: Triple,
    glass: float,
) -> float:
    """Return the part of the rays from a sensor to points of a bulb that is stopped before its glass.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        disc: FEW or MANY points.
        left: Vector to the bulb's left edge, as seen from the sensor [m].
        up: Vector to the bulb's upper edge [m].
        way: Vector from the sensor to the bulb's centre [m].
        glass: Start of the bulb, in lengths of `way`.
    """
    return scene.blocked(sensors, channel, disc, left, up, way, glass)


def decide(
    function: Callable[..., tuple[float, float]],
    registers: Registers,
    memory: Vector[float],
    genes: Vector[float],
    speeds: Vector[float],
) -> None:
    """Call a controller; compiled code calls it by its address.

    Args:
        function: Function of proximity (8,), ambient (8,), memory and genes.
        registers: Registers of the board (N_REGISTERS,).
        memory: State of the controller.
        genes: Parameters of the controller, which it does not change.
        speeds: Buffer for the returned speeds, left and right (2,); NaN where its arithmetic fails, as in a
            division by 0.
    """
    board = np.asarray(registers)
    proximity, ambient = board[PROXIMITY[0] : PROXIMITY[-1] + 1], board[AMBIENT[0] : AMBIENT[-1] + 1]
    try:
        speeds[0], speeds[1] = function(proximity, ambient, memory, genes)
    except ArithmeticError:
        speeds[0] = speeds[1] = math.nan
