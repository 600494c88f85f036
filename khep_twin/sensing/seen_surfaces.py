"""Surfaces in range of an infrared sensor: faces and cylinders around its chip, for `reflection`.

Positions are in the sensor's frame: x along its axis, y to its left [m], with the chip at the origin.
Surfaces beyond the sensor's range are omitted; in the last quarter of the range their light fades to 0.
"""

import math
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector

DISTANCE, COSINE, SINE, RADIUS, LOW, HIGH, TOP, BOTTOM, REFLECTANCE, SQUARE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Columns of a surface. A face has the distance [m] and the direction of its foot, the point of its plane
nearest to the origin, and radius 0; a cylinder the distance and direction of its axis. Both have the sines
of their smallest and largest azimuth, the heights of top and bottom above the sensor [m], their reflectance
times the fading, and the square of their smallest distance [m^2]."""
N_COLUMNS = 10

N_SURFACES = 48
"""Largest number of surfaces of a sensor; the nearest ones are kept."""

_MIN_DISTANCE = 1e-4
"""Smallest distance of a surface, for a sensor inside an object [m]."""

MIN_ARC = 1e-9
"""Width below which an arc is ignored [sine of the azimuth]."""

Upright = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]
"""Upright box or cylinder: centre [m]; cosine and sine of its angle; half its length and width [m], or radius
and a negative number for a cylinder; heights of bottom and top [m]."""


class Chip(NamedTuple):
    """Pose of a sensor's chip, and its range.

    Attributes:
        x: x in the world [m].
        y: y in the world [m].
        cosine: Cosine of the direction of its axis.
        sine: Sine of that direction.
        height: Height above the floor [m].
        reach: Range [m].
    """

    x: float
    y: float
    cosine: float
    sine: float
    height: float
    reach: float


@compilable
def add_upright(surfaces: Vector[float], count: int, chip: Chip, shape: Upright, reflectance: float) -> int:
    """Add the visible surfaces of an upright box or cylinder; return the number of surfaces.

    Args:
        surfaces: Surfaces, changed in place (N_SURFACES * N_COLUMNS,).
        count: Number of surfaces so far.
        chip: Chip of the sensor.
        shape: Shape in the world.
        reflectance: Infrared reflectance.
    """
    if shape[2][1] < 0:
        return _add_cylinder(surfaces, count, chip, shape, reflectance)
    return _add_box(surfaces, count, chip, shape, reflectance)


@compilable
def _add_box(surfaces: Vector[float], count: int, chip: Chip, shape: Upright, reflectance: float) -> int:
    """Add the visible faces of a box."""
    centre, direction, half_sizes, span = shape
    dx, dy = chip.x - centre[0], chip.y - centre[1]
    c, s = direction
    # Cosine and sine of the length's direction in the sensor's frame.
    cosine, sine = c * chip.cosine + s * chip.sine, s * chip.cosine - c * chip.sine
    if dx * chip.cosine + dy * chip.sine >= abs(cosine) * half_sizes[0] + abs(sine) * half_sizes[1]:
        return count  # behind the sensor
    along, across = dx * c + dy * s, dy * c - dx * s
    beyond_length, beyond_width = abs(along) - half_sizes[0], abs(across) - half_sizes[1]
    gap_along, gap_across = max(beyond_length, 0.0), max(beyond_width, 0.0)
    if gap_along * gap_along + gap_across * gap_across > chip.reach * chip.reach:
        return count
    if beyond_length <= 0 and beyond_width <= 0:
        return _add_enclosing(surfaces, count, chip, span, reflectance)
    if beyond_length > 0:
        # The foot's direction is opposite to the normal; the edges lie on both sides of the foot.
        sign = math.copysign(1.0, along)
        edges = sign * across - half_sizes[1], sign * across + half_sizes[1]
        count = _add_face(
            surfaces, count, chip, (beyond_length, -sign * cosine, -sign * sine), edges, span, reflectance
        )
    if beyond_width > 0:
        sign = math.copysign(1.0, across)
        edges = -sign * along - half_sizes[0], -sign * along + half_sizes[0]
        count = _add_face(
            surfaces, count, chip, (beyond_width, sign * sine, -sign * cosine), edges, span, reflectance
        )
    return count


@compilable
def _add_face(
    surfaces: Vector[float],
    count: int,
    chip: Chip,
    foot: tuple[float, float, float],
    edges: tuple[float, float],
    span: tuple[float, float],
    reflectance: float,
) -> int:
    """Add a face by distance and direction of its foot, and its right and left edge from the foot [m]."""
    distance, c, s = foot
    right_edge, left_edge = edges
    lateral = max(right_edge, -left_edge, 0.0)
    square = max(distance * distance + lateral * lateral, _MIN_DISTANCE * _MIN_DISTANCE)
    strength = reflectance * _fade_factor(square, chip.reach)
    right_x, right_y = distance * c - right_edge * s, distance * s + right_edge * c
    left_x, left_y = distance * c - left_edge * s, distance * s + left_edge * c
    if strength <= 0 or (right_x <= 0 and left_x <= 0):
        return count
    top = span[1] - chip.height
    low, high = -1.0, 1.0
    if right_x > 0:
        low = right_y / math.sqrt(right_x * right_x + right_y * right_y)
    if left_x > 0:
        high = left_y / math.sqrt(left_x * left_x + left_y * left_y)
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + LOW] <= low and surfaces[row + HIGH] >= high and _is_covered(surfaces, row, top):
            c1, s1, d1 = surfaces[row + COSINE], surfaces[row + SINE], surfaces[row + DISTANCE]
            if right_x * c1 + right_y * s1 >= d1 and left_x * c1 + left_y * s1 >= d1:
                return count
    return _add_surface(
        surfaces, count, (distance, c, s, 0.0, low, high, square), chip.height, span, strength
    )


@compilable
def _add_cylinder(surfaces: Vector[float], count: int, chip: Chip, shape: Upright, reflectance: float) -> int:
    """Add a cylinder."""
    centre, _, (radius, _), span = shape
    dx, dy = centre[0] - chip.x, centre[1] - chip.y
    distance = math.sqrt(dx * dx + dy * dy)
    gap = max(distance - radius, _MIN_DISTANCE)
    square = gap * gap
    strength = reflectance * _fade_factor(square, chip.reach)
    if strength <= 0:
        return count
    if distance <= radius:
        return _add_enclosing(surfaces, count, chip, span, reflectance)
    c, s = (dx * chip.cosine + dy * chip.sine) / distance, (dy * chip.cosine - dx * chip.sine) / distance
    sine = radius / distance
    cosine = math.sqrt(1 - sine * sine)
    # Right and left tangents; the lobe ends at an azimuth of 90 degrees on both sides.
    top = span[1] - chip.height
    right_x, right_y = c * cosine + s * sine, s * cosine - c * sine
    left_x, left_y = c * cosine - s * sine, s * cosine + c * sine
    if right_x <= 0 and left_x <= 0 and c <= 0:
        return count
    low, high = (right_y if right_x > 0 else -1.0), (left_y if left_x > 0 else 1.0)
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + LOW] <= low and surfaces[row + HIGH] >= high and _is_covered(surfaces, row, top):
            projection = distance * (c * surfaces[row + COSINE] + s * surfaces[row + SINE])
            if projection - radius >= surfaces[row + DISTANCE]:
                return count
    return _add_surface(
        surfaces, count, (distance, c, s, radius, low, high, square), chip.height, span, strength
    )


@compilable
def _fade_factor(square: float, reach: float) -> float:
    """Return the factor by which the light of a surface fades, by the square of its distance [m^2]."""
    if square <= 9 / 16 * reach * reach:
        return 1.0
    return max(4 * (1 - math.sqrt(square) / reach), 0.0)


@compilable
def _is_covered(surfaces: Vector[float], row: int, top: float) -> bool:
    """Return whether a nearer face hides an object whose top is at this height [m]."""
    is_face = surfaces[row + RADIUS] == 0
    return is_face and surfaces[row + BOTTOM] <= 0 and surfaces[row + TOP] >= max(top, 0.0)


@compilable
def _add_enclosing(
    surfaces: Vector[float], count: int, chip: Chip, span: tuple[float, float], reflectance: float
) -> int:
    """Add the object around a sensor inside it, which happens only by rounding or after a manual move."""
    if span[0] > chip.height or span[1] < chip.height:
        return count
    return _add_surface(
        surfaces,
        count,
        (_MIN_DISTANCE, 1.0, 0.0, 0.0, -1.0, 1.0, _MIN_DISTANCE * _MIN_DISTANCE),
        chip.height,
        span,
        reflectance,
    )


@compilable
def _add_surface(
    surfaces: Vector[float],
    count: int,
    shape: tuple[float, float, float, float, float, float, float],
    height: float,
    span: tuple[float, float],
    reflectance: float,
) -> int:
    """Add a surface; of more than N_SURFACES, the nearest ones are kept."""
    distance, c, s, radius, low, high, square = shape
    if high - low <= MIN_ARC:
        return count
    row = count * N_COLUMNS
    if count == N_SURFACES:
        row = _find_farthest(surfaces)
        if surfaces[row + SQUARE] <= square:
            return count
        count -= 1
    surfaces[row + DISTANCE], surfaces[row + RADIUS] = max(distance, _MIN_DISTANCE), radius
    surfaces[row + COSINE], surfaces[row + SINE] = c, s
    surfaces[row + LOW], surfaces[row + HIGH] = low, high
    surfaces[row + BOTTOM], surfaces[row + TOP] = span[0] - height, span[1] - height
    surfaces[row + REFLECTANCE], surfaces[row + SQUARE] = reflectance, square
    return count + 1


@compilable
def _find_farthest(surfaces: Vector[float]) -> int:
    """Return the index of the farthest surface of a full list."""
    farthest = 0
    for row in range(0, N_SURFACES * N_COLUMNS, N_COLUMNS):
        if surfaces[row + SQUARE] > surfaces[farthest + SQUARE]:
            farthest = row
    return farthest
