"""Ambient light: what lamps give to the receivers of a robot's infrared sensors.

    light = sum over lamps of gain P v [(1 - s) cos(theta)^n + s (1 + cos(theta)) / 2] / (r - offset)^2

in counts below the dark level, with lamp power P, distance r from the receiver to the bulb's centre, theta
off the receiver's axis in space, and v the part of the bulb that is in sight. The part s comes in by other
ways than straight ahead, as from a lamp overhead. What is on the other side of a wall gives nothing.

The toolbox's law, for comparison, has no shadows and no height:

    light = sum over lamps of gain P f(theta) / (r - offset)^2
    f = 1 up to min_angle, cos(theta 90 degrees / max_angle) up to max_angle, 0 beyond
"""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.calibration import AmbientCalibration
from khep_twin.lamps import Lamps
from khep_twin.playpen import Lighting
from khep_twin.sightlines import SightLines
from khep_twin.units import BULB_RADIUS, Sensor, radians

_NOTHING = 0.5
"""Less than half a count is not worth a ray."""

_FAINT = 30.0
"""Light of so few counts has shadows with hard edges: their softness would be lost in the noise."""

_CLOSEST_MM = 1.0
"""A lamp that would be nearer than this counts as so near."""


def received(distance: float, cosine: float, channel: int, calibration: AmbientCalibration) -> float:
    """What a lamp of 1 W in full sight takes off the dark level [counts/W].

    Args:
        distance: from the receiver to the bulb's centre [m].
        cosine: of the lamp's direction off the receiver's axis.
        channel: of the sensor.
        calibration: of the receivers.
    """
    straight = cosine ** calibration.lobe_exponent[channel] if cosine > 0 else 0.0
    lobe = (1 - calibration.diffuse) * straight + calibration.diffuse * (1 + cosine) / 2
    return lobe * _falling_off(distance, channel, calibration)


def received_by_toolbox(
    distance: float, cosine: float, channel: int, calibration: AmbientCalibration, lighting: Lighting
) -> float:
    """The same by the toolbox's law, with distance and angle as on a map."""
    angle_deg = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    lobe = 1.0
    if angle_deg > lighting.max_angle_deg:
        lobe = 0.0
    elif angle_deg > lighting.min_angle_deg:
        lobe = math.cos(math.radians(angle_deg * 90 / lighting.max_angle_deg))
    return lobe * _falling_off(distance, channel, calibration)


class Receivers:
    """The eight receivers of one robot in a compiled scene.

    Args:
        model: the scene.
        data: its state.
        prefix: of the robot's names in the scene, e.g. "khepera0/".
        calibration: of this robot's receivers.
        lamps: that may shine on them.
        lighting: by which law.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str,
        calibration: AmbientCalibration,
        lamps: Lamps,
        lighting: Lighting,
    ) -> None:
        self._model, self._data = model, data
        self._calibration, self._lamps, self._lighting = calibration, lamps, lighting
        self._sight_lines = SightLines(model, prefix, lamps.positions)
        self._bulb, self._ray = np.zeros((3, 3)), np.zeros(3)
        self._few, self._many = _Disc(_rim()), _Disc(_seeds(64))
        self._body = model.body(prefix + "base").id
        self._frame: NDArray[np.float64] = data.xmat[self._body]
        cameras = [model.camera(prefix + sensor.name.lower()).id for sensor in Sensor]
        self._positions: list[NDArray[np.float64]] = [data.cam_xpos[camera] for camera in cameras]
        self._axes = [(math.cos(angle), math.sin(angle)) for angle in map(radians, calibration.heading_deg)]

    def light(self, channel: int) -> float:
        """What all lamps together take off the dark level of one receiver [counts]."""
        if not self._lamps.positions:
            return 0.0
        x, y, z = self._positions[channel].tolist()
        frame = self._frame.tolist()
        ahead, left = self._axes[channel]
        axis_x = ahead * frame[0] + left * frame[1]
        axis_y = ahead * frame[3] + left * frame[4]
        axis_z = ahead * frame[6] + left * frame[7]
        calibration = self._calibration
        flat = self._lighting.law == "toolbox"
        total = 0.0
        for lamp, power in enumerate(self._lamps.powers):
            if not power:
                continue
            lamp_x, lamp_y, lamp_z = self._lamps.positions[lamp]
            way = dx, dy, dz = lamp_x - x, lamp_y - y, 0.0 if flat else lamp_z - z
            distance = math.sqrt(dx * dx + dy * dy + dz * dz) or BULB_RADIUS
            cosine = (dx * axis_x + dy * axis_y + dz * axis_z) / distance
            if flat:
                total += power * received_by_toolbox(distance, cosine, channel, calibration, self._lighting)
                continue
            counts = power * received(distance, cosine, channel, calibration)
            if counts > _NOTHING and self._sight_lines.clear(lamp, x, y):
                total += counts
            elif counts >= _FAINT:
                total += counts * self._in_sight(channel, way, distance)
            elif counts > _NOTHING and self._centre_in_sight(channel, way, distance):
                total += counts
        return total

    def _in_sight(self, channel: int, way: tuple[float, float, float], distance: float) -> float:
        """Which part of a bulb a receiver sees, 0 to 1."""
        # Mostly all or nothing is in sight; the edge of a shadow is looked at more closely.
        seen = self._reached(channel, way, distance, self._few)
        return seen if seen in (0.0, 1.0) else self._reached(channel, way, distance, self._many)

    def _centre_in_sight(self, channel: int, way: tuple[float, float, float], distance: float) -> bool:
        self._ray[0], self._ray[1], self._ray[2] = way
        hit = mujoco.mj_ray(
            self._model,
            self._data,
            self._positions[channel],
            self._ray,
            _WITHOUT_WHEELS,
            True,
            self._body,
            None,
        )
        return not 0 <= hit < 1 - BULB_RADIUS / distance

    def _reached(
        self, channel: int, way: tuple[float, float, float], distance: float, disc: "_Disc"
    ) -> float:
        """Which part of some points of a bulb's disc rays from the receiver reach."""
        x, y, z = way
        flat, frame, scale = math.sqrt(x * x + y * y), self._bulb, BULB_RADIUS / distance
        # To the left and up, as seen from the receiver, and ahead; right below a lamp any left will do.
        if flat > 0:
            side = BULB_RADIUS / flat
            frame[0, 0], frame[0, 1] = -y * side, x * side
            tilt = -z * scale / flat
            frame[1, 0], frame[1, 1], frame[1, 2] = x * tilt, y * tilt, flat * scale
        else:
            frame[0, 0], frame[0, 1] = BULB_RADIUS, 0.0
            frame[1, 0], frame[1, 1], frame[1, 2] = 0.0, BULB_RADIUS, 0.0
        frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z
        np.matmul(disc.points, frame, out=disc.rays)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self._positions[channel],
            disc.flat,
            _WITHOUT_WHEELS,
            True,
            self._body,
            disc.geoms,
            disc.hits,
            None,
            len(disc.hits),
            1.0 + scale,
        )
        # Hits are told in lengths of the rays. One as near as the bulb's glass has reached it.
        glass = 1 - scale
        hits = disc.hits.tolist()
        blocked = 0
        for hit in hits:
            blocked += 0 <= hit < glass
        return 1 - blocked / len(hits)


class _Disc:
    """Points of a disc of radius 1, and room for rays to them."""

    def __init__(self, points: NDArray[np.float64]) -> None:
        n = len(points)
        self.points = np.column_stack([points, np.ones(n)])
        self.rays = np.zeros((n, 3))
        self.flat = self.rays.ravel()
        self.hits = np.zeros(n)
        self.geoms = np.zeros(n, np.int32)


def _rim() -> NDArray[np.float64]:
    """Nine points that tell whether all of a disc is in sight, or nothing: its middle, and near its edge."""
    turns = np.arange(8) * math.pi / 4
    return np.concatenate([[[0.0, 0.0]], 0.97 * np.column_stack([np.cos(turns), np.sin(turns)])])


def _seeds(n: int) -> NDArray[np.float64]:
    """Points spread evenly, as a sunflower has its seeds, left as right."""
    seeds = np.arange(n // 2)
    turns, radii = seeds * math.pi * (3 - math.sqrt(5)), np.sqrt((seeds + 0.5) / len(seeds))
    half = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)])
    return np.concatenate([half, half * (-1, 1)])


def _falling_off(distance: float, channel: int, calibration: AmbientCalibration) -> float:
    reach_mm = max(distance * 1e3 - calibration.offset_mm, _CLOSEST_MM)
    return calibration.gain_counts_mm2_per_w[channel] / reach_mm**2


_WITHOUT_WHEELS = np.array([1, 0, 1, 1, 1, 1], np.uint8)
"""Groups of geoms that stop light: a robot's own wheels belong to how its receivers were measured, those of
others are within their bodies."""
