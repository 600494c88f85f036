"""Rays in a plane: to a lamp, which upright obstacles and the floor may hide, and to upright obstacles."""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar.plane import (
    BOTTOM,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    HALF_LENGTH,
    HALF_WIDTH,
    SINE,
    TOP,
    Plane,
)
from khep_twin.sensing.buffers import Matrix

Vector = tuple[float, float, float]


@compilable
def is_path_blocked(plane: Plane, position: Vector, ray: Vector, glass: float) -> bool:
    """Return whether a ray from a position [m] is blocked before the fraction `glass` of its length."""
    (start_x, start_y, start_z), (x, y, z) = position, ray
    if z < 0 and -start_z / z < glass:
        return True
    length = math.sqrt(x * x + y * y)
    for obstacle in range(len(plane.obstacles)):
        if _is_outside_path(plane, obstacle, start_x, start_y, x, y, length, 0.0):
            continue
        if _blocks_path(plane.obstacles, obstacle, start_x, start_y, start_z, x, y, z, glass):
            return True
    return False


@compilable
def hidden_fraction(
    plane: Plane, position: Vector, start: int, stop: int, left: Vector, up: Vector, ray: Vector, glass: float
) -> float:
    """Return the fraction of a bulb's points `start` to `stop` that is hidden from a position.

    Args:
        plane: Plane, whose robot has the points.
        position: Position of the sensor [m].
        start: Index of the first point.
        stop: Index behind the last point.
        left: Vector from the bulb's centre to its left edge, as seen from the sensor [m].
        up: Vector from the bulb's centre to its upper edge, as seen from the sensor [m].
        ray: Vector to the bulb's centre [m].
        glass: Fraction of the path at which the bulb starts.
    """
    points, hidden, obstacles = plane.robot.points, plane.robot.hidden, plane.obstacles
    start_x, start_y, start_z = position
    hits = 0
    for point in range(start, stop):
        z = points[point, 0] * left[2] + points[point, 1] * up[2] + ray[2]
        hidden[point] = z < 0 and -start_z / z < glass  # by the floor
        hits += hidden[point]
    # Largest distance of a ray from the line to the bulb's centre.
    half_width = math.sqrt(left[0] * left[0] + left[1] * left[1]) + math.sqrt(up[0] * up[0] + up[1] * up[1])
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
    for obstacle in range(len(obstacles)):
        if _is_outside_path(plane, obstacle, start_x, start_y, ray[0], ray[1], length, half_width):
            continue
        for point in range(start, stop):
            if hidden[point]:
                continue
            across, upward = points[point, 0], points[point, 1]
            x = across * left[0] + upward * up[0] + ray[0]
            y = across * left[1] + upward * up[1] + ray[1]
            z = across * left[2] + upward * up[2] + ray[2]
            if _blocks_path(obstacles, obstacle, start_x, start_y, start_z, x, y, z, glass):
                hidden[point] = 1
                hits += 1
        if hits == stop - start:
            break
    return hits / (stop - start)


@compilable
def _is_outside_path(
    plane: Plane, obstacle: int, x: float, y: float, ray_x: float, ray_y: float, length: float, radius: float
) -> bool:
    """Return True if an obstacle is certainly outside a ray from (x, y) with a length and a radius [m]."""
    obstacles = plane.obstacles  # side, reach and dot are distances times the length of the ray [m^2]
    dx, dy = obstacles[obstacle, CENTRE_X] - x, obstacles[obstacle, CENTRE_Y] - y
    half_length, half_width = obstacles[obstacle, HALF_LENGTH], obstacles[obstacle, HALF_WIDTH]
    if half_width < 0:
        reach = (half_length + radius) * length
        side = reach
    else:
        c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
        along, across = abs(ray_x * c + ray_y * s), abs(ray_y * c - ray_x * s)
        side = half_length * across + half_width * along + radius * length
        reach = half_length * along + half_width * across + radius * length
    dot = dx * ray_x + dy * ray_y
    return abs(dx * ray_y - dy * ray_x) > side or dot < -reach or dot - reach > length * (length + radius)


@compilable
def _blocks_path(
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
    """Return whether an obstacle blocks a ray from (x, y, z) [m] before the fraction `glass` of the ray."""
    ray_square = ray_x * ray_x + ray_y * ray_y
    half_length, half_width = obstacles[obstacle, HALF_LENGTH], obstacles[obstacle, HALF_WIDTH]
    dx, dy = x - obstacles[obstacle, CENTRE_X], y - obstacles[obstacle, CENTRE_Y]
    if half_width < 0:
        towards, square_gap = dx * ray_x + dy * ray_y, dx * dx + dy * dy - half_length * half_length
        discriminant = towards * towards - ray_square * square_gap
        if discriminant < 0 or ray_square == 0:
            return False
        half_chord = math.sqrt(discriminant)
        entry, leave = (-towards - half_chord) / ray_square, (-towards + half_chord) / ray_square
    else:
        c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
        along, across = dx * c + dy * s, dy * c - dx * s
        ray_along, ray_across = ray_x * c + ray_y * s, ray_y * c - ray_x * s
        entry, leave = _slab_fractions(along, ray_along, -half_length, half_length)
        slab_entry, slab_leave = _slab_fractions(across, ray_across, -half_width, half_width)
        entry, leave = max(entry, slab_entry), min(leave, slab_leave)
    if entry > leave or leave < 0 or entry >= glass:
        return False
    slab_entry, slab_leave = _slab_fractions(z, ray_z, obstacles[obstacle, BOTTOM], obstacles[obstacle, TOP])
    entry, leave = max(entry, slab_entry), min(leave, slab_leave)
    return entry <= leave and leave >= 0 and (entry if entry >= 0 else leave) < glass


@compilable
def entry_of(
    obstacles: Matrix, obstacle: int, start: Vector, ray: Vector
) -> tuple[float, float, float, float]:
    """Return the fraction of a ray at which it enters an obstacle, and the normal there; below 0 for none."""
    half_length, half_width = obstacles[obstacle, HALF_LENGTH], obstacles[obstacle, HALF_WIDTH]
    dx, dy = start[0] - obstacles[obstacle, CENTRE_X], start[1] - obstacles[obstacle, CENTRE_Y]
    normal_x = normal_y = normal_z = 0.0
    if half_width < 0:
        square = ray[0] * ray[0] + ray[1] * ray[1]
        towards, square_gap = dx * ray[0] + dy * ray[1], dx * dx + dy * dy - half_length * half_length
        discriminant = towards * towards - square * square_gap
        if discriminant < 0 or square == 0:
            return -1.0, 0.0, 0.0, 0.0
        half_chord = math.sqrt(discriminant)
        entry, leave = (-towards - half_chord) / square, (-towards + half_chord) / square
        normal_x, normal_y = (dx + entry * ray[0]) / half_length, (dy + entry * ray[1]) / half_length
    else:
        c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
        ray_along, ray_across = ray[0] * c + ray[1] * s, ray[1] * c - ray[0] * s
        entry, leave = _slab_fractions(dx * c + dy * s, ray_along, -half_length, half_length)
        sign = -math.copysign(1.0, ray_along)
        normal_x, normal_y = sign * c, sign * s
        slab_entry, slab_leave = _slab_fractions(dy * c - dx * s, ray_across, -half_width, half_width)
        leave = min(leave, slab_leave)
        if slab_entry > entry:
            entry, sign = slab_entry, -math.copysign(1.0, ray_across)
            normal_x, normal_y = -sign * s, sign * c
    bottom, top = obstacles[obstacle, BOTTOM], obstacles[obstacle, TOP]
    slab_entry, slab_leave = _slab_fractions(start[2], ray[2], bottom, top)
    if slab_entry > entry:
        entry, normal_x, normal_y, normal_z = slab_entry, 0.0, 0.0, -math.copysign(1.0, ray[2])
    if entry > min(leave, slab_leave):
        return -1.0, 0.0, 0.0, 0.0
    return entry, normal_x, normal_y, normal_z


@compilable
def _slab_fractions(start: float, direction: float, low: float, high: float) -> tuple[float, float]:
    """Return the fractions of a ray where it enters and leaves a slab; the second is smaller if it misses."""
    if direction == 0:
        return (-math.inf, math.inf) if low <= start <= high else (math.inf, -math.inf)
    low_fraction, high_fraction = (low - start) / direction, (high - start) / direction
    return min(low_fraction, high_fraction), max(low_fraction, high_fraction)
