"""The infrared sensors' arithmetic: from rays and lamps to counts, in plain numbers.

`sensors` and `ambient` say what it models. Like `kernel` it keeps to what a compiler for numerical Python
takes, so that one source serves both: its functions index whatever holds numbers, lists here, arrays there,
and ask the scene only by the functions of `raycast`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.sensing import raycast
from khep_twin.units import BULB_RADIUS

_SLACK = 1e-6
"""So much longer a ray may be when it is cast again [m]."""

_NOTHING = 0.5
"""Less than half a count is not worth a ray."""

_FAINT = 30.0
"""Light of so few counts has shadows with hard edges: their softness would be lost in the noise."""

_CLOSEST_MM = 1.0
"""A lamp that would be nearer than this counts as so near."""


class Proximity(NamedTuple):
    """Reflected light; per-sensor numbers in the order of N.

    Attributes:
        gain: per light reflected by the reference wall (8,) [counts m^2].
        threshold: taken off (8,) [counts].
        offset: of the chip behind the sensor's face (8,) [m].
        incidence_exponent: of the cosine between ray and normal (8,).
        limit: highest reading [counts].
        floor: lowest reading [counts].
        quantum: step between readings [counts].
        noise: standard deviation of one reading [counts].
        idle: mean of the rest that is left with nothing in reach [counts].
        weights: of each sensor's rays (8, n_rays).
        aside: tangents of their angles off the sensor's axis, to its right (8, n_rays).
        brightest: largest reflectance in the scene.
        uniform: whether all that can be hit has that reflectance.
        found: room for what rays find (4 n_rays,).
        directions: room for them in the world (3 n_rays,).
        incidences: room for their cosines to the normals (n_rays,).
        reflectances: room for the reflectances of what they hit (n_rays,).
    """

    gain: Sequence[float]
    threshold: Sequence[float]
    offset: Sequence[float]
    incidence_exponent: Sequence[float]
    limit: int
    floor: int
    quantum: int
    noise: float
    idle: float
    weights: Sequence[Sequence[float]]
    aside: Sequence[Sequence[float]]
    brightest: float
    uniform: bool
    found: list[float]
    directions: list[float]
    incidences: list[float]
    reflectances: list[float]


class Ambient(NamedTuple):
    """Light of lamps; per-sensor numbers in the order of O.

    Attributes:
        ahead: cosine of where each receiver looks (8,).
        left: sine of it (8,).
        gain_mm2: per light of a lamp (8,) [counts mm^2/W].
        lobe_exponent: of the cosine off its axis (8,).
        diffuse: part of the sensitivity that is not straight ahead.
        offset_mm: of the light's inverse square [mm].
        dark: reading in the dark [counts].
        floor: reading in the brightest light [counts].
        ceiling: highest reading [counts].
        noise: standard deviation of one reading [counts].
    """

    ahead: Sequence[float]
    left: Sequence[float]
    gain_mm2: Sequence[float]
    lobe_exponent: Sequence[float]
    diffuse: float
    offset_mm: float
    dark: float
    floor: float
    ceiling: int
    noise: float


class Bulbs(NamedTuple):
    """Lamps, and from where nothing can stand before them (`sightlines`).

    Attributes:
        places: of the centres (3 n,) [m].
        by_toolbox: whether the toolbox's law holds.
        min_angle_deg: that law's.
        max_angle_deg: that law's.
        known: whether all that stops light stands still.
        first: where each lamp's hidden directions begin, and where the last ones end (n + 1,).
        middles: unit vectors to the middle of hidden directions, one after the other (2 n_hidden,).
        edges: cosines of half the angles that they take, below -1 for all around (n_hidden,).
        nearest: how near what hides there is [m].
    """

    places: Sequence[float]
    by_toolbox: bool
    min_angle_deg: float
    max_angle_deg: float
    known: bool
    first: Sequence[int]
    middles: Sequence[float]
    edges: Sequence[float]
    nearest: Sequence[float]


def convert(
    scene: raycast.Scene,
    near: Proximity,
    eyes: Ambient,
    bulbs: Bulbs,
    powers: Sequence[float],
    channel: int,
    chance: tuple[float, float, float],
) -> tuple[int, int]:
    """Proximity and ambient counts of one sensor, as of the pose at the start of the last step.

    Args:
        scene: what there is.
        near: how proximity comes about.
        eyes: how ambient light does.
        bulbs: that may shine.
        powers: with which each does (n,) [W].
        channel: of the sensor.
        chance: of proximity and ambient, with standard deviation 1, and of idle counts, with mean 1.
    """
    noise = eyes.noise * chance[1]
    # The floor comes first, so that what is no number any more, until it is noticed, counts as the floor.
    level = max(eyes.floor, eyes.dark - light(scene, eyes, bulbs, powers, channel))
    range_left = (level - eyes.floor) / (eyes.dark - eyes.floor)
    ambient = max(min(round(level + noise), eyes.ceiling), 0)
    return proximity(scene, near, channel, chance[0], chance[2], range_left), ambient


def proximity(
    scene: raycast.Scene, near: Proximity, channel: int, noise: float, idle: float, range_left: float
) -> int:
    """Counts of reflected light.

    Args:
        scene: what there is.
        near: how they come about.
        channel: of the sensor.
        noise: chance, with standard deviation 1.
        idle: chance, with mean 1.
        range_left: part of the range that ambient light has left, 0 to 1.
    """
    level = near.noise * noise - near.threshold[channel]
    found, nearest = near.found, -1.0
    for i in range(0, raycast.rays(scene, near, channel, level, found), raycast.LENGTH_AND_NORMAL):
        length = found[i]
        if length >= 0 and (length < nearest or nearest < 0):
            nearest = length
    if nearest >= 0:
        # Most of the time nothing near enough is in view; what cannot pass the threshold is not summed up.
        gain, reach = near.gain[channel], nearest + near.offset[channel]
        if gain * near.brightest / (reach * reach) > -level:
            _look(scene, near, channel, found)
            level += gain * _reflected(found, near, channel)
    limit = int(near.limit * range_left)
    counts = min(round(min(level, float(limit)) / near.quantum) * near.quantum, limit)
    return max(counts, min(int(near.idle * idle), limit), near.floor)


def light(scene: raycast.Scene, eyes: Ambient, bulbs: Bulbs, powers: Sequence[float], channel: int) -> float:
    """What all lamps together take off the dark level of one receiver [counts]."""
    total = 0.0
    if not len(bulbs.places):
        return total
    place, frame = raycast.position(scene, channel), raycast.body_frame(scene)
    x, y, z = place[0], place[1], place[2]
    ahead, left = eyes.ahead[channel], eyes.left[channel]
    axis_x = ahead * frame[0] + left * frame[1]
    axis_y = ahead * frame[3] + left * frame[4]
    axis_z = ahead * frame[6] + left * frame[7]
    for lamp in range(len(powers)):
        power = powers[lamp]
        if power == 0:
            continue
        dx, dy = bulbs.places[3 * lamp] - x, bulbs.places[3 * lamp + 1] - y
        dz = 0.0 if bulbs.by_toolbox else bulbs.places[3 * lamp + 2] - z
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        if distance == 0:
            distance = BULB_RADIUS
        cosine = (dx * axis_x + dy * axis_y + dz * axis_z) / distance
        if bulbs.by_toolbox:
            total += power * received_by_toolbox(eyes, bulbs, channel, distance, cosine)
            continue
        counts = power * received(eyes, channel, distance, cosine)
        if counts <= _NOTHING:
            continue
        if clear(bulbs, lamp, x, y):
            total += counts
        elif counts >= _FAINT:
            total += counts * in_sight(scene, channel, dx, dy, dz, distance)
        elif not raycast.stopped(scene, channel, dx, dy, dz, 1 - BULB_RADIUS / distance):
            total += counts
    return total


def received(eyes: Ambient, channel: int, distance: float, cosine: float) -> float:
    """What a lamp of 1 W in full sight takes off the dark level [counts/W].

    Args:
        eyes: the receivers.
        channel: of the sensor.
        distance: from the receiver to the bulb's centre [m].
        cosine: of the lamp's direction off the receiver's axis.
    """
    straight = cosine ** eyes.lobe_exponent[channel] if cosine > 0 else 0.0
    lobe = (1 - eyes.diffuse) * straight + eyes.diffuse * (1 + cosine) / 2
    return lobe * _falling_off(eyes, channel, distance)


def received_by_toolbox(eyes: Ambient, bulbs: Bulbs, channel: int, distance: float, cosine: float) -> float:
    """The same by the toolbox's law, with distance and angle as on a map."""
    angle_deg = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    lobe = 1.0
    if angle_deg > bulbs.max_angle_deg:
        lobe = 0.0
    elif angle_deg > bulbs.min_angle_deg:
        lobe = math.cos(math.radians(angle_deg * 90 / bulbs.max_angle_deg))
    return lobe * _falling_off(eyes, channel, distance)


def clear(bulbs: Bulbs, lamp: int, x: float, y: float) -> bool:
    """Whether a lamp is surely in full sight of a place at the height of the sensors [m]."""
    if not bulbs.known:
        return False
    dx, dy = x - bulbs.places[3 * lamp], y - bulbs.places[3 * lamp + 1]
    distance = math.sqrt(dx * dx + dy * dy)
    nearest, middles, edges = bulbs.nearest, bulbs.middles, bulbs.edges
    for i in range(bulbs.first[lamp], bulbs.first[lamp + 1]):
        if distance > nearest[i] and dx * middles[2 * i] + dy * middles[2 * i + 1] > distance * edges[i]:
            return False
    return True


def in_sight(scene: raycast.Scene, channel: int, x: float, y: float, z: float, distance: float) -> float:
    """Which part of a bulb a receiver sees, 0 to 1, along a way [m] that is `distance` long."""
    # Mostly all or nothing is in sight; the edge of a shadow is looked at more closely.
    seen = part_of_bulb(scene, channel, x, y, z, distance, raycast.FEW)
    if seen == 0.0 or seen == 1.0:
        return seen
    return part_of_bulb(scene, channel, x, y, z, distance, raycast.MANY)


def part_of_bulb(
    scene: raycast.Scene, channel: int, x: float, y: float, z: float, distance: float, disc: int
) -> float:
    """Which part of some points of a bulb rays from a receiver reach."""
    flat, scale = math.sqrt(x * x + y * y), BULB_RADIUS / distance
    # To the left and up, as seen from the receiver; right below a lamp any left will do.
    left, up = (BULB_RADIUS, 0.0, 0.0), (0.0, BULB_RADIUS, 0.0)
    if flat > 0:
        side, tilt = BULB_RADIUS / flat, -z * scale / flat
        left, up = (-y * side, x * side, 0.0), (x * tilt, y * tilt, flat * scale)
    # Hits are told in lengths of the rays. One as near as the bulb's glass has reached it.
    return 1 - raycast.blocked(scene, channel, disc, left, up, (x, y, z), 1.0 + scale, 1.0 - scale)


def reflected(
    lengths: Sequence[float],
    incidences: Sequence[float],
    reflectances: Sequence[float],
    weights: Sequence[float],
    offset: float,
    incidence_exponent: float,
) -> float:
    """Reflected light over a sensor's rays: sum_i w_i rho_i cos(phi_i)^m / (d_i + offset)^2 [1/m^2].

    Args:
        lengths: d_i, of each ray [m]; below 0 where it hits nothing.
        incidences: cos(phi_i), between ray and surface normal.
        reflectances: rho_i, of what it hits.
        weights: w_i, of the rays in the cone.
        offset: of the sensor's chip behind its face [m].
        incidence_exponent: m.
    """
    total = 0.0
    for i in range(len(weights)):
        if lengths[i] >= 0 and incidences[i] > 0:
            lit = weights[i] * reflectances[i] * incidences[i] ** incidence_exponent
            reach = lengths[i] + offset
            total += lit / (reach * reach)
    return total


def _reflected(found: Sequence[float], near: Proximity, channel: int) -> float:
    """`reflected`, over what rays have found."""
    return reflected(
        found[:: raycast.LENGTH_AND_NORMAL],
        near.incidences,
        near.reflectances,
        near.weights[channel],
        near.offset[channel],
        near.incidence_exponent[channel],
    )


def _look(scene: raycast.Scene, near: Proximity, channel: int, found: Sequence[float]) -> None:
    """Fills in how the rays meet what they hit, and how bright that is."""
    frame = raycast.sensor_frame(scene, channel)
    aside = near.aside[channel]
    farthest = -1.0
    for i in range(len(aside)):
        first = raycast.LENGTH_AND_NORMAL * i
        if found[first] > farthest:
            farthest = found[first]
        if near.uniform and found[first] < 0:
            continue  # it is neither cast again nor counts
        dx, dy, dz = raycast.direction(scene, frame, channel, i, aside[i])
        near.directions[3 * i], near.directions[3 * i + 1], near.directions[3 * i + 2] = dx, dy, dz
        near.incidences[i] = -(found[first + 1] * dx + found[first + 2] * dy + found[first + 3] * dz)
    if not near.uniform:
        raycast.surfaces(scene, channel, near.directions, farthest + _SLACK, near.reflectances)


def _falling_off(eyes: Ambient, channel: int, distance: float) -> float:
    reach_mm = max(distance * 1e3 - eyes.offset_mm, _CLOSEST_MM)
    return eyes.gain_mm2[channel] / (reach_mm * reach_mm)
