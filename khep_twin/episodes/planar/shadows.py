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
def stopped(plane: Plane, position: Vector, ray: Vector, glass: float) -> bool:
    """Return whether light on a path from a point [m] is blocked before the fraction `glass` of it."""
    (start_x, start_y, start_z), (x, y, z) = position, ray
    if z < 0 and -start_z / z < glass:
        return True
    length = math.sqrt(x * x + y * y)
    for obstacle in range(len(plane.obstacles)):
        if _is_clear(plane, obstacle, start_x, start_y, x, y, length, 0.0):
            continue
        if _stops(plane.obstacles, obstacle, start_x, start_y, start_z, x, y, z, glass):
            return True
    return False


@compilable
def blocked(
    plane: Plane, position: Vector, first: int, last: int, left: Vector, up: Vector, ray: Vector, glass: float
) -> float:
    """Return the fraction of a range of a bulb's points that is hidden from a position.

    Args:
        plane: Plane with these points.
        position: Position of the sensor [m].
        first: Index of the first point.
        last: Index behind the last point.
        left: Vector from the bulb's centre to its left edge, as seen from the sensor [m].
        up: Vector from the bulb's centre to its upper edge, as seen from the sensor [m].
        ray: Vector to the bulb's centre [m].
        glass: Fraction of the path at which the bulb starts.
    """
    points, hidden, obstacles = plane.robot.points, plane.robot.hidden, plane.obstacles
    start_x, start_y, start_z = position
    hits = 0
    for point in range(first, last):
        z = points[point, 0] * left[2] + points[point, 1] * up[2] + ray[2]
        hidden[point] = z < 0 and -start_z / z < glass  # by the floor
        hits += hidden[point]
    # Largest distance of a ray from the line to the bulb's centre.
    half_width = math.sqrt(left[0] * left[0] + left[1] * left[1]) + math.sqrt(up[0] * up[0] + up[1] * up[1])
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
    for obstacle in range(len(obstacles)):
        if _is_clear(plane, obstacle, start_x, start_y, ray[0], ray[1], length, half_width):
            continue
        for point in range(first, last):
            if hidden[point]:
                continue
            across, upward = points[point, 0], points[point, 1]
            x = across * left[0] + upward * up[0] + ray[0]
            y = across * left[1] + upward * up[1] + ray[1]
            z = across * left[2] + upward * up[2] + ray[2]
            if _stops(obstacles, obstacle, start_x, start_y, start_z, x, y, z, glass):
                hidden[point] = 1
                hits += 1
        if hits == last - first:
            break
    return hits / (last - first)


@compilable
def _is_clear(
    plane: Plane, obstacle: int, x: float, y: float, ray_x: float, ray_y: float, length: float, radius: float
) -> bool:
    """Return True if an obstacle is certainly outside a path of a length and radius [m]."""
    obstacles = plane.obstacles
    dx, dy = obstacles[obstacle, CENTRE_X] - x, obstacles[obstacle, CENTRE_Y] - y
    half_length, width = obstacles[obstacle, LENGTH], obstacles[obstacle, WIDTH]
    if width < 0:
        size = (half_length + radius) * length
        side = size
    else:
        c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
        along, across = abs(ray_x * c + ray_y * s), abs(ray_y * c - ray_x * s)
        side = half_length * across + width * along + radius * length
        size = half_length * along + width * across + radius * length
    path = dx * ray_x + dy * ray_y
    return abs(dx * ray_y - dy * ray_x) > side or path < -size or path - size > length * (length + radius)


@compilable
def _stops(
    obstacles: Matrix,
    obstacle: int,
    x: float,
    y: float,
    z: float,
    ray_x: float,
    ray_y: float,
    ray_z: float,
    glass: float,
) -> bool:
    """Return whether an obstacle blocks light on a path [m] before the fraction `glass` of it."""
    ray_square = ray_x * ray_x + ray_y * ray_y
    length, width = obstacles[obstacle, LENGTH], obstacles[obstacle, WIDTH]
    dx, dy = x - obstacles[obstacle, CENTRE_X], y - obstacles[obstacle, CENTRE_Y]
    if width < 0:
        towards, excess = dx * ray_x + dy * ray_y, dx * dx + dy * dy - length * length
        square = towards * towards - ray_square * excess
        if square < 0 or ray_square == 0:
            return False
        half_chord = math.sqrt(square)
        first, last = (-towards - half_chord) / ray_square, (-towards + half_chord) / ray_square
    else:
        c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
        along, across = dx * c + dy * s, dy * c - dx * s
        ray_along, ray_across = ray_x * c + ray_y * s, ray_y * c - ray_x * s
        first, last = _crossing(along, ray_along, -length, length)
        one, other = _crossing(across, ray_across, -width, width)
        first, last = max(first, one), min(last, other)
    if first > last or last < 0 or first >= glass:
        return False
    one, other = _crossing(z, ray_z, obstacles[obstacle, BOTTOM], obstacles[obstacle, TOP])
    first, last = max(first, one), min(last, other)
    return first <= last and last >= 0 and (first if first >= 0 else last) < glass


@compilable
def _crossing(start: float, direction: float, low: float, high: float) -> tuple[float, float]:
    """Return the fractions of a path at entry and exit between two planes; exit < entry if it misses."""
    if direction == 0:
        return (-math.inf, math.inf) if low <= start <= high else (math.inf, -math.inf)
    low_fraction, high_fraction = (low - start) / direction, (high - start) / direction
    return min(low_fraction, high_fraction), max(low_fraction, high_fraction)
