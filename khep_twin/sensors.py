"""The infrared sensors: from rays and lamps to the counts of the converter.

Proximity is reflected light less the ambient light, cut off at both ends (the form is fitted to a real robot,
the numbers are in assets/calibration):

    counts = clip(gain sum_i w_i rho_i cos(phi_i)^m / (d_i + offset)^2 - threshold + noise, idle, limit)

over the rays i of a sensor's cone: length d_i, incidence phi_i, reflectance rho_i of what it hits and weight
w_i = cos(theta_i)^n / sum, theta_i off the axis; idle is the noise left with nothing in reach. Ambient light
is dark at high counts:

    counts = clip(dark - sum_lamps gain P cos(theta)^2 / (r - offset)^2 + noise, floor, ceiling)

with lamp power P, distance r to the bulb's centre and theta off the sensor's axis; a lamp behind something
gives nothing. Left out: light reflected off walls, lamps' effect on proximity, the cone's vertical width.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.calibration import AmbientCalibration, Calibration
from khep_twin.units import BULB_RADIUS, Sensor

_SLACK = 1e-6
"""So much longer a ray may be when it is cast again [m]."""

_LENGTH_AND_NORMAL = 4
"""Numbers per ray that the rangefinders of assets/khepera.xml give."""


class InfraredScan:
    """The eight sensors of one robot in a compiled scene.

    Args:
        model: the scene.
        data: its state.
        prefix: of the robot's names in the scene, e.g. "khepera0/".
        calibration: of this robot's sensors.
        noise: gives the chance for "proximity", "idle" and "ambient" counts, None for no noise.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str,
        calibration: Calibration,
        noise: Callable[[str], np.random.Generator] | None,
    ) -> None:
        lamps = _lamps(model)
        reflectances: NDArray[np.float64] = model.geom_user[:, 0]
        self._sensors = [
            _Sensor(model, data, prefix, sensor.name.lower(), lamps, reflectances) for sensor in Sensor
        ]
        self._calibration = calibration
        self._proximity_noise = _draws(noise("proximity").standard_normal if noise else None)
        self._idle_noise = _draws(noise("idle").standard_exponential if noise else None)
        self._ambient_noise = _draws(noise("ambient").standard_normal if noise else None)
        self._weights = [
            lobe_weights(sensor.tangents, exponent)
            for sensor, exponent in zip(self._sensors, calibration.proximity.lobe_exponent, strict=True)
        ]

    def convert(self, channel: int) -> tuple[int, int]:
        """Proximity and ambient counts of one sensor, as of the pose at the start of the last step."""
        sensor = self._sensors[channel]
        return self._proximity(sensor, channel), self._ambient(sensor)

    def _proximity(self, sensor: "_Sensor", channel: int) -> int:
        calibration = self._calibration.proximity
        noise = calibration.noise_counts * next(self._proximity_noise)
        idle = calibration.idle_counts * next(self._idle_noise)
        level = noise - calibration.threshold_counts[channel]
        nearest, lengths = sensor.lengths()
        gain = calibration.gain_counts_mm2[channel] * 1e-6
        offset = calibration.offset_mm[channel] * 1e-3
        # Most of the time nothing near enough is in view; what cannot pass the threshold is not summed up.
        if nearest < math.inf and gain * sensor.brightest / (nearest + offset) ** 2 > -level:
            directions = sensor.directions()
            level += gain * reflected(
                lengths,
                sensor.incidences(directions),
                sensor.reflectances(directions, max(lengths)),
                self._weights[channel],
                offset,
                calibration.incidence_exponent[channel],
            )
        quantum = calibration.quantum_counts
        return max(min(round(level / quantum) * quantum, calibration.limit_counts), int(idle), 0)

    def _ambient(self, sensor: "_Sensor") -> int:
        calibration = self._calibration.ambient
        noise = calibration.noise_counts * next(self._ambient_noise)
        level = calibration.dark_counts + noise - sensor.light(calibration)
        return max(min(round(level), calibration.ceiling_counts), calibration.floor_counts)


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
            total += lit / (lengths[i] + offset) ** 2
    return total


def illuminance(distance: float, cosine: float, power: float, calibration: AmbientCalibration) -> float:
    """What a lamp in sight takes off the dark level [counts].

    Args:
        distance: from the sensor to the bulb's centre [m].
        cosine: of the lamp's bearing off the sensor's axis.
        power: of the lamp [W].
        calibration: of the sensors.
    """
    if cosine <= 0:
        return 0.0
    reach_mm = max(distance * 1e3 - calibration.offset_mm, 1.0)
    return calibration.gain_counts_mm2_per_w * power * cosine**2 / reach_mm**2


def lobe_weights(tangents: NDArray[np.float64], exponent: float) -> list[float]:
    """Weights w_i of a cone's rays, from the tangents of their angles off the axis (n_rays,)."""
    weights = np.cos(np.arctan(tangents)) ** exponent
    return (weights / weights.sum()).tolist()


class _Sensor:
    """One sensor's views into the scene: its rays and the lamps that it may see."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str,
        name: str,
        lamps: list[tuple[tuple[float, float, float], float]],
        reflectances: NDArray[np.float64],
    ) -> None:
        camera = model.camera(prefix + name)
        rays = model.sensor(prefix + name + "_rays")
        first, size = int(rays.adr[0]), int(rays.dim[0])
        n_rays = size // _LENGTH_AND_NORMAL
        self._model, self._data, self._lamps = model, data, lamps
        self._body = model.body(prefix + "base").id
        self._rays = data.sensordata[first : first + size].reshape(n_rays, _LENGTH_AND_NORMAL)
        self._lengths = self._rays[:, 0]
        self._normals = self._rays[:, 1:]
        self._position: NDArray[np.float64] = data.cam_xpos[camera.id]
        self._frame: NDArray[np.float64] = data.cam_xmat[camera.id]
        self._rotation = self._frame.reshape(3, 3)
        # Rays go through the middles of the camera's pixels, left to right.
        width, height = model.cam_resolution[camera.id].tolist()
        half_width = math.tan(math.radians(float(camera.fovy[0])) / 2) * width / height
        self.tangents: NDArray[np.float64] = ((np.arange(n_rays) + 0.5) / n_rays * 2 - 1) * half_width
        directions = np.column_stack([self.tangents, np.zeros(n_rays), -np.ones(n_rays)])
        self._directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self._reflectances = reflectances
        seen = reflectances[_visible_geoms(model, prefix)]
        self.brightest = float(seen.max(initial=0.0))
        self._uniform = [self.brightest] * n_rays if bool(np.all(seen == self.brightest)) else None
        self._hit_geoms = np.zeros(n_rays, np.int32)
        self._hit_lengths = np.zeros(n_rays)

    def lengths(self) -> tuple[float, list[float]]:
        """The shortest ray and all rays [m]; -1 for a ray that hits nothing, inf if none hits."""
        lengths = self._lengths.tolist()
        nearest = min(lengths)
        if nearest < 0:
            nearest = min([length for length in lengths if length >= 0], default=math.inf)
        return nearest, lengths

    def directions(self) -> NDArray[np.float64]:
        """Where each ray goes in the world (n_rays, 3)."""
        return self._directions @ self._rotation.T

    def incidences(self, directions: NDArray[np.float64]) -> list[float]:
        """Cosine between each ray and the normal of what it hits."""
        return (-np.vecdot(self._normals, directions)).tolist()

    def reflectances(self, directions: NDArray[np.float64], reach: float) -> list[float]:
        """Of what each ray hits within `reach` [m].

        Rangefinders do not tell what they hit, so where it matters the rays are cast again.
        """
        if self._uniform is not None:
            return self._uniform
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self._position,
            directions.ravel(),
            None,
            True,
            self._body,
            self._hit_geoms,
            self._hit_lengths,
            None,
            len(self._hit_geoms),
            reach + _SLACK,
        )
        # A ray that hits nothing has geom -1; its length keeps it out of the sum.
        return self._reflectances[self._hit_geoms].tolist()

    def light(self, calibration: AmbientCalibration) -> float:
        """What all lamps together take off the dark level [counts]."""
        x, y, z = self._position.tolist()
        frame = self._frame.tolist()
        total = 0.0
        for (lamp_x, lamp_y, lamp_z), power in self._lamps:
            dx, dy, dz = lamp_x - x, lamp_y - y, lamp_z - z
            distance = math.sqrt(dx * dx + dy * dy + dz * dz) or _SLACK
            # A camera looks along the negative z axis of its frame.
            cosine = -(dx * frame[2] + dy * frame[5] + dz * frame[8]) / distance
            counts = illuminance(distance, cosine, power, calibration)
            # Less than half a count is not worth a ray.
            if counts >= 0.5 and not self._blocked(np.array([dx, dy, dz]), distance):
                total += counts
        return total

    def _blocked(self, vector: NDArray[np.float64], distance: float) -> bool:
        hit = mujoco.mj_ray(self._model, self._data, self._position, vector, None, True, self._body, None)
        # A ray that comes as near as the bulb's glass has reached it.
        return 0 <= hit * distance < distance - BULB_RADIUS


def _draws(draw: Callable[[int], NDArray[np.float64]] | None) -> Iterator[float]:
    """Endless draws, fetched by the hundred because single ones are slow; zeros without chance."""
    while draw is None:
        yield 0.0
    while True:
        yield from draw(256).tolist()


def _visible_geoms(model: mujoco.MjModel, prefix: str) -> NDArray[np.bool_]:
    """Which geoms the rays of a robot may meet (n_geoms,).

    Those that are shown, but for the floor and the robot's own parts; its turrets may be met.
    """
    shown = model.geom_rgba[:, 3] > 0
    upright = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    own = [model.body(prefix + name).id for name in ("base", "left_wheel", "right_wheel")]
    return shown & upright & ~np.isin(model.geom_bodyid, own)


def _lamps(model: mujoco.MjModel) -> list[tuple[tuple[float, float, float], float]]:
    """Position [m] and power [W] of each lamp of the scene: the sites that carry a power."""
    if model.nuser_site == 0:
        return []
    return [
        (tuple(model.site_pos[i].tolist()), float(power))
        for i, power in enumerate(model.site_user[:, 0])
        if power > 0
    ]
