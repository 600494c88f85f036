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

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.khepera4.channels import ULTRASONIC_CODES
from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.sensing.mujoco_scene import PAINT_HEIGHT
from khep_twin.sensing.noise import draws, plain_tables
from khep_twin.sensing.robot_indices import RobotIndices

PERIOD_NS = 20_000_000
"""Time from one burst to the next [ns]: enabled sensors alternate (manual)."""

RANGE, NEAREST = 2.5, 0.25
"""Longest and shortest measured distance [m] (manual)."""

TOO_NEAR, NO_ECHO, DISABLED = ULTRASONIC_CODES

HEADINGS_DEG = (90, 45, 0, -45, -90)
"""Heading of each sensor, left to right (manual)."""

RADIUS, HEIGHT = 0.066, 0.0445
"""Position of the sensors: distance from the centre (assumed) and height [m] (drawing)."""

_BEAM_EXPONENT, _REFLECTION_RAD, _SCATTER = 2.27, math.radians(12), 0.03
_NOISE_CM = 0.4
"""Standard deviation of a distance [cm] (assumed; the manual states an error of 2 cm)."""

_KEY_MASK = 0x9E3779B9
"""Arbitrary word that separates their random draws from those of other sensors."""

_AZIMUTHS, _ELEVATIONS = np.radians(np.arange(-42, 43, 3)), np.radians(np.arange(-12, 13, 6))


class Ultrasonic:
    """The five sensors of one robot.

    Args:
        scene: Scene that they measure.
        indices: Indices of the robot.
        key: Words of the key of the robot's random draws.
        noise: Scale of the readings' noise, 0 for none.
    """

    def __init__(self, scene: PastScene, indices: RobotIndices, key: Sequence[int], noise: float) -> None:
        self._scene = scene
        self._base = indices.base
        model = scene.model
        self._is_floor = (model.geom_bodyid == 0) & (model.geom_pos[:, 2] < PAINT_HEIGHT)
        self._key = [key[0] ^ _KEY_MASK, key[1]]
        self._tables = plain_tables(noise)
        self._positions, self._rays, self._ray_gains = _make_beams()
        n_rays = len(self._ray_gains)
        self._geoms = np.zeros(n_rays, np.int32)
        self._ray_lengths = np.zeros(n_rays)
        self._normals = np.zeros((n_rays, 3))

    def measure(self, moment: Moment, channel: int) -> int:
        """Return the reading of a sensor at a moment [cm], or a code."""
        scene = self._scene
        scene.move_to(moment)
        rotation: NDArray[np.float64] = scene.data.xmat[self._base].reshape(3, 3)
        position = scene.data.xpos[self._base] + _rotate(rotation, self._positions[channel : channel + 1])[0]
        rays = _rotate(rotation, self._rays[channel])
        ray_lengths, normals = self._ray_lengths, self._normals
        model, data, base, geoms = scene.model, scene.data, self._base, self._geoms
        vectors, n_rays = np.ascontiguousarray(rays).ravel(), len(rays)
        outputs = geoms, ray_lengths, normals.ravel()
        mujoco.mj_multiRay(model, data, position, vectors, None, True, base, *outputs, n_rays, RANGE * 1.1)
        is_echo = (ray_lengths > 0) & ~self._is_floor[self._geoms]
        if not is_echo.any():
            return NO_ECHO
        distances = ray_lengths[is_echo]
        cosines = np.abs((normals[is_echo] * rays[is_echo]).sum(axis=1)).clip(0, 1)
        range_ratio = RANGE / distances
        reflected = np.exp(-((np.arccos(cosines) / _REFLECTION_RAD) ** 2)) * range_ratio
        is_audible = self._ray_gains[is_echo] * (reflected + _SCATTER * cosines**2 * range_ratio**2) >= 1
        if not is_audible.any():
            return NO_ECHO
        burst_number = moment.time_ns // PERIOD_NS
        noise = _NOISE_CM * draws(self._tables, self._key, burst_number)[0]
        distance = float(distances[is_audible].min())
        if distance < NEAREST:
            return TOO_NEAR
        reading = round(distance * 100 + noise)
        return NO_ECHO if reading > RANGE * 100 else max(reading, round(NEAREST * 100))


def _make_beams() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (5, 3), rays (5, n, 3) in the robot's frame, and gains of the rays (n,)."""
    angles = [(el, az) for el in _ELEVATIONS.tolist() for az in _AZIMUTHS.tolist()]
    positions: list[tuple[float, float, float]] = []
    rays: list[list[tuple[float, float, float]]] = []
    for heading in map(math.radians, HEADINGS_DEG):
        positions.append((RADIUS * cos(heading), RADIUS * sin(heading), HEIGHT))
        rays.append(
            [(cos(el) * cos(heading + az), cos(el) * sin(heading + az), sin(el)) for el, az in angles]
        )
    ray_gains = [(cos(el) * cos(az)) ** (2 * _BEAM_EXPONENT) for el, az in angles]
    return np.array(positions), np.array(rays), np.array(ray_gains)


def _rotate(matrix: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate vectors (n, 3) to the world frame, element by element for the same bits on any machine."""
    return vectors[:, :1] * matrix[:, 0] + vectors[:, 1:2] * matrix[:, 1] + vectors[:, 2:] * matrix[:, 2]
