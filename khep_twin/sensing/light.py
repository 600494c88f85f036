"""Light of lamps at a robot's receivers: its law, occlusion, and flicker.

`ambient` describes the model; `occlusion` finds the obstacles between lamps and robot. The functions are
`compilable`: they index lists in plain code and arrays in compiled code, and query the scene by `scene`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable, compilable_once
from khep_twin.sensing.robot_sensors import Ambient, RobotSensors
from khep_twin.sensing.scene import COARSE, FINE, Scene, Triple, body_frame, hidden_part, is_blocked, position
from khep_twin.units import BULB_RADIUS

_NEGLIGIBLE = 0.5
"""Light below which no ray is cast [counts]."""

_FAINT = 30.0
"""Light below which shadows have hard edges [counts]: the noise would hide a penumbra."""

_CLOSEST_MM = 1.0
"""Smallest distance of a lamp; smaller distances are clipped."""


class Bulb(NamedTuple):
    """A lamp: its centre [m], the range of its sectors in `Light.sectors`, and the depth of its flicker."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    first_sector: int = 0
    end_sector: int = 0
    flicker: float = 0.0


class HiddenSector(NamedTuple):
    """Sector of directions from a lamp in which an obstacle may hide it (`occlusion`).

    Attributes:
        x: x of the unit vector along the middle of the sector.
        y: y of that vector.
        half_cosine: Cosine of half the sector's angle; below -1 for all directions.
        distance: Distance of the obstacle [m].
    """

    x: float = 0.0
    y: float = 0.0
    half_cosine: float = 0.0
    distance: float = 0.0


class LightLaw(NamedTuple):
    """Law of the lamps' light.

    Attributes:
        by_toolbox: True for the law of the Khepera Toolbox for Matlab.
        min_angle_deg: Minimum angle of that law [deg].
        max_angle_deg: Maximum angle of that law [deg].
        is_static: True if no obstacle can move, so that the sectors are complete.
        flicker_ns: Period of the lamps' flicker [ns], half that of the mains.
        flicker_phase: Phase of the flicker at time 0, in periods.
    """

    by_toolbox: bool
    min_angle_deg: float
    max_angle_deg: float
    is_static: bool
    flicker_ns: int
    flicker_phase: float


class Light(NamedTuple):
    """Lamps of a scene, and the sectors in which they may be hidden.

    Attributes:
        law: Law of their light.
        bulbs: Lamps (n,).
        sectors: Sectors in which lamps may be hidden, one lamp after another.
    """

    law: LightLaw
    bulbs: Sequence[Bulb]
    sectors: Sequence[HiddenSector]


@compilable
def light_counts(
    scene: Scene, sensors: RobotSensors, light: Light, powers: Sequence[float], channel: int
) -> tuple[float, float]:
    """Return mean and flicker amplitude of the lamps' light at a receiver, below its dark level [counts]."""
    total, amplitude, law, bulbs, ambient = 0.0, 0.0, light.law, light.bulbs, sensors.ambient
    if not len(bulbs):
        return total, amplitude
    origin, frame = position(scene, sensors, channel), body_frame(scene, sensors)
    x, y, z = origin[0], origin[1], origin[2]
    forward, left = ambient.cosine[channel], ambient.sine[channel]
    axis_x = forward * frame[0] + left * frame[1]
    axis_y = forward * frame[3] + left * frame[4]
    axis_z = forward * frame[6] + left * frame[7]
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
            lamp_counts = power * toolbox_light_per_watt(ambient, law, channel, distance, cosine)
        else:
            lamp_counts = power * light_per_watt(ambient, channel, distance, cosine)
            if lamp_counts <= _NEGLIGIBLE:
                continue
            if not is_clear(light, lamp, x, y):
                if lamp_counts >= _FAINT:
                    lamp_counts *= visible_part(scene, sensors, channel, (dx, dy, dz), distance)
                elif is_blocked(scene, sensors, channel, (dx, dy, dz), 1 - BULB_RADIUS / distance):
                    continue
        total += lamp_counts
        amplitude += lamp_counts * bulb.flicker
    return total, amplitude


@compilable
def flicker_wave(law: LightLaw, time_ns: int) -> float:
    """Return the flicker of the lamps at a time [ns], -1 to 1."""
    return math.cos(math.tau * (time_ns % law.flicker_ns / law.flicker_ns + law.flicker_phase))


@compilable
def light_per_watt(ambient: Ambient, channel: int, distance: float, cosine: float) -> float:
    """Return the light of a lamp of 1 W in full sight, below the dark level [counts/W].

    Args:
        ambient: Parameters of the receivers.
        channel: Number of the sensor.
        distance: Distance from the receiver to the bulb's centre [m].
        cosine: Cosine of the lamp's direction off the receiver's axis.
    """
    straight = cosine ** ambient.lobe_exponent[channel] if cosine > 0 else 0.0
    lobe = (1 - ambient.diffuse) * straight + ambient.diffuse * (1 + cosine) / 2
    return lobe * _attenuation(ambient, channel, distance)


@compilable
def toolbox_light_per_watt(
    ambient: Ambient, law: LightLaw, channel: int, distance: float, cosine: float
) -> float:
    """Return the light by the toolbox's law, with distance and angle in the plane [counts/W]."""
    angle_deg = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    lobe = 1.0
    if angle_deg > law.max_angle_deg:
        lobe = 0.0
    elif angle_deg > law.min_angle_deg:
        lobe = math.cos(math.radians(angle_deg * 90 / law.max_angle_deg))
    return lobe * _attenuation(ambient, channel, distance)


@compilable
def is_clear(light: Light, lamp: int, x: float, y: float) -> bool:
    """Return whether a lamp is certainly in full sight of a position at the height of the sensors [m]."""
    if not light.law.is_static:
        return False
    bulb = light.bulbs[lamp]
    dx, dy = x - bulb.x, y - bulb.y
    distance = math.sqrt(dx * dx + dy * dy)
    for i in range(bulb.first_sector, bulb.end_sector):
        sector = light.sectors[i]
        if distance > sector.distance and dx * sector.x + dy * sector.y > distance * sector.half_cosine:
            return False
    return True


@compilable
def visible_part(scene: Scene, sensors: RobotSensors, channel: int, ray: Triple, distance: float) -> float:
    """Return the visible part of a bulb, 0 to 1, along a ray from a receiver [m] of length `distance`."""
    # Mostly all or nothing is visible; only a penumbra needs many rays.
    visible_fraction = sample_bulb(scene, sensors, channel, ray, distance, COARSE)
    if visible_fraction == 0.0 or visible_fraction == 1.0:
        return visible_fraction
    return sample_bulb(scene, sensors, channel, ray, distance, FINE)


@compilable_once
def sample_bulb(
    scene: Scene, sensors: RobotSensors, channel: int, ray: Triple, distance: float, disc: int
) -> float:
    """Return the part of a bulb's points (`disc`: COARSE or FINE) that a receiver sees along a ray [m]."""
    x, y, z = ray
    horizontal, scale = math.sqrt(x * x + y * y), BULB_RADIUS / distance
    # Left and up, as seen from the receiver; directly below a lamp any horizontal direction is left.
    left, up = (BULB_RADIUS, 0.0, 0.0), (0.0, BULB_RADIUS, 0.0)
    if horizontal > 0:
        side, tilt = BULB_RADIUS / horizontal, -z * scale / horizontal
        left, up = (-y * side, x * side, 0.0), (x * tilt, y * tilt, horizontal * scale)
    # Hits are in lengths of the rays; a hit at the glass of the bulb or beyond is not an obstacle.
    return 1 - hidden_part(scene, sensors, channel, disc, left, up, ray, 1.0 - scale)


@compilable
def _attenuation(ambient: Ambient, channel: int, distance: float) -> float:
    distance_mm = max(distance * 1e3 - ambient.offset_mm, _CLOSEST_MM)
    return ambient.gain_mm2[channel] / (distance_mm * distance_mm)
