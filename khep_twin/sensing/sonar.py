"""Ultrasonic sensors: the audible echoes of a burst.

Rays sample the beam. A ray at an angle theta to the axis that hits a surface at a distance d and an angle of
incidence phi returns

    loudness = D(theta)^2 (m(phi) (R / d) + s cos(phi)^2 (R / d)^2)
    D(theta) = cos(theta)^k,  m(phi) = exp(-(phi / phi0)^2)

relative to a perpendicular wall at the range R, whose loudness 1 is the detection threshold. The first term
is specular reflection; the second, s = 0.03, is scattered by edges and roughness (s and phi0 = 12 degrees
assumed). The floor and its paint are always missed. Audible rays whose distances differ by less than the
length of a burst belong to one echo.
"""

import math
from collections.abc import Sequence
from math import cos, sin
from typing import Any, NamedTuple, Self

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.robots.body import SonarRing
from khep_twin.sensing.buffers import RobotState, Vector
from khep_twin.sensing.noise import Tables, draws
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams, BeamScene, body_frame, cast_rays, joint_position

_REFLECTION_RAD, _SCATTER = math.radians(12), 0.03

_BURST = 0.07
"""Length of a burst on its way there and back [m]: 16 periods of 40 kHz (assumed)."""

_SURELY_SILENT = 1 - 1e-9
"""Bound of the loudness below which an echo is not heard, with a margin for rounding."""

_KEY_MASK = 0x9E3779B9
"""Arbitrary word that separates their random draws from those of other sensors."""

_AZIMUTHS, _ELEVATIONS = np.radians(np.arange(-42, 43, 3)), np.radians(np.arange(-12, 13, 6))
_N_LEVEL, _FIRST_LEVEL = len(_AZIMUTHS), len(_ELEVATIONS) // 2 * len(_AZIMUTHS)
"""Number of rays of elevation 0, and the first of them."""


class Sonar(NamedTuple):
    """Rays and readings of the ultrasonic sensors of a robot.

    Attributes:
        positions: Positions of the sensors (3 * n_sensors,) [m].
        rays: Unit vectors of their rays in the robot's frame (3 * n * n_sensors,).
        gains: Gains of the rays of a sensor, D(theta)^2 (n,).
        reach: Longest measured distance [m].
        nearest: Shortest measured distance [m].
        noise_cm: Standard deviation of a distance [cm].
        too_near: Reading of a nearer obstacle.
        no_echo: Reading without an echo.
    """

    positions: Sequence[float]
    rays: Sequence[float]
    gains: Sequence[float]
    reach: float
    nearest: float
    noise_cm: float
    too_near: int
    no_echo: int

    @classmethod
    def of(cls, ring: SonarRing, noise_cm: float) -> Self:
        """Return the sensors of a ring."""
        angles = [(el, az) for el in _ELEVATIONS.tolist() for az in _AZIMUTHS.tolist()]
        positions: list[float] = []
        rays: list[float] = []
        for *position, heading in ring.places:
            positions += position
            for el, az in angles:
                rays += cos(el) * cos(heading + az), cos(el) * sin(heading + az), sin(el)
        gains = [(cos(el) * cos(az)) ** (2 * ring.exponent) for el, az in angles]
        return cls(positions, rays, gains, ring.reach, ring.nearest, noise_cm, *ring.codes[:2])


@compilable
def reading_of(sonar: Sonar, distance: float, tables: Tables, key: Vector[int], number: int) -> int:
    """Return the reading of an echo at a distance [cm], or a code; `number` is that of its random draws."""
    if distance == math.inf:
        return sonar.no_echo
    if distance < sonar.nearest:
        return sonar.too_near
    own_key: Any = key[0] ^ _KEY_MASK, key[1]
    reading = round(distance * 100 + sonar.noise_cm * draws(tables, own_key, number)[0])
    return sonar.no_echo if reading > sonar.reach * 100 else max(reading, round(sonar.nearest * 100))


@compilable
def cast_level_rays(robot: RobotState, scene: BeamScene, sensor: int) -> float:
    """Return the distance by level rays, which meet all upright obstacles first, as `Core.echo` does.

    A robot's state has `pose`, `sensors`, `sonar` and `beams`.
    """
    sonar, beams, n_rays = robot.sonar, robot.beams, _N_LEVEL
    vectors, normals = beams.vectors[: 3 * n_rays], beams.normals[: 3 * n_rays]
    level = Beams(vectors, beams.lengths[:n_rays], normals, beams.geoms[:n_rays])
    nearest = cast(scene, robot.sensors, robot.pose, sonar, level, sensor, _FIRST_LEVEL)
    return 0.0 if nearest < sonar.nearest else nearest if nearest <= sonar.reach else math.inf


@compilable
def cast(
    scene: BeamScene, sensors: RobotSensors, pose: int, sonar: Sonar, beams: Beams, sensor: int, first: int
) -> float:
    """Cast rays from a first one on; return the distance of the nearest audible obstacle [m], or infinity."""
    frame, n_rays = body_frame(scene, sensors), len(sonar.gains)
    x, y, z = _rotate(frame, sonar.positions, sensor)
    x, y, z = (
        joint_position(scene, pose) + x,
        joint_position(scene, pose + 1) + y,
        joint_position(scene, pose + 2) + z,
    )
    for index in range(len(beams.lengths)):
        ray = _rotate(frame, sonar.rays, sensor * n_rays + first + index)
        for axis in range(3):
            beams.vectors[3 * index + axis] = ray[axis]
    cast_rays(scene, sensors, beams, (x, y, z), 1.1 * sonar.reach)
    return _nearest_audible(sonar, beams, first, 0.0)[0]


@compilable
def next_echo(sonar: Sonar, beams: Beams, distance: float) -> tuple[float, float]:
    """Return distance [m], or infinity, and loudness of the next echo by the rays of `cast`, all of a sensor.

    The argument is the distance of the last echo, or below 0 for the first one.
    """
    while True:
        end = distance
        distance, loudness = _nearest_audible(sonar, beams, 0, max(end, 0.0))
        if end < 0 or distance > end + _BURST:
            return distance, loudness


@compilable
def _nearest_audible(sonar: Sonar, beams: Beams, first_ray: int, beyond: float) -> tuple[float, float]:
    """Return distance [m] and loudness of the nearest audible obstacle beyond a distance."""
    nearest, loudest, vectors, normals = math.inf, 0.0, beams.vectors, beams.normals
    for index in range(len(beams.lengths)):
        distance, gain = beams.lengths[index], sonar.gains[first_ray + index]
        if not beyond < distance < nearest:
            continue
        ratio = sonar.reach / distance
        if gain * (ratio + _SCATTER * ratio * ratio) < _SURELY_SILENT:
            continue
        first = 3 * index
        cosine = normals[first] * vectors[first] + normals[first + 1] * vectors[first + 1]
        cosine = min(abs(cosine + normals[first + 2] * vectors[first + 2]), 1.0)
        angle = math.acos(cosine) / _REFLECTION_RAD
        loudness = math.exp(-(angle * angle)) * ratio + _SCATTER * (cosine * cosine) * (ratio * ratio)
        if gain * loudness >= 1:
            nearest, loudest = distance, gain * loudness
    return nearest, loudest


@compilable
def _rotate(frame: Sequence[float], vectors: Sequence[float], index: int) -> tuple[float, float, float]:
    """Return a vector of the robot's frame in the world frame."""
    x, y, z = vectors[3 * index], vectors[3 * index + 1], vectors[3 * index + 2]
    return (
        x * frame[0] + y * frame[1] + z * frame[2],
        x * frame[3] + y * frame[4] + z * frame[5],
        x * frame[6] + y * frame[7] + z * frame[8],
    )
