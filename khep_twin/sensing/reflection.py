"""Infrared light that surrounding surfaces reflect to a sensor: an integral over all visible surfaces.

A surface element at distance d, at an angle theta off the sensor's axis and an incidence angle phi, reflects
light in proportion to lobe(theta) rho cos(phi) / d^2 per solid angle (a diffuse reflector; emitter and
receiver are one point). For upright surfaces the integral separates into azimuth and elevation:

    light = 1 / N  integral over the azimuth of  lobe(theta) rho cos(phi) / d^2 F dtheta

with the horizontal distance d, the part F of the lobe in elevation that the surface covers, and N such that
an infinite wall at distance d, perpendicular to the axis, gives 1 / d^2. The integral covers each visible arc
of each surface from edge to edge, so that light changes smoothly as objects move. Faces use the tables of
`lobes`, cylinders a quadrature.

In elevation the lobe is cos^3 or narrower (assumed), which gives F a closed form. The floor acts as a mirror
(assumed: parameters fitted to a wall alone then predict a cylinder best, and vice versa). Objects behind a
nearer one are visible above its top.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.lobes import FOOT_EXPONENT, N_CELLS
from khep_twin.sensing.seen_surfaces import (
    BOTTOM,
    COSINE,
    DISTANCE,
    HIGH,
    LOW,
    MIN_ARC,
    N_COLUMNS,
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
"""Nodes and weights of the Gauss-Legendre quadrature."""


Pair = tuple[float, float]


class Lobe(NamedTuple):
    """Lobe of a sensor.

    Attributes:
        exponent: Integer part of its exponent.
        fraction: Fractional part of it.
        norm: Norm N.
        width: Integral of the lobe over the azimuth, over N.
        table: Cumulative light of faces, from `lobes.table`.
        narrowing: Factors cos^2 of the elevation beside cos^3.
        mirror: Weight of the mirror images in the floor.
    """

    exponent: int
    fraction: float
    norm: float
    width: float
    table: Sequence[Sequence[float]]
    narrowing: int = 0
    mirror: float = 1.0


@compilable
def remove_faint(surfaces: Vector[float], count: int, lobe: Lobe, min_light: float) -> tuple[int, float]:
    """Remove surfaces with negligible light; return the number of the others, and a bound of their light.

    The upper bound of `reflected_light` [1/m^2] requires no integral and ignores shadows.

    Args:
        surfaces: Surfaces.
        count: Number of surfaces in it.
        lobe: Lobe of the sensor.
        min_light: Negligible light [1/m^2].
    """
    total, end, strongest = 0.0, 0, max(lobe.mirror, 1.0)
    min_light /= strongest
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        low, high = surfaces[row + LOW], surfaces[row + HIGH]
        # A bound by the smallest distance: the integral of cos^n over an arc is at most the difference of the
        # sines of its ends, times the largest cosine to the power of n - 1.
        arc_bound = lobe.width
        if lobe.exponent:
            arc_bound = min(arc_bound, (high - low) / lobe.norm)
        arc_bound /= surfaces[row + SQUARE]
        if low > 0 or high < 0:
            nearest_sine = low if low > 0 else high
            cosine_square = 1 - nearest_sine * nearest_sine
            for _ in range((lobe.exponent - 1) >> 1):
                arc_bound *= cosine_square
        if arc_bound <= min_light:
            continue
        # A bound by an infinite wall in its place, ((1 + cos) / 2)^k, with k by the lobe.
        gap = surfaces[row + DISTANCE] - surfaces[row + RADIUS]
        wall_bound = 1 / (gap * gap)
        for _ in range(min(lobe.exponent, 2) + 1 if lobe.exponent else 0):
            wall_bound *= (1 + surfaces[row + COSINE]) / 2
        light = min(arc_bound, wall_bound)
        if light > min_light:
            total += surfaces[row + REFLECTANCE] * light
            if end < row:
                for column in range(N_COLUMNS):
                    surfaces[end + column] = surfaces[row + column]
            end += N_COLUMNS
    return end // N_COLUMNS, total * strongest


@compilable
def reflected_light(surfaces: Vector[float], count: int, chip: Chip, lobe: Lobe) -> float:
    """Return the light from the first `count` surfaces [1/m^2]."""
    if count == 1:
        return _surface_light(surfaces, 0, (surfaces[LOW], surfaces[HIGH]), (-math.inf, math.inf), chip, lobe)
    total, low, end = 0.0, 1.0, -1.0
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + BOTTOM] > 0:
            # A surface above the sensor, such as a gripper, hides nothing, and is removed.
            ends = surfaces[row + LOW], surfaces[row + HIGH]
            total += _surface_light(surfaces, row, ends, (-math.inf, math.inf), chip, lobe)
            surfaces[row + LOW], surfaces[row + HIGH] = math.inf, -math.inf
        low, end = min(low, surfaces[row + LOW]), max(end, surfaces[row + HIGH])
    while low < end - MIN_ARC:
        # Between two edges, the sequence of surfaces from front to back is constant.
        high, front_row, max_top = end, -1, -math.inf
        for row in range(0, count * N_COLUMNS, N_COLUMNS):
            if low + MIN_ARC < surfaces[row + LOW]:
                high = min(high, surfaces[row + LOW])
            elif low + MIN_ARC < surfaces[row + HIGH]:
                high = min(high, surfaces[row + HIGH])
                front_row = row if front_row < 0 else count * N_COLUMNS
                max_top = max(max_top, surfaces[row + TOP])
        if front_row == count * N_COLUMNS:
            front_row, high = _find_nearest(surfaces, count, low, high)
        if front_row >= 0:
            if max_top > max(surfaces[front_row + TOP], 0.0):
                total += _stacked_light(surfaces, count, (low, high), chip, lobe)
            else:
                total += _surface_light(surfaces, front_row, (low, high), (-math.inf, math.inf), chip, lobe)
        low = high
    return total


@compilable
def _find_nearest(surfaces: Vector[float], count: int, low: float, high: float) -> tuple[int, float]:
    """Return the nearest surface between two azimuths, and the azimuth at which another one crosses it."""
    margin = (high - low) / 64
    right_sine, left_sine = low + margin, high - margin
    right_direction = math.sqrt(1 - right_sine * right_sine), right_sine
    left_direction = math.sqrt(1 - left_sine * left_sine), left_sine
    first_distance = last_distance = math.inf
    first_index = last_index = -1
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + LOW] < low + MIN_ARC and surfaces[row + HIGH] > high - MIN_ARC:
            distance = _distance_in(surfaces, row, right_direction)
            if distance < first_distance:
                first_distance, first_index = distance, row
            distance = _distance_in(surfaces, row, left_direction)
            if distance < last_distance:
                last_distance, last_index = distance, row
    if first_index == last_index:
        return first_index, high
    # The surfaces of overlapping objects cross here.
    if surfaces[first_index + RADIUS] == 0 and surfaces[last_index + RADIUS] == 0:
        return first_index, min(max(_crossing_sine(surfaces, first_index, last_index), right_sine), left_sine)
    while left_sine - right_sine > MIN_ARC:
        middle = (left_sine + right_sine) / 2
        direction = math.sqrt(1 - middle * middle), middle
        if _distance_in(surfaces, first_index, direction) <= _distance_in(surfaces, last_index, direction):
            right_sine = middle
        else:
            left_sine = middle
    return first_index, left_sine


@compilable
def _crossing_sine(surfaces: Vector[float], first: int, second: int) -> float:
    """Return the sine of the azimuth at which two faces meet."""
    first_distance, second_distance = surfaces[first + DISTANCE], surfaces[second + DISTANCE]
    x = first_distance * surfaces[second + SINE] - second_distance * surfaces[first + SINE]
    y = second_distance * surfaces[first + COSINE] - first_distance * surfaces[second + COSINE]
    return math.copysign(y, x * y) / math.sqrt(max(x * x + y * y, MIN_ARC * MIN_ARC))


@compilable
def _stacked_light(surfaces: Vector[float], count: int, sines: Pair, chip: Chip, lobe: Lobe) -> float:
    """Return the light of an arc, by the sines of its ends, where surfaces are visible above nearer ones."""
    total, depth, front_row = 0.0, -1.0, -1
    sine = (sines[0] + sines[1]) / 2
    cosine = math.sqrt(1 - sine * sine)
    for _ in range(count):
        distance, index = _find_next_surface(surfaces, count, sines, (cosine, sine), depth, front_row)
        if index < 0:
            break
        hidden = -math.inf, math.inf
        if depth >= 0:
            hidden = _hidden_slopes(surfaces, count, sines, (cosine, sine), depth, front_row, chip.height)
            if surfaces[index + TOP] <= hidden[0] * distance:
                depth, front_row = distance, index
                continue
        total += _surface_light(surfaces, index, sines, hidden, chip, lobe)
        depth, front_row = distance, index
    return total


@compilable
def _surface_light(
    surfaces: Vector[float], index: int, sines: Pair, hidden: Pair, chip: Chip, lobe: Lobe
) -> float:
    """Return the light from a surface between two azimuths."""
    if surfaces[index + RADIUS] > 0:
        return surfaces[index + REFLECTANCE] * _cylinder_light(surfaces, index, sines, hidden, chip, lobe)
    return surfaces[index + REFLECTANCE] * _face_light(surfaces, index, sines, hidden, chip, lobe)


@compilable
def _face_light(
    surfaces: Vector[float], index: int, sines: Pair, hidden: Pair, chip: Chip, lobe: Lobe
) -> float:
    """Return the light from a face of reflectance 1 between two azimuths."""
    distance, c, s = surfaces[index + DISTANCE], surfaces[index + COSINE], surfaces[index + SINE]
    # cos(phi) = cos(theta - foot), and d = distance / cos(phi).
    factors = c * c * c, 3 * c * c * s, 3 * c * s * s, s * s * s
    light = _table_light(lobe.table, sines[1], factors) - _table_light(lobe.table, sines[0], factors)
    # Most light comes from an azimuth between the axis and the foot; the elevation is computed near it.
    sharpness = FOOT_EXPONENT + lobe.exponent + lobe.fraction
    width = sines[1] - sines[0]
    spread = min(1 / (sharpness + 1), width * width / 12)
    x, y = sharpness - FOOT_EXPONENT + FOOT_EXPONENT * c, FOOT_EXPONENT * s
    norm = math.sqrt(x * x + y * y)
    if not sines[0] * norm < y < sines[1] * norm:
        y = sines[0] if sines[0] * norm >= y else sines[1]
        x, norm = math.sqrt(1 - y * y), 1.0
    length = distance * norm / (x * c + y * s) * (1 + spread / 2)
    part = _lobe_part(surfaces, index, hidden, chip.height, length, lobe)
    return max(light, 0.0) / (distance * distance) * part


@compilable
def _table_light(
    table: Sequence[Sequence[float]], sine: float, factors: tuple[float, float, float, float]
) -> float:
    """Return the cumulative light of a face up to an azimuth, by linear interpolation."""
    position = (sine + 1) * (N_CELLS / 2)
    cell = min(int(position), N_CELLS - 1)
    low, high, fraction = table[cell], table[cell + 1], position - cell
    a, b, c, d = factors
    low_light = a * low[0] + b * low[1] + c * low[2] + d * low[3]
    high_light = a * high[0] + b * high[1] + c * high[2] + d * high[3]
    return low_light + (high_light - low_light) * fraction


@compilable
def _cylinder_light(
    surfaces: Vector[float], index: int, sines: Pair, hidden: Pair, chip: Chip, lobe: Lobe
) -> float:
    """Return the light from a cylinder of reflectance 1 between two azimuths."""
    distance, radius = surfaces[index + DISTANCE], surfaces[index + RADIUS]
    c, s = surfaces[index + COSINE], surfaces[index + SINE]
    low, high = sines
    # With u by sin(phi) = u (3 - u^2) / 2, the integrand has no square root at the cylinder's edges.
    first = _invert_cubic((low * c - math.sqrt(1 - low * low) * s) * distance / radius)
    last = _invert_cubic((high * c - math.sqrt(1 - high * high) * s) * distance / radius)
    centre, half = (first + last) / 2, (last - first) / 2
    total = 0.0
    for node, weight in _NODES:
        u = centre + half * node
        u_square = u * u
        incidence = (1 - u_square) * math.sqrt(4 - u_square) / 2
        sine = u * (3 - u_square) / 2 * radius / distance
        cosine = math.sqrt(1 - sine * sine)
        length = distance * cosine - radius * incidence
        axis_cosine = cosine * c - sine * s
        if axis_cosine <= 0:
            continue
        density = 1.5 * (1 - u_square) * incidence * radius / (distance * cosine * length * length)
        strength = 1 - lobe.fraction + lobe.fraction * axis_cosine
        for _ in range(lobe.exponent):
            strength *= axis_cosine
        total += weight * density * strength * _lobe_part(surfaces, index, hidden, chip.height, length, lobe)
    return total * half / lobe.norm


@compilable
def _lobe_part(
    surfaces: Vector[float], index: int, hidden: Pair, height: float, distance: float, lobe: Lobe
) -> float:
    """Return the part of the lobe in elevation that a surface and its mirror image in the floor cover.

    Nearer objects and their mirror images hide it below and above the slopes `hidden`. `height` is that of
    the sensor, `distance` that of the surface in the horizontal plane [m].
    """
    top, bottom = surfaces[index + TOP], surfaces[index + BOTTOM]
    image_top, image_bottom = -2 * height - top, -2 * height - bottom
    narrowing, mirror = lobe.narrowing, lobe.mirror
    if hidden[0] == -math.inf and bottom <= -height and mirror == 1:
        return _part_below(top, distance, narrowing) - _part_below(image_top, distance, narrowing)
    lower, upper = hidden[0] * distance, hidden[1] * distance
    direct = _part_below(max(top, lower), distance, narrowing)
    direct -= _part_below(max(bottom, lower), distance, narrowing)
    direct += mirror * _part_below(min(image_bottom, upper), distance, narrowing)
    return direct - mirror * _part_below(min(image_top, upper), distance, narrowing)


@compilable
def _hidden_slopes(
    surfaces: Vector[float],
    count: int,
    sines: Pair,
    direction: Pair,
    depth: float,
    front_row: int,
    height: float,
) -> Pair:
    """Return the slope of the highest top, and of the lowest mirror image, up to and including `front_row`.

    `depth` is its distance; `direction` is cosine and sine of an azimuth in the arc with ends `sines`.
    """
    top_slope, bottom_slope = -math.inf, math.inf
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + LOW] < sines[0] + MIN_ARC and surfaces[row + HIGH] > sines[1] - MIN_ARC:
            distance = _distance_in(surfaces, row, direction)
            if distance < depth or (distance == depth and row <= front_row):
                top_slope = max(top_slope, surfaces[row + TOP] / distance)
                bottom_slope = min(bottom_slope, (-2 * height - surfaces[row + TOP]) / distance)
    return top_slope, bottom_slope


@compilable
def _part_below(height: float, distance: float, narrowing: int) -> float:
    """Return the part of the lobe in elevation below a height at a horizontal distance [m], minus 0.5."""
    sine = height / math.sqrt(height * height + distance * distance)
    square = sine * sine
    # The integral of cos^7: cos^3 of the lobe, and four factors cos of the elevation.
    part = sine * (1 - square * (1 - square * (0.6 - square * (1 / 7)))) * (35 / 32)
    if narrowing:
        # Integrals of cos^9, cos^11, and so on, by their recurrence.
        cosine_square = 1 - square
        term = sine * cosine_square * cosine_square * cosine_square * (5 / 32)
        for power in range(7, 7 + 2 * narrowing, 2):
            term *= cosine_square * power / (power + 1)
            part += term
    return part


@compilable
def _find_next_surface(
    surfaces: Vector[float], count: int, sines: Pair, direction: Pair, depth: float, front_row: int
) -> tuple[float, int]:
    """Return distance and row of the next surface behind `front_row`; a negative row for none."""
    nearest, index = math.inf, -1
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        if surfaces[row + LOW] < sines[0] + MIN_ARC and surfaces[row + HIGH] > sines[1] - MIN_ARC:
            distance = _distance_in(surfaces, row, direction)
            is_behind = distance > depth or (distance == depth and row > front_row)
            if is_behind and distance < nearest:
                nearest, index = distance, row
    return nearest, index


@compilable
def _distance_in(surfaces: Vector[float], row: int, direction: Pair) -> float:
    """Return the distance of a surface [m] in a direction within its arc: cosine and sine of the azimuth."""
    cosine, sine = direction
    along = surfaces[row + COSINE] * cosine + surfaces[row + SINE] * sine
    distance, radius = surfaces[row + DISTANCE], surfaces[row + RADIUS]
    if radius == 0:
        return distance / along
    across = distance * (surfaces[row + COSINE] * sine - surfaces[row + SINE] * cosine)
    return distance * along - math.sqrt(max(radius * radius - across * across, 0.0))


@compilable
def _invert_cubic(sine: float) -> float:
    """Return the solution u of u (3 - u^2) / 2 = sine, for a sine that may exceed 1 by rounding."""
    if sine >= 1.0:
        return 1.0
    return 2 * math.sin(math.asin(sine) / 3) if sine > -1.0 else -1.0
