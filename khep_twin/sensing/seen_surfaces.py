"""Surfaces that an infrared sensor may see: faces and cylinders around its chip, as `reflection` takes them.

Positions are those in a sensor's frame: x along its axis, y to its left [m], its chip at the origin.
A surface whose nearest point is beyond a sensor's range is left out; in the last quarter of the range its
light fades.
"""

import math
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector

DISTANCE, COSINE, SINE, RADIUS, LOW, HIGH, TOP, BOTTOM, REFLECTANCE, SQUARE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Columns of a surface. A face has its distance from the origin [m], the direction of its foot, and a radius
of 0; a cylinder the distance and direction of its axis. Both have the sines of the azimuths between which
they lie, the heights of top and bottom above the sensor [m], their reflectance, less what fades, and the
square of their nearest distance [m^2]."""
N_COLUMNS = 10

N_SURFACES = 48
"""Largest number of surfaces that a sensor takes into account; of more, it takes the nearest."""

_TOUCHING = 1e-4
"""Smallest distance of a surface, for a sensor within a thing [m]."""

NARROW = 1e-9
"""Width of an arc that is too small to matter [sine of the azimuth]."""

Upright = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]
"""Upright box or cylinder: centre [m], cosine and sine of its angle, half of its length and width [m], or its
radius and a number below 0 for a cylinder, and the heights of bottom and top [m]."""


class Chip(NamedTuple):
    """Place of a sensor's chip, and how far it sees.

    Attributes:
        x: Position in the world [m].
        y: The same, y.
        ahead: Cosine of the direction of its axis.
        left: Sine of that direction.
        height: Height above the floor [m].
        reach: Range [m].
    """

    x: float
    y: float
    ahead: float
    left: float
    height: float
    reach: float


@compilable
def add_upright(
    found: Vector[float],
    count: int,
    chip: Chip,
    shape: Upright,
    reflectance: float,
) -> int:
    """Add what a sensor may see of an upright box or cylinder; return the number of surfaces.

    Args:
        found: Surfaces (N_SURFACES * N_COLUMNS,).
        count: Number of surfaces in it.
        chip: Chip of the sensor.
        shape: Shape in the world.
        reflectance: Infrared reflectance.
    """
    if shape[2][1] < 0:
        return _add_cylinder(found, count, chip, shape, reflectance)
    return _add_box(found, count, chip, shape, reflectance)


@compilable
def _add_box(
    found: Vector[float],
    count: int,
    chip: Chip,
    shape: Upright,
    reflectance: float,
) -> int:
    """Add the faces of a box that a sensor sees."""
    centre, turn, half, span = shape
    dx, dy = chip.x - centre[0], chip.y - centre[1]
    c, s = turn
    # Cosine and sine of the length's direction in the sensor's frame.
    cosine, sine = c * chip.ahead + s * chip.left, s * chip.ahead - c * chip.left
    if dx * chip.ahead + dy * chip.left >= abs(cosine) * half[0] + abs(sine) * half[1]:
        return count  # behind the sensor
    along, across = dx * c + dy * s, dy * c - dx * s
    beyond, beside = abs(along) - half[0], abs(across) - half[1]
    ahead, aside = max(beyond, 0.0), max(beside, 0.0)
    if ahead * ahead + aside * aside > chip.reach * chip.reach:
        return count
    if beyond <= 0 and beside <= 0:
        return _add_around(found, count, chip, span, reflectance)
    if beyond > 0:
        # Towards the face, against its normal; its edges lie at both sides of the foot.
        sign = math.copysign(1.0, along)
        edges = sign * across - half[1], sign * across + half[1]
        count = _add_face(
            found, count, chip, (beyond, -sign * cosine, -sign * sine), edges, span, reflectance
        )
    if beside > 0:
        sign = math.copysign(1.0, across)
        edges = -sign * along - half[0], -sign * along + half[0]
        count = _add_face(found, count, chip, (beside, sign * sine, -sign * cosine), edges, span, reflectance)
    return count


@compilable
def _add_face(
    found: Vector[float],
    count: int,
    chip: Chip,
    foot: tuple[float, float, float],
    edges: tuple[float, float],
    span: tuple[float, float],
    reflectance: float,
) -> int:
    """Add a face by distance and direction of its foot, and its edges from right to left of it [m]."""
    distance, c, s = foot
    right, left = edges
    beside = max(right, -left, 0.0)
    square = max(distance * distance + beside * beside, _TOUCHING * _TOUCHING)
    strength = reflectance * _fading(square, chip.reach)
    right_x, right_y = distance * c - right * s, distance * s + right * c
    left_x, left_y = distance * c - left * s, distance * s + left * c
    if strength <= 0 or (right_x <= 0 and left_x <= 0):
        return count
    top = span[1] - chip.height
    low, high = -1.0, 1.0
    if right_x > 0:
        low = right_y / math.sqrt(right_x * right_x + right_y * right_y)
    if left_x > 0:
        high = left_y / math.sqrt(left_x * left_x + left_y * left_y)
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + LOW] <= low and found[first + HIGH] >= high and _covers(found, first, top):
            c1, s1, away = found[first + COSINE], found[first + SINE], found[first + DISTANCE]
            if right_x * c1 + right_y * s1 >= away and left_x * c1 + left_y * s1 >= away:
                return count
    return _add(found, count, (distance, c, s, 0.0, low, high, square), chip.height, span, strength)


@compilable
def _add_cylinder(
    found: Vector[float],
    count: int,
    chip: Chip,
    shape: Upright,
    reflectance: float,
) -> int:
    """Add a cylinder."""
    centre, _, (radius, _), span = shape
    dx, dy = centre[0] - chip.x, centre[1] - chip.y
    distance = math.sqrt(dx * dx + dy * dy)
    away = max(distance - radius, _TOUCHING)
    square = away * away
    strength = reflectance * _fading(square, chip.reach)
    if strength <= 0:
        return count
    if distance <= radius:
        return _add_around(found, count, chip, span, reflectance)
    c, s = (dx * chip.ahead + dy * chip.left) / distance, (dy * chip.ahead - dx * chip.left) / distance
    sine = radius / distance
    cosine = math.sqrt(1 - sine * sine)
    # Tangents to the right and to the left; the lobe ends at both sides.
    top = span[1] - chip.height
    right_x, right_y = c * cosine + s * sine, s * cosine - c * sine
    left_x, left_y = c * cosine - s * sine, s * cosine + c * sine
    if right_x <= 0 and left_x <= 0 and c <= 0:
        return count
    low, high = (right_y if right_x > 0 else -1.0), (left_y if left_x > 0 else 1.0)
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + LOW] <= low and found[first + HIGH] >= high and _covers(found, first, top):
            ahead = distance * (c * found[first + COSINE] + s * found[first + SINE])
            if ahead - radius >= found[first + DISTANCE]:
                return count
    return _add(found, count, (distance, c, s, radius, low, high, square), chip.height, span, strength)


@compilable
def _fading(square: float, reach: float) -> float:
    """Return the part of its light that counts of a surface, by the square of its distance [m^2]."""
    if square <= 9 / 16 * reach * reach:
        return 1.0
    return max(4 * (1 - math.sqrt(square) / reach), 0.0)


@compilable
def _covers(found: Vector[float], first: int, top: float) -> bool:
    """Return whether nothing of a thing is seen over a nearer face: its top is not higher [m]."""
    return found[first + RADIUS] == 0 and found[first + BOTTOM] <= 0 and found[first + TOP] >= max(top, 0.0)


@compilable
def _add_around(
    found: Vector[float], count: int, chip: Chip, span: tuple[float, float], reflectance: float
) -> int:
    """Add what a sensor lies within, possible only by rounding or where it was put there."""
    if span[0] > chip.height or span[1] < chip.height:
        return count
    return _add(
        found,
        count,
        (_TOUCHING, 1.0, 0.0, 0.0, -1.0, 1.0, _TOUCHING * _TOUCHING),
        chip.height,
        span,
        reflectance,
    )


@compilable
def _add(
    found: Vector[float],
    count: int,
    shape: tuple[float, float, float, float, float, float, float],
    height: float,
    span: tuple[float, float],
    reflectance: float,
) -> int:
    """Add a surface; where there are too many, the nearest ones are kept."""
    distance, c, s, radius, low, high, square = shape
    if high - low <= NARROW:
        return count
    first = count * N_COLUMNS
    if count == N_SURFACES:
        first = _farthest(found)
        if found[first + SQUARE] <= square:
            return count
        count -= 1
    found[first + DISTANCE], found[first + RADIUS] = max(distance, _TOUCHING), radius
    found[first + COSINE], found[first + SINE] = c, s
    found[first + LOW], found[first + HIGH] = low, high
    found[first + BOTTOM], found[first + TOP] = span[0] - height, span[1] - height
    found[first + REFLECTANCE], found[first + SQUARE] = reflectance, square
    return count + 1


@compilable
def _farthest(found: Vector[float]) -> int:
    """Return the index of the farthest surface of a full list."""
    index = 0
    for first in range(0, N_SURFACES * N_COLUMNS, N_COLUMNS):
        if found[first + SQUARE] > found[index + SQUARE]:
            index = first
    return index
