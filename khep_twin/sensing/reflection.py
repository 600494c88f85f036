"""Infrared light that a sensor gets back from what stands around it: an integral over all that it sees.

A surface element at a distance d, seen at an angle theta off the sensor's axis and at an incidence phi, sends
back light in proportion to lobe(theta) rho cos(phi) / d^2 per solid angle (a diffuse reflector; emitter and
receiver are one point). For upright surfaces this falls into an azimuth and an elevation:

    light = 1 / N  integral over the azimuth of  lobe(theta) rho cos(phi) / d^2 F dtheta

with the horizontal distance d, the part F of the lobe in elevation that the surface fills, and N such that an
endless wall at a distance d, face to face, gives 1 / d^2. The integral is taken over each visible arc of each
surface, from edge to edge, so that light changes smoothly as things move: of faces by the tables of `lobes`,
of cylinders by quadrature.

In elevation the lobe is cos^3 (assumed), which gives F a closed form. The floor mirrors what stands on it
(assumed: so a cylinder is met best by what is fitted to a wall alone, and the other way round). What stands
behind a thing is seen over its top.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.lobes import FOOT, N_CELLS
from khep_twin.sensing.seen_surfaces import (
    BOTTOM,
    COSINE,
    DISTANCE,
    HIGH,
    LOW,
    N_COLUMNS,
    NARROW,
    RADIUS,
    REFLECTANCE,
    SINE,
    SQUARE,
    TOP,
    Chip,
)

_NODES = (
    (-0.9324695142031521, 0.1713244923791704),
    (-0.6612093864662645, 0.3607615730481386),
    (-0.2386191860831969, 0.4679139345726910),
    (0.2386191860831969, 0.4679139345726910),
    (0.6612093864662645, 0.3607615730481386),
    (0.9324695142031521, 0.1713244923791704),
)
"""Nodes and weights of Gauss and Legendre's quadrature."""


class Lobe(NamedTuple):
    """Lobe of a sensor.

    Attributes:
        whole: Whole part of its exponent.
        part: The rest of it.
        norm: Norm N.
        width: Integral of the lobe over the azimuth, over N.
        table: Cumulated light of faces, as of `lobes.tables`.
    """

    whole: int
    part: float
    norm: float
    width: float
    table: Sequence[Sequence[float]]


@compilable
def sift(found: Vector[float], count: int, lobe: Lobe, least: float) -> tuple[int, float]:
    """Remove surfaces that send back too little to matter; return how many are left, and their bound.

    The bound, above `reflected`, needs no integral and no shadows [1/m^2].

    Args:
        found: Surfaces.
        count: Number of surfaces in it.
        lobe: Lobe of the sensor.
        least: Light that does not matter [1/m^2].
    """
    total, left = 0.0, 0
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        low, high = found[first + LOW], found[first + HIGH]
        # All at its nearest distance; the integral of cos^n over an arc is at most the difference of the
        # sines of its ends, times the largest cosine to the power of n - 1.
        around = lobe.width
        if lobe.whole:
            around = min(around, (high - low) / lobe.norm)
        around /= found[first + SQUARE]
        if low > 0 or high < 0:
            edge = low if low > 0 else high
            ahead = 1 - edge * edge
            for _ in range((lobe.whole - 1) >> 1):
                around *= ahead
        if around <= least:
            continue
        # An endless wall in its place; ((1 + cos) / 2)^k is above its light, with k by the lobe.
        away = found[first + DISTANCE] - found[first + RADIUS]
        wall = 1 / (away * away)
        for _ in range(min(lobe.whole, 2) + 1 if lobe.whole else 0):
            wall *= (1 + found[first + COSINE]) / 2
        light = min(around, wall)
        if light > least:
            total += found[first + REFLECTANCE] * light
            if left < first:
                for column in range(N_COLUMNS):
                    found[left + column] = found[first + column]
            left += N_COLUMNS
    return left // N_COLUMNS, total


@compilable
def reflected(found: Vector[float], count: int, chip: Chip, lobe: Lobe) -> float:
    """Return the light from all surfaces [1/m^2].

    Args:
        found: Surfaces.
        count: Number of surfaces in it.
        chip: Chip of the sensor.
        lobe: Lobe of the sensor.
    """
    if count == 1:
        return _arc(found, 0, (found[LOW], found[HIGH]), (-math.inf, math.inf), chip, lobe)
    total, low, end = 0.0, 1.0, -1.0
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + BOTTOM] > 0:
            # What floats above the sensor, as a gripper does, hides nothing, and is taken out.
            ends = found[first + LOW], found[first + HIGH]
            total += _arc(found, first, ends, (-math.inf, math.inf), chip, lobe)
            found[first + LOW], found[first + HIGH] = math.inf, -math.inf
        low, end = min(low, found[first + LOW]), max(end, found[first + HIGH])
    while low < end - NARROW:
        # Between two edges, the same surfaces are seen one behind the other.
        high, index, highest = end, -1, -math.inf
        for first in range(0, count * N_COLUMNS, N_COLUMNS):
            if low + NARROW < found[first + LOW]:
                high = min(high, found[first + LOW])
            elif low + NARROW < found[first + HIGH]:
                high = min(high, found[first + HIGH])
                index, highest = (first if index < 0 else count * N_COLUMNS), max(highest, found[first + TOP])
        if index == count * N_COLUMNS:
            index, high = _front(found, count, low, high)
        if index >= 0:
            if highest > max(found[index + TOP], 0.0):
                total += _strip(found, count, (low, high), chip, lobe)
            else:
                total += _arc(found, index, (low, high), (-math.inf, math.inf), chip, lobe)
        low = high
    return total


@compilable
def _front(found: Vector[float], count: int, low: float, high: float) -> tuple[int, float]:
    """Return the nearest surface of several between two azimuths, and where another one crosses it."""
    margin = (high - low) / 64
    right, left = low + margin, high - margin
    first_azimuth = math.sqrt(1 - right * right), right
    last_azimuth = math.sqrt(1 - left * left), left
    first_distance = last_distance = math.inf
    first_index = last_index = -1
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + LOW] < low + NARROW and found[first + HIGH] > high - NARROW:
            distance = _distance(found, first, first_azimuth)
            if distance < first_distance:
                first_distance, first_index = distance, first
            distance = _distance(found, first, last_azimuth)
            if distance < last_distance:
                last_distance, last_index = distance, first
    if first_index == last_index:
        return first_index, high
    # Things that overlap: their surfaces cross here.
    if found[first_index + RADIUS] == 0 and found[last_index + RADIUS] == 0:
        return first_index, min(max(_meeting(found, first_index, last_index), right), left)
    while left - right > NARROW:
        middle = (left + right) / 2
        azimuth = math.sqrt(1 - middle * middle), middle
        if _distance(found, first_index, azimuth) <= _distance(found, last_index, azimuth):
            right = middle
        else:
            left = middle
    return first_index, left


@compilable
def _meeting(found: Vector[float], one: int, other: int) -> float:
    """Return the sine of the azimuth at which two faces meet."""
    near, far = found[one + DISTANCE], found[other + DISTANCE]
    x = near * found[other + SINE] - far * found[one + SINE]
    y = far * found[one + COSINE] - near * found[other + COSINE]
    return math.copysign(y, x * y) / math.sqrt(max(x * x + y * y, NARROW * NARROW))


@compilable
def _strip(found: Vector[float], count: int, ends: tuple[float, float], chip: Chip, lobe: Lobe) -> float:
    """Return the light between two azimuths, where the same surfaces are seen one behind the other."""
    total, passed, last = 0.0, -1.0, -1
    sine = (ends[0] + ends[1]) / 2
    cosine = math.sqrt(1 - sine * sine)
    for _ in range(count):
        distance, index = _next(found, count, ends, (cosine, sine), passed, last)
        if index < 0:
            break
        above, below = -math.inf, math.inf
        if passed >= 0:
            above, below = _hidden(found, count, ends, (cosine, sine), passed, last, chip.height)
            if found[index + TOP] <= above * distance:
                passed, last = distance, index
                continue
        total += _arc(found, index, ends, (above, below), chip, lobe)
        passed, last = distance, index
    return total


@compilable
def _arc(
    found: Vector[float],
    index: int,
    ends: tuple[float, float],
    hidden: tuple[float, float],
    chip: Chip,
    lobe: Lobe,
) -> float:
    """Return the light from a surface between two azimuths."""
    if found[index + RADIUS] > 0:
        return found[index + REFLECTANCE] * _cylinder(found, index, ends, hidden, chip, lobe)
    return found[index + REFLECTANCE] * _face(found, index, ends, hidden, chip, lobe)


@compilable
def _face(
    found: Vector[float],
    index: int,
    ends: tuple[float, float],
    hidden: tuple[float, float],
    chip: Chip,
    lobe: Lobe,
) -> float:
    """Return the light from a face of reflectance 1 between two azimuths."""
    distance, c, s = found[index + DISTANCE], found[index + COSINE], found[index + SINE]
    # cos(phi) = cos(theta - foot), and d = distance / cos(phi).
    factors = c * c * c, 3 * c * c * s, 3 * c * s * s, s * s * s
    light = _cumulated(lobe.table, ends[1], factors) - _cumulated(lobe.table, ends[0], factors)
    # Light comes from around a place between the axis and the foot; there, or near there, the height counts.
    sharpness = FOOT + lobe.whole + lobe.part
    width = ends[1] - ends[0]
    spread = min(1 / (sharpness + 1), width * width / 12)
    x, y = sharpness - FOOT + FOOT * c, FOOT * s
    norm = math.sqrt(x * x + y * y)
    if not ends[0] * norm < y < ends[1] * norm:
        y = ends[0] if ends[0] * norm >= y else ends[1]
        x, norm = math.sqrt(1 - y * y), 1.0
    length = distance * norm / (x * c + y * s) * (1 + spread / 2)
    return max(light, 0.0) / (distance * distance) * _filled(found, index, hidden, chip.height, length)


@compilable
def _cumulated(
    table: Sequence[Sequence[float]], sine: float, factors: tuple[float, float, float, float]
) -> float:
    """Return the light of a face up to an azimuth, interpolated."""
    place = (sine + 1) * (N_CELLS / 2)
    cell = min(int(place), N_CELLS - 1)
    low, high, part = table[cell], table[cell + 1], place - cell
    a, b, c, d = factors
    first = a * low[0] + b * low[1] + c * low[2] + d * low[3]
    last = a * high[0] + b * high[1] + c * high[2] + d * high[3]
    return first + (last - first) * part


@compilable
def _cylinder(
    found: Vector[float],
    index: int,
    ends: tuple[float, float],
    hidden: tuple[float, float],
    chip: Chip,
    lobe: Lobe,
) -> float:
    """Return the light from a cylinder of reflectance 1 between two azimuths."""
    distance, radius = found[index + DISTANCE], found[index + RADIUS]
    c, s = found[index + COSINE], found[index + SINE]
    low, high = ends
    # In a place u with sin(phi) = u (3 - u^2) / 2, light has no root at the cylinder's edges.
    first = _third((low * c - math.sqrt(1 - low * low) * s) * distance / radius)
    last = _third((high * c - math.sqrt(1 - high * high) * s) * distance / radius)
    centre, half = (first + last) / 2, (last - first) / 2
    total = 0.0
    for node, weight in _NODES:
        place = centre + half * node
        square = place * place
        incidence = (1 - square) * math.sqrt(4 - square) / 2
        sine = place * (3 - square) / 2 * radius / distance
        cosine = math.sqrt(1 - sine * sine)
        length = distance * cosine - radius * incidence
        ahead = cosine * c - sine * s
        if ahead <= 0:
            continue
        lit = 1.5 * (1 - square) * incidence * radius / (distance * cosine * length * length)
        strength = 1 - lobe.part + lobe.part * ahead
        for _ in range(lobe.whole):
            strength *= ahead
        total += weight * lit * strength * _filled(found, index, hidden, chip.height, length)
    return total * half / lobe.norm


@compilable
def _filled(
    found: Vector[float], index: int, hidden: tuple[float, float], height: float, length: float
) -> float:
    """Return the part of the lobe in elevation that a surface and its image in the floor fill.

    Args:
        found: Surfaces.
        index: Index of the surface.
        hidden: Slopes up to which and down to which nearer things and their images hide it.
        height: Height of the sensor above the floor [m].
        length: Horizontal distance of the surface [m].
    """
    top, bottom = found[index + TOP], found[index + BOTTOM]
    image, foot = -2 * height - top, -2 * height - bottom
    if hidden[0] == -math.inf and bottom <= -height:
        return _below(top, length) - _below(image, length)
    above, below = hidden[0] * length, hidden[1] * length
    seen = _below(max(top, above), length) - _below(max(bottom, above), length)
    return seen + _below(min(foot, below), length) - _below(min(image, below), length)


@compilable
def _hidden(
    found: Vector[float],
    count: int,
    ends: tuple[float, float],
    azimuth: tuple[float, float],
    passed: float,
    last: int,
    height: float,
) -> tuple[float, float]:
    """Return the slopes up to which and down to which nearer things and their images hide what is behind."""
    above, below = -math.inf, math.inf
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + LOW] < ends[0] + NARROW and found[first + HIGH] > ends[1] - NARROW:
            distance = _distance(found, first, azimuth)
            if distance < passed or (distance == passed and first <= last):
                above = max(above, found[first + TOP] / distance)
                below = min(below, (-2 * height - found[first + TOP]) / distance)
    return above, below


@compilable
def _below(height: float, length: float) -> float:
    """Return the part of the lobe in elevation below a height at a horizontal distance [m], less a half."""
    sine = height / math.sqrt(height * height + length * length)
    square = sine * sine
    # The integral of cos^7, the lobe's cos^3 and four factors of the elevation.
    return sine * (1 - square * (1 - square * (0.6 - square * (1 / 7)))) * (35 / 32)


@compilable
def _next(
    found: Vector[float],
    count: int,
    ends: tuple[float, float],
    azimuth: tuple[float, float],
    passed: float,
    last: int,
) -> tuple[float, int]:
    """Return distance and index of the next surface behind another; an index below 0 for none."""
    nearest, index = math.inf, -1
    for first in range(0, count * N_COLUMNS, N_COLUMNS):
        if found[first + LOW] < ends[0] + NARROW and found[first + HIGH] > ends[1] - NARROW:
            distance = _distance(found, first, azimuth)
            behind = distance > passed or (distance == passed and first > last)
            if behind and distance < nearest:
                nearest, index = distance, first
    return nearest, index


@compilable
def _distance(found: Vector[float], first: int, azimuth: tuple[float, float]) -> float:
    """Return the distance of a surface at an azimuth at which it lies [m]."""
    cosine, sine = azimuth
    along = found[first + COSINE] * cosine + found[first + SINE] * sine
    distance, radius = found[first + DISTANCE], found[first + RADIUS]
    if radius == 0:
        return distance / along
    across = distance * (found[first + COSINE] * sine - found[first + SINE] * cosine)
    return distance * along - math.sqrt(max(radius * radius - across * across, 0.0))


@compilable
def _third(sine: float) -> float:
    """Return the solution u of u (3 - u^2) / 2 = sine, for a sine that rounding may have put beyond 1."""
    if sine >= 1.0:
        return 1.0
    return 2 * math.sin(math.asin(sine) / 3) if sine > -1.0 else -1.0
