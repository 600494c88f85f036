"""The queries of `sensing.scene` in a plane, for screening.

The robot is a disc on two wheels, among upright boxes and cylinders with heights. `motion` moves it,
`shadows` computes which lamps its sensors see, as MuJoCo does for upright obstacles and no tilt.
This source runs interpreted and compiled.

No obstacle is left out that can matter. For each a lower bound of its distance is kept, less the distance
moved since; once per step, those within sight are found in that order and put into the robot's frame.
"""

import math
from collections.abc import Sequence
from functools import partial

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import motion, shadows
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.plane import (
    BOTTOM,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    DISTANCE,
    HEADING_COSINE,
    HEADING_SINE,
    LENGTH,
    N_NEAR,
    NEAREST,
    REFLECTANCE,
    SINE,
    TOP,
    WIDTH,
    Plane,
    X,
    Y,
)
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import FASTEST, FEW, Triple
from khep_twin.sensing.seen_surfaces import Chip, add_upright


@compilable
def step(scene: Plane) -> None:
    """Advance the motion by one step."""
    motion.step(scene)


@compilable
def in_bounds(scene: Plane, limit: float) -> bool:
    """Return the same as `scene.in_bounds`."""
    joints, speeds = scene.robot.joints, scene.robot.speeds
    places = joints[X] * joints[X] + joints[Y] * joints[Y]
    if not places <= 2 * limit * limit:
        return False
    return _square(speeds) <= len(speeds) * FASTEST * FASTEST and _square(joints) < math.inf


@compilable
def _square(numbers: Vector[float]) -> float:
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i] * numbers[i]
    return total


@compilable
def warned(scene: Plane) -> bool:
    """Return False, as there are no warnings in a plane."""
    return False


@compilable
def pose(scene: Plane, index: int) -> tuple[float, float, float, float]:
    """Return the same as `scene.pose`."""
    joints = scene.robot.joints
    c, s = flat.direction(scene.robot)
    return joints[X], joints[Y], c, s


@compilable
def joint_position(scene: Plane, index: int) -> float:
    """Return the same as `scene.joint_position`."""
    return scene.robot.joints[index]


@compilable
def joint_speed(scene: Plane, index: int) -> float:
    """Return the same as `scene.joint_speed`."""
    return scene.robot.speeds[index]


@compilable
def motor_torque(scene: Plane, index: int) -> float:
    """Return the same as `scene.motor_torque`."""
    return scene.robot.force[index]


@compilable
def set_motor(scene: Plane, index: int, voltage: float) -> None:
    """Set the voltage of a motor [V]."""
    scene.robot.ctrl[index] = voltage


@compilable
def body_frame(scene: Plane, sensors: RobotSensors) -> Sequence[float]:
    """Return the same as `scene.body_frame`."""
    c, s = scene.robot.last[HEADING_COSINE], scene.robot.last[HEADING_SINE]
    return c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0


@compilable
def position(scene: Plane, sensors: RobotSensors, channel: int) -> tuple[float, float, float]:
    """Return the same as `scene.position`."""
    last, mounts = scene.robot.last, scene.robot.mounts
    c, s = last[HEADING_COSINE], last[HEADING_SINE]
    ahead, left = mounts[channel, 0], mounts[channel, 1]
    return last[CENTRE_X] + c * ahead - s * left, last[CENTRE_Y] + s * ahead + c * left, scene.robot.height


@compilable
def chip(scene: Plane, sensors: RobotSensors, channel: int) -> Chip:
    """Return the same as `scene.chip`, in the robot's frame."""
    robot, offset, reach = scene.robot, sensors.proximity.offset[channel], sensors.proximity.reach[channel]
    ahead, left = robot.mounts[channel, 2], robot.mounts[channel, 3]
    x, y = robot.mounts[channel, 0] - offset * ahead, robot.mounts[channel, 1] - offset * left
    return Chip(x, y, ahead, left, robot.height, reach)


@compilable
def surfaces(scene: Plane, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
    """Fill in the same as `scene.surfaces`."""
    proximity, things, n_near = sensors.proximity, scene.near, int(scene.robot.last[N_NEAR])
    away = scene.robot.mounts[channel, 4] + proximity.offset[channel]
    if not _matters(scene, chip, proximity.bound[channel], needed, away):
        return 0
    count, farthest = 0, chip.reach + away
    for thing in range(n_near):
        if things[thing, DISTANCE] > farthest:
            continue
        shape = (
            (things[thing, CENTRE_X], things[thing, CENTRE_Y]),
            (things[thing, COSINE], things[thing, SINE]),
            (things[thing, LENGTH], things[thing, WIDTH]),
            (things[thing, BOTTOM], things[thing, TOP]),
        )
        count = add_upright(proximity.found, count, chip, shape, things[thing, REFLECTANCE])
    return count


@compilable
def _matters(scene: Plane, chip: Chip, bound: float, needed: float, away: float) -> bool:
    """Return whether any obstacle may give as much light as is needed.

    Args:
        scene: Plane.
        chip: Chip of the sensor.
        bound: Largest light of anything at a distance of 1 m [counts m^2].
        needed: Light that matters [counts].
        away: Distance of the chip from the robot's centre, at the most [m].
    """
    things, last = scene.near, scene.robot.last
    if _faint(last[NEAREST] - away, bound, needed):
        return False
    for thing in range(int(last[N_NEAR])):
        if not _faint(things[thing, DISTANCE] - away, bound, needed) and not _faint(
            flat.distance_to(things, thing, chip.x, chip.y), bound, needed
        ):
            return True
    return False


@compilable
def _faint(distance: float, bound: float, needed: float) -> bool:
    """Return whether anything at a distance gives less light than is needed."""
    return distance > 0 and distance * distance * needed > bound


@compilable
def stopped(scene: Plane, sensors: RobotSensors, channel: int, way: Triple, glass: float) -> bool:
    """Return the same as `scene.stopped`."""
    return shadows.stopped(scene, position(scene, sensors, channel), way, glass)


@compilable
def blocked(
    scene: Plane,
    sensors: RobotSensors,
    channel: int,
    disc: int,
    left: Triple,
    up: Triple,
    way: Triple,
    glass: float,
) -> float:
    """Return the same as `scene.blocked`."""
    n_few, n_points = scene.robot.n_few, len(scene.robot.points)
    first, last = (0, n_few) if disc == FEW else (n_few, n_points)
    return shadows.blocked(scene, position(scene, sensors, channel), first, last, left, up, way, glass)


QUERIES = (
    step,
    in_bounds,
    warned,
    pose,
    joint_position,
    joint_speed,
    motor_torque,
    set_motor,
    body_frame,
    position,
    chip,
    surfaces,
    stopped,
    blocked,
)
"""Functions that answer the queries of the same names in `sensing.scene`."""


class PlaneScene:
    """A plane for plain code: its methods answer the queries of `sensing.scene`."""

    def __init__(self, plane: Plane) -> None:
        self.plane = plane
        for query in QUERIES:
            setattr(self, query.__name__, partial(query, plane))
