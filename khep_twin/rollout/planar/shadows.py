"""What hides a lamp from a sensor in a plane: upright things with their heights, and the floor."""

import math
from typing import Any

from khep_twin.rollout.planar.plane import (
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

Vector = tuple[float, float, float]


def stopped(plane: Plane, place: Vector, way: Vector, glass: float) -> bool:
    """Whether anything stops light on a way from a place [m] before a part of it."""
    (at_x, at_y, at_z), (x, y, z) = place, way
    if z < 0 and -at_z / z < glass:
        return True
    length = math.sqrt(x * x + y * y)
    for thing in range(len(plane.things)):
        if _beside(plane.things, thing, at_x, at_y, x, y, length, 0.0):
            continue
        if _stops(plane.things, thing, at_x, at_y, at_z, x, y, z, glass):
            return True
    return False


def blocked(
    plane: Plane,
    place: Vector,
    first: int,
    last: int,
    left: Vector,
    up: Vector,
    way: Vector,
    glass: float,
) -> float:
    """Which part of some of a bulb's points is hidden from a place.

    Args:
        plane: with these points.
        place: of the sensor [m].
        first: of these points.
        last: the one behind them.
        left: from the middle of the bulb to its edge, as seen from there [m].
        up: likewise.
        way: to its middle [m].
        glass: part of the way at which the bulb begins.
    """
    points, hidden, things = plane.robot.points, plane.robot.hidden, plane.things
    at_x, at_y, at_z = place
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
