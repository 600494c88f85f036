"""Occlusion of a lamp from a sensor in a plane, by upright obstacles with heights and by the floor."""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar.plane import (
    BOTTOM,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    LENGTH,
    SINE,
    TOP,
    WIDTH,
    Plane,
)
from khep_twin.sensing.buffers import Matrix

Vector = tuple[float, float, float]


@compilable
def stopped(plane: Plane, position: Vector, ray_direction: Vector, glass: float) -> bool:
    """Return whether anything stops light on a path from a point [m] before the fraction `glass` of it."""
    (at_x, at_y, at_z), (x, y, z) = position, ray_direction
    if z < 0 and -at_z / z < glass:
        return True
    length = math.sqrt(x * x + y * y)
    for thing in range(len(plane.things)):
        if _beside(plane.things, thing, at_x, at_y, x, y, length, 0.0):
            continue
        if _stops(plane.things, thing, at_x, at_y, at_z, x, y, z, glass):
            return True
    return False


@compilable
def blocked(
    plane: Plane,
    position: Vector,
    first: int,
    last: int,
    left: Vector,
    up: Vector,
    ray_direction: Vector,
    glass: float,
) -> float:
    """Return the fraction of some of a bulb's points that is hidden from a point.

    Args:
        plane: Plane with these points.
        position: Position of the sensor [m].
        first: Index of the first point.
        last: Index behind the last point.
        left: Vector from the bulb's middle to its left edge, as seen from there [m].
        up: Vector from the bulb's middle to its upper edge, as seen from there [m].
        ray_direction: Vector to the bulb's middle [m].
        glass: Fraction of the path at which the bulb begins.
    """
    points, hidden, things = plane.robot.points, plane.robot.hidden, plane.things
    at_x, at_y, at_z = position
    hits = 0
    for point in range(first, last):
        z = points[point, 0] * left[2] + points[point, 1] * up[2] + ray_direction[2]
        hidden[point] = z < 0 and -at_z / z < glass  # by the floor
        hits += hidden[point]
    # Largest distance of the light from the line to the bulb's middle.
    broad = math.sqrt(left[0] * left[0] + left[1] * left[1]) + math.sqrt(up[0] * up[0] + up[1] * up[1])
    length = math.sqrt(ray_direction[0] * ray_direction[0] + ray_direction[1] * ray_direction[1])
    for thing in range(len(things)):
        if _beside(things, thing, at_x, at_y, ray_direction[0], ray_direction[1], length, broad):
            continue
        for point in range(first, last):
            if hidden[point]:
                continue
            across, upward = points[point, 0], points[point, 1]
            x = across * left[0] + upward * up[0] + ray_direction[0]
            y = across * left[1] + upward * up[1] + ray_direction[1]
            z = across * left[2] + upward * up[2] + ray_direction[2]
            if _stops(things, thing, at_x, at_y, at_z, x, y, z, glass):
                hidden[point] = 1
                hits += 1
        if hits == last - first:
            break
    return hits / (last - first)


@compilable
def _beside(
    things: Matrix, thing: int, x: float, y: float, way_x: float, way_y: float, length: float, broad: float
) -> bool:
    """Return True if an obstacle is surely beside, behind or beyond a path of a length and half width [m]."""
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


@compilable
def _stops(
    things: Matrix,
    thing: int,
    x: float,
    y: float,
    z: float,
    way_x: float,
    way_y: float,
    way_z: float,
    glass: float,
) -> bool:
    """Return whether an obstacle stops light on a path [m] before the fraction `glass` of it."""
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


@compilable
def _crossing(at: float, ray_direction: float, low: float, high: float) -> tuple[float, float]:
    """Return the fractions of a path at entry and exit between two planes; exit before entry for never."""
    if ray_direction == 0:
        return (-math.inf, math.inf) if low <= at <= high else (math.inf, -math.inf)
    one, other = (low - at) / ray_direction, (high - at) / ray_direction
    return min(one, other), max(one, other)
