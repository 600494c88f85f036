"""The queries of `sensing.scene` in a plane, for screening.

The robot is a disc on two wheels among upright boxes and cylinders with heights. `motion` moves it. `shadows`
computes which lamps its sensors see, as MuJoCo does for upright obstacles and no tilt. This source runs
interpreted and compiled.

The search for near obstacles is exact: the last measured distance of an obstacle, minus the path since, is
a lower bound of its distance. Once per step, those in sensor range are transformed to the robot's frame.
"""

import math
from collections.abc import Sequence
from functools import partial

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import motion, shadows
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.plane import Plane, X, Y
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import COARSE, MAX_SPEED, Beams, Triple
from khep_twin.sensing.seen_surfaces import Chip, add_upright


@compilable
def step(scene: Plane) -> None:
    """Advance the motion by one step."""
    motion.step(scene)


@compilable
def in_bounds(scene: Plane, limit: float) -> bool:
    """Return the value of `scene.in_bounds`."""
    joints, speeds = scene.robot.joints, scene.robot.speeds
    square_distance = joints[X] * joints[X] + joints[Y] * joints[Y]
    if not square_distance <= 2 * limit * limit:
        return False
    return _square_sum(speeds) <= len(speeds) * MAX_SPEED * MAX_SPEED and _square_sum(joints) < math.inf


@compilable
def _square_sum(numbers: Vector[float]) -> float:
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i] * numbers[i]
    return total


@compilable
def has_warned(scene: Plane) -> bool:
    """Return False, as there are no warnings in a plane."""
    return False


@compilable
def pose(scene: Plane, index: int) -> tuple[float, float, float, float]:
    """Return the value of `scene.pose`."""
    joints = scene.robot.joints
    c, s = planar.direction(scene.robot)
    return joints[X], joints[Y], c, s


@compilable
def joint_position(scene: Plane, index: int) -> float:
    """Return the value of `scene.joint_position`, with a free joint's from `planar.FREE_JOINT` on."""
    joints = scene.robot.joints
    if index < planar.N_JOINTS:
        return joints[index]
    index -= planar.FREE_JOINT  # x, y and z, then a quaternion
    if index < 2:
        return joints[X + index]
    half = joints[planar.HEADING] / 2
    return math.cos(half) if index == 3 else math.sin(half) if index == 6 else 0.0


@compilable
def joint_speed(scene: Plane, index: int) -> float:
    """Return the value of `scene.joint_speed`, with a free joint's from `planar.FREE_JOINT` on."""
    speeds = scene.robot.speeds
    if index < planar.N_JOINTS:
        return speeds[index]
    index -= planar.FREE_JOINT  # velocity in the world, then rotation
    c, s = planar.direction(scene.robot)
    if index < 2:
        return speeds[0] * c - speeds[1] * s if index == 0 else speeds[0] * s + speeds[1] * c
    return speeds[planar.HEADING] if index == 5 else 0.0


@compilable
def motor_torque(scene: Plane, index: int) -> float:
    """Return the value of `scene.motor_torque`."""
    return scene.robot.force[index]


@compilable
def set_motor(scene: Plane, index: int, voltage: float) -> None:
    """Set the voltage of a motor, clipped to its range [V]."""
    limit = scene.robot.max_voltage
    scene.robot.ctrl[index] = min(max(voltage, -limit), limit)


@compilable
def body_frame(scene: Plane, sensors: RobotSensors) -> Sequence[float]:
    """Return the value of `scene.body_frame`."""
    c, s = scene.robot.last_step[planar.HEADING_COSINE], scene.robot.last_step[planar.HEADING_SINE]
    return c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0


@compilable
def position(scene: Plane, sensors: RobotSensors, channel: int) -> tuple[float, float, float]:
    """Return the value of `scene.position`."""
    last, mounts = scene.robot.last_step, scene.robot.mounts
    c, s = last[planar.HEADING_COSINE], last[planar.HEADING_SINE]
    forward, left = mounts[channel, 0], mounts[channel, 1]
    x, y = (last[planar.CENTRE_X] + c * forward - s * left, last[planar.CENTRE_Y] + s * forward + c * left)
    return x, y, mounts[channel, planar.MOUNT_HEIGHT]


@compilable
def chip(scene: Plane, sensors: RobotSensors, channel: int) -> Chip:
    """Return the value of `scene.chip`, in the robot's frame."""
    robot, offset, reach = scene.robot, sensors.proximity.offset[channel], sensors.proximity.reach[channel]
    forward, left = robot.mounts[channel, 2], robot.mounts[channel, 3]
    x, y = robot.mounts[channel, 0] - offset * forward, robot.mounts[channel, 1] - offset * left
    return Chip(x, y, forward, left, robot.mounts[channel, planar.MOUNT_HEIGHT], reach)


@compilable
def surfaces(scene: Plane, sensors: RobotSensors, channel: int, chip: Chip, min_light: float) -> int:
    """Fill in the surfaces in reach of a sensor as `scene.surfaces` does; return their number."""
    proximity, near, n_near = sensors.proximity, scene.near, int(scene.robot.last_step[planar.N_NEAR])
    chip_distance = scene.robot.mounts[channel, 4] + proximity.offset[channel]
    if not _is_relevant(scene, chip, proximity.bound[channel], min_light, chip_distance):
        return 0
    count, max_distance = 0, chip.reach + chip_distance
    for index in range(n_near):
        if near[index, planar.DISTANCE] > max_distance:
            continue
        shape = (
            (near[index, planar.CENTRE_X], near[index, planar.CENTRE_Y]),
            (near[index, planar.COSINE], near[index, planar.SINE]),
            (near[index, planar.HALF_LENGTH], near[index, planar.HALF_WIDTH]),
            (near[index, planar.BOTTOM], near[index, planar.TOP]),
        )
        count = add_upright(proximity.surfaces, count, chip, shape, near[index, planar.REFLECTANCE])
    return count


@compilable
def _is_relevant(scene: Plane, chip: Chip, bound: float, min_light: float, chip_distance: float) -> bool:
    """Return whether any obstacle may reflect the required light.

    Args:
        scene: Plane.
        chip: Chip of the sensor.
        bound: Largest light from any obstacle at a distance of 1 m [counts m^2].
        min_light: Smallest relevant light [counts].
        chip_distance: Upper bound of the chip's distance from the robot's centre [m].
    """
    near, last = scene.near, scene.robot.last_step
    if _is_faint(last[planar.NEAREST] - chip_distance, bound, min_light):
        return False
    for index in range(int(last[planar.N_NEAR])):
        if not _is_faint(near[index, planar.DISTANCE] - chip_distance, bound, min_light) and not _is_faint(
            planar.distance_to(near, index, chip.x, chip.y), bound, min_light
        ):
            return True
    return False


@compilable
def _is_faint(distance: float, bound: float, min_light: float) -> bool:
    """Return whether every obstacle at a distance [m] reflects less than the required light."""
    return distance > 0 and distance * distance * min_light > bound


@compilable
def is_blocked(scene: Plane, sensors: RobotSensors, channel: int, ray: Triple, glass: float) -> bool:
    """Return the value of `scene.is_blocked`."""
    return shadows.is_path_blocked(scene, position(scene, sensors, channel), ray, glass)


@compilable
def hidden_part(
    scene: Plane,
    sensors: RobotSensors,
    channel: int,
    disc: int,
    left: Triple,
    up: Triple,
    ray: Triple,
    glass: float,
) -> float:
    """Return the value of `scene.hidden_part`."""
    n_few, n_points = scene.robot.n_coarse_points, len(scene.robot.points)
    start, stop = (0, n_few) if disc == COARSE else (n_few, n_points)
    return shadows.hidden_fraction(
        scene, position(scene, sensors, channel), start, stop, left, up, ray, glass
    )


@compilable
def update_frames(scene: Plane) -> None:
    """Move the sensors to the present pose."""
    motion.locate(scene)


@compilable
def save_moment(scene: Plane, moment: int, powers: Sequence[float]) -> None:
    """Do nothing, as episodes evaluate measurements when they are due."""


@compilable
def copy_moment(scene: Plane, source: int, destination: int) -> None:
    """Do nothing, as `save_moment`."""


@compilable
def sensor_frame(scene: Plane, sensors: RobotSensors, channel: int) -> Sequence[float]:
    """Return the value of `scene.sensor_frame` for a sensor that looks at the floor."""
    return body_frame(scene, sensors)


@compilable
def ray(scene: Plane, sensors: RobotSensors, start: Triple, direction: Triple) -> tuple[float, float]:
    """Return the value of `scene.ray` for a ray to the floor."""
    length = -start[2] / direction[2]
    x, y = start[0] + length * direction[0], start[1] + length * direction[1]
    top, reflectance = -math.inf, 0.0
    for row in range(len(scene.paint)):
        if scene.paint[row, planar.TOP] > top and planar.distance_to(scene.paint, row, x, y) == 0:
            top, reflectance = scene.paint[row, planar.TOP], scene.paint[row, planar.REFLECTANCE]
    return (top - start[2]) / direction[2], reflectance


@compilable
def cast_rays(scene: Plane, sensors: RobotSensors, beams: Beams, start: Triple, reach: float) -> None:
    """Cast rays as `scene.cast_rays` does."""
    for index in range(len(beams.lengths)):
        first = 3 * index
        vector = beams.vectors[first], beams.vectors[first + 1], beams.vectors[first + 2]
        nearest, beams.geoms[index] = reach, -1
        for obstacle in range(len(scene.obstacles)):
            length, x, y, z = shadows.entry_of(scene.obstacles, obstacle, start, vector)
            if 0 <= length < nearest:
                nearest, beams.geoms[index] = length, obstacle
                beams.normals[first], beams.normals[first + 1], beams.normals[first + 2] = x, y, z
        beams.lengths[index] = nearest if beams.geoms[index] >= 0 else -1.0


_BODY_QUERIES = step, in_bounds, has_warned, pose, joint_position, joint_speed, motor_torque, set_motor
_BEAM_QUERIES = update_frames, save_moment, copy_moment, sensor_frame, ray, cast_rays
QUERIES = *_BODY_QUERIES, body_frame, position, chip, surfaces, is_blocked, hidden_part, *_BEAM_QUERIES
"""Functions that implement the queries of the same names in `sensing.scene`."""


class PlaneScene:
    """A plane for uncompiled code; its methods implement the queries of `sensing.scene`."""

    def __init__(self, plane: Plane) -> None:
        self.plane = plane
        for query in QUERIES:
            setattr(self, query.__name__, partial(query, plane))
