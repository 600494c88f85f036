"""The infrared sensors' arithmetic: from surfaces and lamps to counts, in plain numbers.

`sensors`, `reflection` and `ambient` describe the model. The functions are `compilable`: they index lists
here, arrays there, and query the scene only by the functions of `scene`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.reflection import Lobe, reflected, sift
from khep_twin.sensing.scene import (
    FEW,
    MANY,
    Scene,
    Triple,
    blocked,
    body_frame,
    chip,
    position,
    stopped,
    surfaces,
)
from khep_twin.sensing.seen_surfaces import Chip
from khep_twin.units import BULB_RADIUS

SLIGHT = 4.0
"""Reflected light that does not matter [counts]: a fifth of the noise."""

_NOTHING = 0.5
"""Light for which no ray is cast [counts]."""

_FAINT = 30.0
"""Light below which shadows have hard edges [counts]: their softness would be lost in the noise."""

EMITTER_NS = 1_250_000
"""Time from a sensor's conversion without its emitter to that with it [ns]: half its turn (assumed)."""

_CLOSEST_MM = 1.0
"""Smallest distance of a lamp; nearer ones count as this near."""


class Proximity(NamedTuple):
    """Reflected light; per-sensor numbers in the order of N.

    Attributes:
        gain: Counts per light (8,) [counts m^2].
        bound: Highest counts of anything at a distance of 1 m (8,) [counts m^2].
        threshold: Counts that are subtracted (8,) [counts].
        offset: Offset of the chip behind the sensor's face (8,) [m].
        reach: Range (8,) [m].
        whole: Whole part of each lobe's exponent (8,).
        part: The rest of it (8,).
        norm: Norm of each lobe (8,).
        width: Width of each lobe, over its norm (8,).
        table: Cumulated light of faces, as of `lobes.table` (8, N_CELLS + 1, 4).
        limit: Highest reading [counts].
        floor: Lowest reading [counts].
        quantum: Step between readings [counts].
        noise: Standard deviation of one reading (8,) [counts].
        idle: Mean of the noise with nothing in reach [counts].
        found: Buffer for the surfaces that a sensor sees (N_SURFACES * N_COLUMNS,).
    """

    gain: Sequence[float]
    bound: Sequence[float]
    threshold: Sequence[float]
    offset: Sequence[float]
    reach: Sequence[float]
    whole: Sequence[int]
    part: Sequence[float]
    norm: Sequence[float]
    width: Sequence[float]
    table: Sequence[Sequence[Sequence[float]]]
    limit: int
    floor: int
    quantum: int
    noise: Sequence[float]
    idle: float
    found: list[float]


class Ambient(NamedTuple):
    """Light of lamps; per-sensor numbers in the order of O.

    Attributes:
        ahead: Cosine of each receiver's heading (8,).
        left: Sine of each receiver's heading (8,).
        gain_mm2: Counts per light of a lamp (8,) [counts mm^2/W].
        lobe_exponent: Exponent of the cosine off the receiver's axis (8,).
        diffuse: Diffuse part of the sensitivity.
        offset_mm: Offset in the light's inverse square law [mm].
        dark: Reading in the dark [counts].
        floor: Reading in the brightest light [counts].
        ceiling: Highest reading [counts].
        noise: Standard deviation of one reading [counts].
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


class RobotSensors(NamedTuple):
    """Sensors of one robot.

    Attributes:
        base: Body of the robot, which its own rays ignore.
        cameras: Cameras of the sensors (8,).
        proximity: Numbers of proximity.
        ambient: Numbers of ambient light.
    """

    base: int
    cameras: Sequence[int]
    proximity: Proximity
    ambient: Ambient


class Bulb(NamedTuple):
    """A lamp: its centre [m], the range of its directions in `Light.hidden`, and the depth of its flicker."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    first: int = 0
    end: int = 0
    flicker: float = 0.0


class Hidden(NamedTuple):
    """A direction from a lamp in which something may hide it (`occlusion`).

    Attributes:
        x: Unit vector to the middle of the direction, x.
        y: The same, y.
        edge: Cosine of half its angle; below -1 for all around.
        nearest: Distance of the hiding object [m].
    """

    x: float = 0.0
    y: float = 0.0
    edge: float = 0.0
    nearest: float = 0.0


class LightLaw(NamedTuple):
    """Law of the lamps' light.

    Attributes:
        by_toolbox: True if the toolbox's law holds.
        min_angle_deg: Minimum angle of that law [deg].
        max_angle_deg: Maximum angle of that law [deg].
        known: True if all that stops light stands still.
        flicker_ns: Period of the lamps' flicker [ns].
        phase: Part of that period that has passed at time 0.
    """

    by_toolbox: bool
    min_angle_deg: float
    max_angle_deg: float
    known: bool
    flicker_ns: int
    phase: float


class Light(NamedTuple):
    """Lamps of a scene, and what may hide them.

    Attributes:
        law: Law of their light.
        bulbs: Lamps (n,).
        hidden: Directions from the lamps in which they may be hidden, one lamp after the other.
    """

    law: LightLaw
    bulbs: Sequence[Bulb]
    hidden: Sequence[Hidden]


@compilable
def convert(
    scene: Scene,
    sensors: RobotSensors,
    light: Light,
    powers: Sequence[float],
    time_ns: int,
    channel: int,
    draws: tuple[float, float, float],
) -> tuple[int, int]:
    """Return proximity and ambient counts of one sensor, for the pose at the start of the last step.

    Args:
        scene: Scene around the robot.
        sensors: Sensors of the robot.
        light: Lamps of the world.
        powers: Mean powers of the lamps (n,) [W].
        time_ns: Time of the conversion [ns].
        channel: Number of the sensor.
        draws: Random draws for proximity and ambient counts, with standard deviation 1, and for idle counts,
            with mean 1.
    """
    ambient, added = sensors.ambient, 0.0
    noise, reach = ambient.noise * draws[1], ambient.dark - ambient.floor
    total, swing = light_counts(scene, sensors, light, powers, channel)
    bright = total + swing * wave(light.law, time_ns) if swing > 0 else total
    # The floor is the first argument, so that NaN counts as the floor until it is noticed.
    level = max(ambient.floor, ambient.dark - bright)
    if swing > 0:
        # The second conversion, with the emitter on, has other ambient light than the first.
        bright = total + swing * wave(light.law, time_ns + EMITTER_NS)
        change = level - max(ambient.floor, ambient.dark - bright)
        added = sensors.proximity.limit * change / reach
    counts = max(min(round(level + noise), ambient.ceiling), 0)
    range_left = (level - ambient.floor) / reach
    return proximity_counts(scene, sensors, channel, draws[0], draws[2], range_left, added), counts


@compilable
def proximity_counts(
    scene: Scene,
    sensors: RobotSensors,
    channel: int,
    noise: float,
    idle: float,
    range_left: float,
    added: float,
) -> int:
    """Return the counts of reflected light.

    Args:
        scene: Scene around the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        noise: Random draw with standard deviation 1.
        idle: Random draw with mean 1.
        range_left: Part of the range that ambient light leaves, 0 to 1.
        added: Change of the ambient light between the sensor's two conversions [counts].
    """
    proximity = sensors.proximity
    level = proximity.noise[channel] * noise + added - proximity.threshold[channel]
    # Less passes no threshold, or changes the reading by less than half a step.
    needed = max(-level, proximity.quantum / 2)
    mounted = chip(scene, sensors, channel)
    count = surfaces(scene, sensors, channel, mounted, needed)
    gain, found = proximity.gain[channel], proximity.found
    lobe = lobe_of(proximity, channel)
    count, most = sift(found, count, lobe, SLIGHT / gain)
    if count and gain * most > -level:
        level += gain * reflected(found, count, mounted, lobe)
    limit = int(proximity.limit * range_left)
    counts = min(round(min(level, float(limit)) / proximity.quantum) * proximity.quantum, limit)
    return max(counts, min(int(proximity.idle * idle), limit), proximity.floor)


@compilable
def chip_behind(place: Sequence[float], frame: Sequence[float], proximity: Proximity, channel: int) -> Chip:
    """Return a sensor's chip, behind its face.

    Args:
        place: Position of the sensor (3,) [m].
        frame: Orientation of the sensor (9,), which looks against its third axis.
        proximity: Numbers of proximity.
        channel: Number of the sensor.
    """
    # The robot stands upright; what little it tilts does not count.
    ahead, left, offset = -frame[2], -frame[5], proximity.offset[channel]
    scale = 1 / math.sqrt(max(ahead * ahead + left * left, 1e-12))
    ahead, left = ahead * scale, left * scale
    x, y = place[0] - offset * ahead, place[1] - offset * left
    return Chip(x, y, ahead, left, place[2], proximity.reach[channel])


@compilable
def lobe_of(proximity: Proximity, channel: int) -> Lobe:
    """Return the lobe of a sensor."""
    return Lobe(
        proximity.whole[channel],
        proximity.part[channel],
        proximity.norm[channel],
        proximity.width[channel],
        proximity.table[channel],
    )


@compilable
def light_counts(
    scene: Scene, sensors: RobotSensors, light: Light, powers: Sequence[float], channel: int
) -> tuple[float, float]:
    """Return the mean light of all lamps at one receiver, below its dark level, and its swing [counts]."""
    total, swing, law, bulbs, ambient = 0.0, 0.0, light.law, light.bulbs, sensors.ambient
    if not len(bulbs):
        return total, swing
    place, frame = position(scene, sensors, channel), body_frame(scene, sensors)
    x, y, z = place[0], place[1], place[2]
    ahead, left = ambient.ahead[channel], ambient.left[channel]
    axis_x = ahead * frame[0] + left * frame[1]
    axis_y = ahead * frame[3] + left * frame[4]
    axis_z = ahead * frame[6] + left * frame[7]
    for lamp in range(len(bulbs)):
        power, bulb = powers[lamp], bulbs[lamp]
        if power == 0:
            continue
        dx, dy = bulb.x - x, bulb.y - y
        dz = 0.0 if law.by_toolbox else bulb.z - z
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        if distance == 0:
            distance = BULB_RADIUS
        cosine = (dx * axis_x + dy * axis_y + dz * axis_z) / distance
        if law.by_toolbox:
            counts = power * received_by_toolbox(ambient, law, channel, distance, cosine)
        else:
            counts = power * received(ambient, channel, distance, cosine)
            if counts <= _NOTHING:
                continue
            if not clear(light, lamp, x, y):
                if counts >= _FAINT:
                    counts *= in_sight(scene, sensors, channel, (dx, dy, dz), distance)
                elif stopped(scene, sensors, channel, (dx, dy, dz), 1 - BULB_RADIUS / distance):
                    continue
        total += counts
        swing += counts * bulb.flicker
    return total, swing


@compilable
def wave(law: LightLaw, time_ns: int) -> float:
    """Return the lamps' flicker at a time [ns], -1 to 1."""
    return math.cos(math.tau * (time_ns % law.flicker_ns / law.flicker_ns + law.phase))


@compilable
def received(ambient: Ambient, channel: int, distance: float, cosine: float) -> float:
    """Return the light of a lamp of 1 W in full sight, below the dark level [counts/W].

    Args:
        ambient: Numbers of the receivers.
        channel: Number of the sensor.
        distance: Distance from the receiver to the bulb's centre [m].
        cosine: Cosine of the lamp's direction off the receiver's axis.
    """
    straight = cosine ** ambient.lobe_exponent[channel] if cosine > 0 else 0.0
    lobe = (1 - ambient.diffuse) * straight + ambient.diffuse * (1 + cosine) / 2
    return lobe * _falling_off(ambient, channel, distance)


@compilable
def received_by_toolbox(
    ambient: Ambient, law: LightLaw, channel: int, distance: float, cosine: float
) -> float:
    """Return the light by the toolbox's law, with distance and angle as on a map [counts/W]."""
    angle_deg = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    lobe = 1.0
    if angle_deg > law.max_angle_deg:
        lobe = 0.0
    elif angle_deg > law.min_angle_deg:
        lobe = math.cos(math.radians(angle_deg * 90 / law.max_angle_deg))
    return lobe * _falling_off(ambient, channel, distance)


@compilable
def clear(light: Light, lamp: int, x: float, y: float) -> bool:
    """Return whether a lamp is surely in full sight of a position at the height of the sensors [m]."""
    if not light.law.known:
        return False
    bulb = light.bulbs[lamp]
    dx, dy = x - bulb.x, y - bulb.y
    distance = math.sqrt(dx * dx + dy * dy)
    for i in range(bulb.first, bulb.end):
        hidden = light.hidden[i]
        if distance > hidden.nearest and dx * hidden.x + dy * hidden.y > distance * hidden.edge:
            return False
    return True


@compilable
def in_sight(scene: Scene, sensors: RobotSensors, channel: int, way: Triple, distance: float) -> float:
    """Return the part of a bulb that a receiver sees, 0 to 1, along a way [m] that is `distance` long."""
    # Mostly all or nothing is in sight; the edge of a shadow is looked at more closely.
    seen = part_of_bulb(scene, sensors, channel, way, distance, FEW)
    if seen == 0.0 or seen == 1.0:
        return seen
    return part_of_bulb(scene, sensors, channel, way, distance, MANY)


@compilable
def part_of_bulb(
    scene: Scene, sensors: RobotSensors, channel: int, way: Triple, distance: float, disc: int
) -> float:
    """Return the part of a bulb's points that rays from a receiver reach."""
    x, y, z = way
    flat, scale = math.sqrt(x * x + y * y), BULB_RADIUS / distance
    # To the left and up, as seen from the receiver; directly below a lamp any left is as good.
    left, up = (BULB_RADIUS, 0.0, 0.0), (0.0, BULB_RADIUS, 0.0)
    if flat > 0:
        side, tilt = BULB_RADIUS / flat, -z * scale / flat
        left, up = (-y * side, x * side, 0.0), (x * tilt, y * tilt, flat * scale)
    # Hits are in lengths of the rays. One as near as the bulb's glass has reached it.
    return 1 - blocked(scene, sensors, channel, disc, left, up, way, 1.0 - scale)


@compilable
def _falling_off(ambient: Ambient, channel: int, distance: float) -> float:
    reach_mm = max(distance * 1e3 - ambient.offset_mm, _CLOSEST_MM)
    return ambient.gain_mm2[channel] / (reach_mm * reach_mm)
