"""Ultrasonic sensors of the Khepera IV: the first echo of a burst that is loud enough.

Rays fill the beam. One that meets a surface at a distance d and an incidence phi, theta off the axis, returns

    loudness = D(theta)^2 (m(phi) (R / d) + s cos(phi)^2 (R / d)^2)
    D(theta) = cos(theta)^k,  m(phi) = exp(-(phi / phi0)^2)

beside a wall face to face at the range R = 2.5 m (manual), which has 1 and can just be heard: what a smooth
surface mirrors, and a part s = 0.03 that edges and roughness scatter (s and phi0 = 12 degrees assumed). The
transducer hears half as much 42.5 degrees off its axis (of its kind, assumed), so k = 2.27. So a wall is
missed beyond half a metre when it stands oblique; the floor and what is painted on it always are.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.khepera4.channels import CODES
from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.sensing.mujoco_scene import PAINT
from khep_twin.sensing.noise import TABLES, draws
from khep_twin.sensing.robot_indices import RobotIndices

PERIOD_NS = 20_000_000
"""Turn of each enabled sensor [ns] (manual)."""

RANGE, NEAREST = 2.5, 0.25
"""Longest and shortest distance that is measured [m] (manual)."""

TOO_NEAR, NOTHING, DISABLED = CODES

HEADINGS_DEG = (90, 45, 0, -45, -90)
"""Heading of each sensor, left to right (manual)."""

RADIUS, HEIGHT = 0.066, 0.0445
"""Place of the sensors: distance from the centre (assumed) and height [m] (drawing)."""

_EXPONENT, _MIRROR_RAD, _SCATTER = 2.27, math.radians(12), 0.03
_NOISE = 0.4
"""Standard deviation of a distance [cm] (assumed; the manual has 2 cm for its error)."""

_KEY = 0x9E3779B9
"""Word that tells their random draws from those of other sensors: any."""

_AZIMUTHS, _ELEVATIONS = np.radians(np.arange(-42, 43, 3)), np.radians(np.arange(-12, 13, 6))


class Ultrasonic:
    """The five sensors of one robot.

    Args:
        past: Scene that they measure.
        indices: Indices of the robot.
        key: Words of the key of its random draws.
        is_noisy: Whether they have noise.
    """

    def __init__(self, past: PastScene, indices: RobotIndices, key: Sequence[int], is_noisy: bool) -> None:
        self._past, self._base = past, indices.base
        model = past.model
        self._is_floor = (model.geom_bodyid == 0) & (model.geom_pos[:, 2] < PAINT)
        self._key, self._tables = [key[0] ^ _KEY, key[1]], TABLES[is_noisy]
        self._places, self._rays, self._beam = _beams()
        count = len(self._beam)
        self._met, self._away = np.zeros(count, np.int32), np.zeros(count)
        self._normals = np.zeros((count, 3))

    def measure(self, moment: Moment, channel: int) -> int:
        """Return the reading of a sensor at a moment [cm], or a code."""
        past = self._past
        past.move_to(moment)
        turn: NDArray[np.float64] = past.data.xmat[self._base].reshape(3, 3)
        place = past.data.xpos[self._base] + _turned(turn, self._places[channel : channel + 1])[0]
        rays = _turned(turn, self._rays[channel])
        away, normals = self._away, self._normals
        mujoco.mj_multiRay(
            past.model,
            past.data,
            place,
            np.ascontiguousarray(rays).ravel(),
            None,
            True,
            self._base,
            self._met,
            away,
            normals.ravel(),
            len(away),
            RANGE * 1.1,
        )
        met = (away > 0) & ~self._is_floor[self._met]
        if not met.any():
            return NOTHING
        distances, across = away[met], np.abs((normals[met] * rays[met]).sum(axis=1)).clip(0, 1)
        far = RANGE / distances
        mirrored = np.exp(-((np.arccos(across) / _MIRROR_RAD) ** 2)) * far
        loud = self._beam[met] * (mirrored + _SCATTER * across**2 * far**2) >= 1
        if not loud.any():
            return NOTHING
        number = moment.time_ns // PERIOD_NS
        noise = _NOISE * draws(self._tables, self._key, number)[0]
        distance = float(distances[loud].min())
        if distance < NEAREST:
            return TOO_NEAR
        reading = round(distance * 100 + noise)
        return NOTHING if reading > RANGE * 100 else max(reading, round(NEAREST * 100))


def _beams() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return places (5, 3) and rays (5, n, 3) of the sensors in the robot's frame, and the beam (n,)."""
    places: list[tuple[float, float, float]] = []
    rays: list[list[tuple[float, float, float]]] = []
    for heading in map(math.radians, HEADINGS_DEG):
        places.append((RADIUS * math.cos(heading), RADIUS * math.sin(heading), HEIGHT))
        rays.append(
            [
                (
                    math.cos(up) * math.cos(heading + aside),
                    math.cos(up) * math.sin(heading + aside),
                    math.sin(up),
                )
                for up in _ELEVATIONS.tolist()
                for aside in _AZIMUTHS.tolist()
            ]
        )
    beam = [
        (math.cos(up) * math.cos(aside)) ** (2 * _EXPONENT)
        for up in _ELEVATIONS.tolist()
        for aside in _AZIMUTHS.tolist()
    ]
    return np.array(places), np.array(rays), np.array(beam)


def _turned(turn: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors (n, 3) in the world's frame; element by element, with the same bits on any machine."""
    return vectors[:, :1] * turn[:, 0] + vectors[:, 1:2] * turn[:, 1] + vectors[:, 2:] * turn[:, 2]
