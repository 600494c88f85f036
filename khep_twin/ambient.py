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
from khep_twin.units import BULB_RADIUS, Sensor, radians

_NOTHING = 0.5
"""Less than half a count is not worth a ray."""

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
        axis_x, axis_y, axis_z = (ahead * frame[row] + left * frame[row + 1] for row in (0, 3, 6))
        flat = self._lighting.law == "toolbox"
        total = 0.0
        for (lamp_x, lamp_y, lamp_z), power in zip(self._lamps.positions, self._lamps.powers, strict=True):
            if not power:
                continue
            dx, dy, dz = lamp_x - x, lamp_y - y, 0.0 if flat else lamp_z - z
            distance = math.sqrt(dx * dx + dy * dy + dz * dz) or BULB_RADIUS
            cosine = (dx * axis_x + dy * axis_y + dz * axis_z) / distance
            if flat:
                total += power * received_by_toolbox(
                    distance, cosine, channel, self._calibration, self._lighting
                )
            elif (counts := power * received(distance, cosine, channel, self._calibration)) > _NOTHING:
                total += counts * self._in_sight(channel, np.array([dx, dy, dz]), distance)
        return total

    def _in_sight(self, channel: int, vector: NDArray[np.float64], distance: float) -> float:
        """Which part of a bulb a receiver sees, 0 to 1."""
        # Mostly all or nothing is in sight; the edge of a shadow is looked at more closely.
        for points in (_FEW_POINTS, _MANY_POINTS):
            seen = self._reached(channel, vector, distance, points)
            if seen in (0.0, 1.0):
                break
        return seen

    def _reached(
        self, channel: int, vector: NDArray[np.float64], distance: float, points: NDArray[np.float64]
    ) -> float:
        """Which part of some points of a bulb's disc (n, 2) rays from the receiver reach."""
        across = np.array([-vector[1], vector[0], 0.0])
        width = math.hypot(vector[0], vector[1])
        across = across / width if width > 0 else np.array([1.0, 0.0, 0.0])
        up = np.cross(vector, across) / distance
        rays = vector + points @ (BULB_RADIUS * np.array([across, up]))
        lengths = np.sqrt((rays * rays).sum(axis=1))
        hits, geoms = np.zeros(len(points)), np.zeros(len(points), np.int32)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self._positions[channel],
            (rays / lengths[:, None]).ravel(),
            _WITHOUT_WHEELS,
            True,
            self._body,
            geoms,
            hits,
            None,
            len(points),
            distance + BULB_RADIUS,
        )
        # A ray that comes as near as the bulb's glass has reached it.
        reached = (hits < 0) | (hits >= lengths - BULB_RADIUS)
        return float(reached.mean())


def _falling_off(distance: float, channel: int, calibration: AmbientCalibration) -> float:
    reach_mm = max(distance * 1e3 - calibration.offset_mm, _CLOSEST_MM)
    return calibration.gain_counts_mm2_per_w[channel] / reach_mm**2


def _disc(n: int) -> NDArray[np.float64]:
    """Points spread evenly over a disc of radius 1 (n, 2): a sunflower's seeds."""
    turns = np.arange(n) * math.pi * (3 - math.sqrt(5))
    radii = np.sqrt((np.arange(n) + 0.5) / n)
    return np.column_stack([radii * np.cos(turns), radii * np.sin(turns)])


_WITHOUT_WHEELS = np.array([1, 0, 1, 1, 1, 1], np.uint8)
"""Groups of geoms that stop light: a robot's own wheels belong to how its receivers were measured, those of
others are within their bodies."""

_FEW_POINTS, _MANY_POINTS = _disc(16), _disc(256)
"""Of a bulb."""
