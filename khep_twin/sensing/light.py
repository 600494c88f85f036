"""Light of lamps at a robot's receivers: its law, what hides a lamp, and its flicker.

`ambient` describes the model, `occlusion` finds what may hide a lamp. The functions are `compilable`: they
index lists here, arrays there, and query the scene only by the functions of `scene`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable, compilable_once
from khep_twin.sensing.robot_sensors import Ambient, RobotSensors
from khep_twin.sensing.scene import FEW, MANY, Scene, Triple, blocked, body_frame, position, stopped
from khep_twin.units import BULB_RADIUS

_NOTHING = 0.5
"""Light for which no ray is cast [counts]."""

_FAINT = 30.0
"""Light below which shadows have hard edges [counts]: their softness would be lost in the noise."""

_CLOSEST_MM = 1.0
"""Smallest distance of a lamp; nearer ones count as this near."""


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


@compilable_once
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
