"""The queries of `sensing.scene` in a plane, for screening.

The robot is a disc on two wheels, among upright boxes and cylinders with heights. `motion` moves it,
`rays` and `shadows` compute what its sensors see, as MuJoCo does for upright obstacles and no tilt.
This source runs interpreted and compiled.

No obstacle is left out for its distance. For each a lower bound of its distance is kept, less the distance
moved since; obstacles are tested in that order, only as long as they can matter.
"""

import math
from collections.abc import Sequence
from functools import partial

from khep_twin.compilable import compilable
from khep_twin.rollout.planar import motion, shadows
from khep_twin.rollout.planar import plane as flat
from khep_twin.rollout.planar import rays as planar_rays
from khep_twin.rollout.planar.plane import (
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    DISTANCE,
    HEADING,
    HEADING_COSINE,
    HEADING_SINE,
    LENGTH,
    MOVED,
    REFLECTANCE,
    SEEN,
    SINE,
    WIDTH,
    Plane,
    X,
    Y,
)
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.optics import RobotSensors
from khep_twin.sensing.scene import FASTEST, FEW, Triple

_ROUNDING = 1e-9
"""Margin for rounding beyond the farthest hit of a ray [m]."""


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
    return joints[X], joints[Y], math.cos(joints[HEADING]), math.sin(joints[HEADING])


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
def sensor_frame(scene: Plane, sensors: RobotSensors, channel: int) -> Sequence[float]:
    """Return the same as `scene.sensor_frame`."""
    last, mounts = scene.robot.last, scene.robot.mounts
    c, s = last[HEADING_COSINE], last[HEADING_SINE]
    x = c * mounts[channel, 2] - s * mounts[channel, 3]
    y = s * mounts[channel, 2] + c * mounts[channel, 3]
    return y, 0.0, -x, -x, 0.0, -y, 0.0, 1.0, 0.0


@compilable
def direction(
    scene: Plane, frame: Sequence[float], channel: int, ray: int, tangential: float
) -> tuple[float, float, float]:
    """Return the same as `scene.direction`."""
    c, s = scene.robot.last[HEADING_COSINE], scene.robot.last[HEADING_SINE]
    ray_directions, n_wide = scene.robot.ray_directions, len(scene.robot.hits)
    ahead, left = ray_directions[channel, ray], ray_directions[channel, n_wide + ray]
    return c * ahead - s * left, s * ahead + c * left, 0.0


@compilable
def rays(scene: Plane, sensors: RobotSensors, channel: int, level: float) -> int:
    """Cast the same rays as `scene.rays`, but none if nothing can be near enough to count."""
    proximity, found = sensors.proximity, sensors.proximity.found
    robot, things, order = scene.robot, scene.things, scene.order
    away = robot.mounts[channel, 4] + robot.last[MOVED]
    gain, offset = proximity.gain[channel] * proximity.brightest, proximity.offset[channel]
    n = len(order)
    if level < 0:
        # At this distance nothing passes the threshold; a margin is left for rounding.
        if n == 0:
            return 0
        least = max(things[order[0], DISTANCE] - away, 0.0) + offset
        if gain * 1.000001 <= -level * least * least:
            return 0
    place = position(scene, sensors, channel)
    x, y = place[0], place[1]
    c, s = robot.last[HEADING_COSINE], robot.last[HEADING_SINE]
    cones = scene.robot.cones
    right_x = c * cones[channel, 0] - s * cones[channel, 1]
    right_y = s * cones[channel, 0] + c * cones[channel, 1]
    left_x = c * cones[channel, 2] - s * cones[channel, 3]
    left_y = s * cones[channel, 2] + c * cones[channel, 3]
    cone = right_x, right_y, left_x, left_y
    reach = math.inf
    if level < 0:
        reach = math.sqrt(gain / -level) * 1.000001 - offset
        if not _within(scene, x, y, cone, reach, away):
            return 0
    n_rays, n_wide = len(found) // 4, len(robot.hits)
    for ray in range(n_wide):
        ahead, left = robot.ray_directions[channel, ray], robot.ray_directions[channel, n_wide + ray]
        robot.looks[ray] = c * ahead - s * left
        robot.looks[n_wide + ray] = s * ahead + c * left
        robot.lengths[ray] = math.inf
        robot.hits[ray] = -1
    farthest, next_look = math.inf, reach
    for i in range(n):
        thing = order[i]
        least = things[thing, DISTANCE] - away
        if least > farthest:
            break
        if least > next_look:
            # All remaining obstacles are farther away than this.
            light = planar_rays.most(robot, proximity.weights[channel], offset, least)
            if gain * light * 1.000001 <= -level:
                return 0
            next_look = least + reach
        if not things[thing, SEEN] or not planar_rays.in_cone(things, thing, x, y, cone):
            continue
        if farthest < math.inf and flat.distance_to(things, thing, x, y) > farthest + _ROUNDING:
            continue
        if things[thing, WIDTH] < 0:
            planar_rays.meet_circle(scene, thing, x, y)
        else:
            planar_rays.meet_box(scene, thing, x, y)
        farthest = 0.0
        for ray in range(n_rays):
            farthest = max(farthest, robot.lengths[ray])
    if level < 0:
        light = planar_rays.most(robot, proximity.weights[channel], offset, math.inf)
        if gain * light * 1.000001 <= -level:
            return 0
    _fill(scene, x, y, found)
    return len(found)


@compilable
def _fill(scene: Plane, x: float, y: float, found: Vector[float]) -> None:
    """Fill in length and normal of each ray of a sensor, below 0 and 0 for a miss."""
    robot, things, n_wide = scene.robot, scene.things, len(scene.robot.hits)
    for ray in range(len(found) // 4):
        length, hit = robot.lengths[ray], robot.hits[ray]
        found[4 * ray] = -1.0
        found[4 * ray + 1] = found[4 * ray + 2] = found[4 * ray + 3] = 0.0
        if hit < 0:
            continue
        found[4 * ray] = length
        thing, face = hit >> 2, hit & 3
        if things[thing, WIDTH] < 0:
            dx = x + length * robot.looks[ray] - things[thing, CENTRE_X]
            dy = y + length * robot.looks[n_wide + ray] - things[thing, CENTRE_Y]
            found[4 * ray + 1], found[4 * ray + 2] = dx / things[thing, LENGTH], dy / things[thing, LENGTH]
        else:
            sign = -1.0 if face & 1 else 1.0
            normal_x, normal_y = sign * things[thing, COSINE], sign * things[thing, SINE]
            if face & 2:
                normal_x, normal_y = -normal_y, normal_x
            found[4 * ray + 1], found[4 * ray + 2] = normal_x, normal_y


@compilable
def _within(
    scene: Plane, x: float, y: float, cone: tuple[float, float, float, float], reach: float, away: float
) -> bool:
    """Return whether anything is within reach [m] and in a sensor's cone; False is certain."""
    things = scene.things
    for i in range(len(scene.order)):
        thing = scene.order[i]
        if things[thing, DISTANCE] - away > reach:
            return False
        if not scene.things[thing, SEEN]:
            continue
        distance = flat.distance_to(things, thing, x, y)
        if distance <= reach and planar_rays.in_cone(things, thing, x, y, cone):
            return True
    return False


@compilable
def surfaces(scene: Plane, sensors: RobotSensors, channel: int, cutoff: float) -> None:
    """Fill in the same as `scene.surfaces`, from what `rays` has hit."""
    found = sensors.proximity.reflectances
    for ray in range(len(found)):
        hit = scene.robot.hits[ray]
        found[ray] = scene.things[hit >> 2, REFLECTANCE] if hit >= 0 else 0.0


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
    cutoff: float,
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
    sensor_frame,
    direction,
    rays,
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
