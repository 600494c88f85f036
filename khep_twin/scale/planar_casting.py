"""`casting` for screening: the same questions, asked of a plane instead of MuJoCo.

The robot is a disc on two wheels, what stands around it are upright boxes and cylinders with their heights.
Its way is worked out in `planar_motion`; what its sensors see is worked out here, as MuJoCo does for upright
things and a robot that does not tilt. This source runs as it stands and compiled.

Nothing is left out for being far off. But for each thing a distance is kept that it surely is away, less the
way since; things are looked at in that order, and no longer than they can matter.
"""

import math
from collections.abc import Sequence
from typing import Any

from khep_twin import casting
from khep_twin.scale import planar_motion
from khep_twin.scale import plane as flat
from khep_twin.scale.plane import (
    BOTTOM,
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
    TOP,
    WIDTH,
    Plane,
    Robot,
)

__all__ = ["FEW", "LENGTH_AND_NORMAL", "MANY", "Scene"]

Scene = Plane

FEW, MANY, LENGTH_AND_NORMAL = casting.FEW, casting.MANY, casting.LENGTH_AND_NORMAL

decide = casting.decide

_ROUNDING = 1e-9
"""What is so much farther off than all rays have met cannot be met [m]."""


def step(scene: Scene) -> None:
    """One step of the way."""
    planar_motion.step(scene)


def heading(qpos: Sequence[float], pose: int) -> tuple[float, float]:
    """As `casting.heading`."""
    angle = qpos[pose + HEADING]
    return math.cos(angle), math.sin(angle)


def body_frame(scene: Scene) -> Sequence[float]:
    """As `casting.body_frame`."""
    c, s = scene.robot.last[HEADING_COSINE], scene.robot.last[HEADING_SINE]
    return c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0


def position(scene: Scene, channel: int) -> Sequence[float]:
    """As `casting.position`."""
    last, mounts = scene.robot.last, scene.robot.mounts
    c, s = last[HEADING_COSINE], last[HEADING_SINE]
    ahead, left = mounts[channel, 0], mounts[channel, 1]
    return last[CENTRE_X] + c * ahead - s * left, last[CENTRE_Y] + s * ahead + c * left, scene.robot.height


def sensor_frame(scene: Scene, channel: int) -> Sequence[float]:
    """As `casting.sensor_frame`."""
    last, mounts = scene.robot.last, scene.robot.mounts
    c, s = last[HEADING_COSINE], last[HEADING_SINE]
    x = c * mounts[channel, 2] - s * mounts[channel, 3]
    y = s * mounts[channel, 2] + c * mounts[channel, 3]
    return y, 0.0, -x, -x, 0.0, -y, 0.0, 1.0, 0.0


def direction(
    scene: Scene, frame: Sequence[float], channel: int, ray: int, aside: float
) -> tuple[float, float, float]:
    """As `casting.direction`."""
    c, s = scene.robot.last[HEADING_COSINE], scene.robot.last[HEADING_SINE]
    ways, n_wide = scene.robot.ways, len(scene.robot.hits)
    ahead, left = ways[channel, ray], ways[channel, n_wide + ray]
    return c * ahead - s * left, s * ahead + c * left, 0.0


def rays(scene: Scene, near: Any, channel: int, level: float, found: Any) -> int:
    """As `casting.rays`, but none where nothing can be near enough to count."""
    robot, things, order = scene.robot, scene.things, scene.order
    away = robot.mounts[channel, 4] + robot.last[MOVED]
    gain, offset = near.gain[channel] * near.brightest, near.offset[channel]
    n = len(order)
    if level < 0:
        # As far off as this nothing passes the threshold; a little less, for rounding.
        if n == 0:
            return 0
        least = max(things[order[0], DISTANCE] - away, 0.0) + offset
        if gain * 1.000001 <= -level * least * least:
            return 0
    place = position(scene, channel)
    x, y = place[0], place[1]
    c, s = robot.last[HEADING_COSINE], robot.last[HEADING_SINE]
    cones = scene.robot.cones
    right_x = c * cones[channel, 0] - s * cones[channel, 1]
    right_y = s * cones[channel, 0] + c * cones[channel, 1]
    left_x = c * cones[channel, 2] - s * cones[channel, 3]
    left_y = s * cones[channel, 2] + c * cones[channel, 3]
    reach = math.inf
    if level < 0:
        reach = math.sqrt(gain / -level) * 1.000001 - offset
        if not _within(scene, x, y, right_x, right_y, left_x, left_y, reach, away):
            return 0
    n_rays, n_wide = len(found) // 4, len(robot.hits)
    for ray in range(n_wide):
        ahead, left = robot.ways[channel, ray], robot.ways[channel, n_wide + ray]
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
            # All that is left is farther off than this.
            if gain * _most(robot, near.weights[channel], offset, least) * 1.000001 <= -level:
                return 0
            next_look = least + reach
        if not things[thing, SEEN] or not _in_cone(things, thing, x, y, right_x, right_y, left_x, left_y):
            continue
        if farthest < math.inf and flat.distance_to(things, thing, x, y) > farthest + _ROUNDING:
            continue
        if things[thing, WIDTH] < 0:
            _meet_circle(scene, thing, x, y)
        else:
            _meet_box(scene, thing, x, y)
        farthest = 0.0
        for ray in range(n_rays):
            farthest = max(farthest, robot.lengths[ray])
    if level < 0 and gain * _most(robot, near.weights[channel], offset, math.inf) * 1.000001 <= -level:
        return 0
    for ray in range(n_rays):
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
    return len(found)


def _most(robot: Robot, weights: Sequence[float], offset: float, rest: float) -> float:
    """How much light comes back at most [1/m^2]: all is met head-on, and at `rest` [m] what else there is."""
    for ray in range(len(robot.shares)):
        path = min(robot.lengths[ray], rest) + offset
        robot.shares[ray] = 1 / (path * path)
    total = 0.0
    for ray in range(len(weights)):
        total += weights[ray] * robot.shares[ray]
    return total


def _within(
    scene: Scene,
    x: float,
    y: float,
    right_x: float,
    right_y: float,
    left_x: float,
    left_y: float,
    reach: float,
    away: float,
) -> bool:
    """Whether anything is within reach [m] and the cone of a sensor; sure if it says no."""
    things = scene.things
    for i in range(len(scene.order)):
        thing = scene.order[i]
        if things[thing, DISTANCE] - away > reach:
            return False
        if not scene.things[thing, SEEN]:
            continue
        distance = flat.distance_to(things, thing, x, y)
        if distance <= reach and _in_cone(things, thing, x, y, right_x, right_y, left_x, left_y):
            return True
    return False


def _in_cone(
    things: Any,
    thing: int,
    x: float,
    y: float,
    right_x: float,
    right_y: float,
    left_x: float,
    left_y: float,
) -> bool:
    """Whether a thing reaches over both edges of a cone."""
    dx, dy = things[thing, CENTRE_X] - x, things[thing, CENTRE_Y] - y
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    if width < 0:
        return dx * right_x + dy * right_y + length >= 0 and dx * left_x + dy * left_y + length >= 0
    c, s = things[thing, COSINE], things[thing, SINE]
    most = length * abs(c * right_x + s * right_y) + width * abs(c * right_y - s * right_x)
    if dx * right_x + dy * right_y + most < 0:
        return False
    most = length * abs(c * left_x + s * left_y) + width * abs(c * left_y - s * left_x)
    return dx * left_x + dy * left_y + most >= 0


def _meet_box(scene: Scene, thing: int, x: float, y: float) -> None:
    """Where a sensor's rays meet a box, if that is nearer than what they have met."""
    things, robot = scene.things, scene.robot
    looks, lengths, hits = robot.looks, robot.lengths, robot.hits
    n_wide = len(hits)
    c, s = things[thing, COSINE], things[thing, SINE]
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    along, across = dx * c + dy * s, dy * c - dx * s
    # Of its faces a place sees at most one at an end and one at a side. These look so:
    end, side = math.copysign(1.0, along), math.copysign(1.0, across)
    end_x, end_y, side_x, side_y = end * c, end * s, -side * s, side * c
    an_end, a_side = 4 * thing + (0 if end > 0 else 1), 4 * thing + (2 if side > 0 else 3)
    along, across = abs(along), abs(across)
    before_end, before_side = along - length, across - width
    if before_end <= 0 and before_side <= 0:
        # From inside, which does not happen but for rounding, it stands at the nearer face.
        before_end, before_side = (0.0, -1.0) if before_end > before_side else (-1.0, 0.0)
    # The same for all rays, and nothing skipped: compiled, they go side by side.
    for ray in range(n_wide):
        way_x, way_y = looks[ray], looks[n_wide + ray]
        to_end, to_side = -(way_x * end_x + way_y * end_y), -(way_x * side_x + way_y * side_y)
        # Whether it comes to the line of a face where that is.
        at_end, at_side = across * to_end - before_end * to_side, along * to_side - before_side * to_end
        by_end = (to_end > 0) & (before_end >= 0) & (abs(at_end) <= width * to_end)
        by_side = (to_side > 0) & (before_side >= 0) & (abs(at_side) <= length * to_side)
        end_hit = before_end / to_end if by_end else math.inf
        side_hit = before_side / to_side if by_side else math.inf
        hit, best = min(end_hit, side_hit), lengths[ray]
        lengths[ray] = min(best, hit)
        face = an_end if end_hit <= side_hit else a_side
        hits[ray] = face if hit < best else hits[ray]


def _meet_circle(scene: Scene, thing: int, x: float, y: float) -> None:
    """Where a sensor's rays meet a cylinder, if that is nearer than what they have met."""
    things, robot = scene.things, scene.robot
    looks, lengths, hits = robot.looks, robot.lengths, robot.hits
    n_wide = len(hits)
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    outside = dx * dx + dy * dy - things[thing, LENGTH] * things[thing, LENGTH]
    # From inside, which does not happen but for rounding, it sees the far side.
    sign, least = (1.0, 0.0) if outside > 0 else (-1.0, -math.inf)
    for ray in range(n_wide):
        towards = -(dx * looks[ray] + dy * looks[n_wide + ray])
        square, best = towards * towards - outside, lengths[ray]
        way = towards - sign * math.sqrt(max(square, 0.0))
        hit = way if (square >= 0) & (towards >= least) else math.inf
        lengths[ray] = min(best, hit)
        hits[ray] = 4 * thing if hit < best else hits[ray]


def surfaces(scene: Scene, channel: int, directions: Any, cutoff: float, found: Any) -> None:
    """As `casting.surfaces`: what `rays` has hit with the same rays."""
    for ray in range(len(found)):
        hit = scene.robot.hits[ray]
        found[ray] = scene.things[hit >> 2, REFLECTANCE] if hit >= 0 else 0.0


def stopped(scene: Scene, channel: int, x: float, y: float, z: float, glass: float) -> bool:
    """As `casting.stopped`."""
    at_x, at_y, at_z = position(scene, channel)
    if z < 0 and -at_z / z < glass:
        return True
    length = math.sqrt(x * x + y * y)
    for thing in range(len(scene.things)):
        if _beside(scene.things, thing, at_x, at_y, x, y, length, 0.0):
            continue
        if _stops(scene.things, thing, at_x, at_y, at_z, x, y, z, glass):
            return True
    return False


def blocked(
    scene: Scene,
    channel: int,
    disc: int,
    left: tuple[float, float, float],
    up: tuple[float, float, float],
    way: tuple[float, float, float],
    cutoff: float,
    glass: float,
) -> float:
    """As `casting.blocked`."""
    points, hidden, things = scene.robot.points, scene.robot.hidden, scene.things
    first, last = (0, scene.robot.n_few) if disc == FEW else (scene.robot.n_few, len(points))
    at_x, at_y, at_z = position(scene, channel)
    hits = 0
    for point in range(first, last):
        z = points[point, 0] * left[2] + points[point, 1] * up[2] + way[2]
        hidden[point] = z < 0 and -at_z / z < glass  # by the floor
        hits += hidden[point]
    # Light comes from within this of the line to the middle of the bulb.
    broad = math.sqrt(left[0] * left[0] + left[1] * left[1]) + math.sqrt(up[0] * up[0] + up[1] * up[1])
    length = math.sqrt(way[0] * way[0] + way[1] * way[1])
    for thing in range(len(things)):
        if _beside(things, thing, at_x, at_y, way[0], way[1], length, broad):
            continue
        for point in range(first, last):
            if hidden[point]:
                continue
            across, upward = points[point, 0], points[point, 1]
            x = across * left[0] + upward * up[0] + way[0]
            y = across * left[1] + upward * up[1] + way[1]
            z = across * left[2] + upward * up[2] + way[2]
            if _stops(things, thing, at_x, at_y, at_z, x, y, z, glass):
                hidden[point] = 1
                hits += 1
        if hits == last - first:
            break
    return hits / (last - first)


def _beside(
    things: Any,
    thing: int,
    x: float,
    y: float,
    way_x: float,
    way_y: float,
    length: float,
    broad: float,
) -> bool:
    """Whether a thing surely is beside, behind or beyond a way of some length and half a breadth [m]."""
    dx, dy = things[thing, CENTRE_X] - x, things[thing, CENTRE_Y] - y
    half, width = things[thing, LENGTH], things[thing, WIDTH]
    if width < 0:
        size = (half + broad) * length
        side = size
    else:
        c, s = things[thing, COSINE], things[thing, SINE]
        along, across = abs(way_x * c + way_y * s), abs(way_y * c - way_x * s)
        side = half * across + width * along + broad * length
        size = half * along + width * across + broad * length
    ahead = dx * way_x + dy * way_y
    return abs(dx * way_y - dy * way_x) > side or ahead < -size or ahead - size > length * (length + broad)


def _stops(
    things: Any,
    thing: int,
    x: float,
    y: float,
    z: float,
    way_x: float,
    way_y: float,
    way_z: float,
    glass: float,
) -> bool:
    """Whether a thing stops light on a way [m] before a part of it."""
    flat = way_x * way_x + way_y * way_y
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    if width < 0:
        towards, outside = dx * way_x + dy * way_y, dx * dx + dy * dy - length * length
        square = towards * towards - flat * outside
        if square < 0 or flat == 0:
            return False
        root = math.sqrt(square)
        first, last = (-towards - root) / flat, (-towards + root) / flat
    else:
        c, s = things[thing, COSINE], things[thing, SINE]
        along, across = dx * c + dy * s, dy * c - dx * s
        ray_along, ray_across = way_x * c + way_y * s, way_y * c - way_x * s
        first, last = _crossing(along, ray_along, -length, length)
        one, other = _crossing(across, ray_across, -width, width)
        first, last = max(first, one), min(last, other)
    if first > last or last < 0 or first >= glass:
        return False
    one, other = _crossing(z, way_z, things[thing, BOTTOM], things[thing, TOP])
    first, last = max(first, one), min(last, other)
    return first <= last and last >= 0 and (first if first >= 0 else last) < glass


def _crossing(at: float, way: float, low: float, high: float) -> tuple[float, float]:
    """Parts of a way at which it goes in and out between two planes; out before in for never."""
    if way == 0:
        return (-math.inf, math.inf) if low <= at <= high else (math.inf, -math.inf)
    one, other = (low - at) / way, (high - at) / way
    return min(one, other), max(one, other)
