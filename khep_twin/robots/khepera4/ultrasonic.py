"""Ultrasonic sensors of the Khepera IV: the first audible echo of a burst.

Rays sample the beam. A ray at an angle theta to the axis that hits a surface at a distance d and an angle of
incidence phi returns

    loudness = D(theta)^2 (m(phi) (R / d) + s cos(phi)^2 (R / d)^2)
    D(theta) = cos(theta)^k,  m(phi) = exp(-(phi / phi0)^2)

relative to a perpendicular wall at the range R = 2.5 m (manual), whose loudness 1 is the detection threshold.
The first term is specular reflection; the second, s = 0.03, is scattered by edges and roughness (s and phi0 =
12 degrees assumed). The amplitude D is 0.5 at 42.5 degrees off the axis (typical, assumed), so k = 2.27.
Walls turned by 55 degrees or more are missed beyond some 0.4 m; the floor and its paint are always missed.
"""

import math
from collections.abc import Sequence
from math import cos, sin
from typing import Any, NamedTuple

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.channels import ULTRASONIC_CODES
from khep_twin.robots.khepera4.model import SONAR
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.noise import Tables, draws
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams, BeamScene, body_frame, cast_rays

PERIOD_NS = 20_000_000
"""Time from one burst to the next [ns]: enabled sensors alternate (manual)."""

RANGE, NEAREST = 2.5, 0.25
"""Longest and shortest measured distance [m] (manual)."""

TOO_NEAR, NO_ECHO, DISABLED = ULTRASONIC_CODES

_BEAM_EXPONENT, _REFLECTION_RAD, _SCATTER = 2.27, math.radians(12), 0.03
_NOISE_CM = 0.4
"""Standard deviation of a distance [cm] (assumed; the manual states an error of 2 cm)."""

_NEAREST_CM = round(NEAREST * 100)
_SURELY_SILENT = 1 - 1e-9
"""Bound of the loudness below which an echo is not heard, with a margin for rounding."""

_KEY_MASK = 0x9E3779B9
"""Arbitrary word that separates their random draws from those of other sensors."""

_AZIMUTHS, _ELEVATIONS = np.radians(np.arange(-42, 43, 3)), np.radians(np.arange(-12, 13, 6))
N_LEVEL, FIRST_LEVEL = len(_AZIMUTHS), len(_ELEVATIONS) // 2 * len(_AZIMUTHS)
"""Number of rays of elevation 0, and the first of them."""


class Sonar(NamedTuple):
    """Rays of the sensors.

    Attributes:
        positions: Positions of the sensors (3 * N_ULTRASONIC,) [m].
        rays: Unit vectors of their rays in the robot's frame (3 * n * N_ULTRASONIC,).
        gains: Gains of the rays of a sensor, D(theta)^2 (n,).
    """

    positions: Sequence[float]
    rays: Sequence[float]
    gains: Sequence[float]


@compilable
def measure(
    scene: BeamScene,
    sensors: RobotSensors,
    centre: tuple[float, float, float],
    sonar: Sonar,
    beams: Beams,
    tables: Tables,
    key: Vector[int],
    time_ns: int,
    channel: int,
) -> int:
    """Return the reading of a sensor [cm], or a code.

    Args:
        scene: BeamScene at the time of the burst.
        sensors: Infrared sensors of the robot.
        centre: Position of the robot [m].
        sonar: Rays of the sensors.
        beams: Buffers for the rays of this one, in the world frame.
        tables: Quantiles of random draws.
        key: Words of the key of the robot's random draws (2,).
        time_ns: Time of the burst [ns].
        channel: Number of the sensor.
    """
    nearest = cast(scene, sensors, centre, sonar, beams, channel, 0)
    if nearest == math.inf:
        return NO_ECHO
    if nearest < NEAREST:
        return TOO_NEAR
    own_key: Any = key[0] ^ _KEY_MASK, key[1]
    reading = round(nearest * 100 + _NOISE_CM * draws(tables, own_key, time_ns // PERIOD_NS)[0])
    return NO_ECHO if reading > RANGE * 100 else max(reading, _NEAREST_CM)


@compilable
def cast(
    scene: BeamScene,
    sensors: RobotSensors,
    centre: tuple[float, float, float],
    sonar: Sonar,
    beams: Beams,
    channel: int,
    first_ray: int,
) -> float:
    """Cast rays from a first one on; return the distance of the nearest audible obstacle [m], or infinity."""
    frame, n_rays = body_frame(scene, sensors), len(sonar.gains)
    offset = _rotate(frame, sonar.positions, channel)
    origin = centre[0] + offset[0], centre[1] + offset[1], centre[2] + offset[2]
    for index in range(len(beams.lengths)):
        x, y, z = _rotate(frame, sonar.rays, channel * n_rays + first_ray + index)
        beams.vectors[3 * index] = x
        beams.vectors[3 * index + 1] = y
        beams.vectors[3 * index + 2] = z
    cast_rays(scene, sensors, beams, origin, 1.1 * RANGE)
    nearest, vectors, normals = math.inf, beams.vectors, beams.normals
    for index in range(len(beams.lengths)):
        distance, gain = beams.lengths[index], sonar.gains[first_ray + index]
        if not 0 < distance < nearest:
            continue
        ratio = RANGE / distance
        if gain * (ratio + _SCATTER * ratio * ratio) < _SURELY_SILENT:
            continue
        first = 3 * index
        cosine = normals[first] * vectors[first] + normals[first + 1] * vectors[first + 1]
        cosine = min(abs(cosine + normals[first + 2] * vectors[first + 2]), 1.0)
        angle = math.acos(cosine) / _REFLECTION_RAD
        loudness = math.exp(-(angle * angle)) * ratio + _SCATTER * (cosine * cosine) * (ratio * ratio)
        if gain * loudness >= 1:
            nearest = distance
    return nearest


@compilable
def _rotate(frame: Sequence[float], vectors: Sequence[float], index: int) -> tuple[float, float, float]:
    """Return a vector of the robot's frame in the world frame."""
    x, y, z = vectors[3 * index], vectors[3 * index + 1], vectors[3 * index + 2]
    return (
        x * frame[0] + y * frame[1] + z * frame[2],
        x * frame[3] + y * frame[4] + z * frame[5],
        x * frame[6] + y * frame[7] + z * frame[8],
    )


def make_sonar() -> Sonar:
    """Return the rays of the sensors."""
    angles = [(el, az) for el in _ELEVATIONS.tolist() for az in _AZIMUTHS.tolist()]
    positions: list[float] = []
    rays: list[float] = []
    for *position, heading in SONAR.places:
        positions += position
        for el, az in angles:
            rays += cos(el) * cos(heading + az), cos(el) * sin(heading + az), sin(el)
    return Sonar(positions, rays, [(cos(el) * cos(az)) ** (2 * _BEAM_EXPONENT) for el, az in angles])
