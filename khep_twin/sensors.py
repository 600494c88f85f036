"""The infrared sensors: from rays and lamps to the counts of the converter.

Proximity is reflected light less the ambient light, cut off at both ends (the form is fitted to a real robot,
the numbers are in assets/calibration):

    counts = clip(gain sum_i w_i rho_i cos(phi_i)^m / (d_i + offset)^2 - threshold + noise, idle, limit)

over the rays i of a sensor's cone: length d_i, incidence phi_i, reflectance rho_i of what it hits and weight
w_i = cos(theta_i)^n / sum, theta_i off the axis; idle is the noise left with nothing in reach. Ambient light
is dark at high counts, and saturates:

    counts = clip(max(dark - light, floor) + noise, 0, ceiling)

with the light of lamps as in `ambient`. What a sensor reads as proximity is the difference of two such
readings, with its emitter on and off; so in bright light its limit falls by (dark - light - floor) /
(dark - floor), to 0 where ambient light alone saturates it. Left out: light reflected off walls, the cone's
vertical width.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.ambient import Receivers
from khep_twin.calibration import Calibration
from khep_twin.units import Sensor

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
        receivers: of the light of lamps.
        noise: gives the chance for "proximity", "idle" and "ambient" counts, None for no noise.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str,
        calibration: Calibration,
        receivers: Receivers,
        noise: Callable[[str], np.random.Generator] | None,
    ) -> None:
        reflectances: NDArray[np.float64] = model.geom_user[:, 0]
        self._sensors = [_Sensor(model, data, prefix, sensor.name.lower(), reflectances) for sensor in Sensor]
        self._calibration, self._receivers = calibration, receivers
        self._proximity_noise = _draws(noise("proximity").standard_normal if noise else None)
        self._idle_noise = _draws(noise("idle").standard_exponential if noise else None)
        self._ambient_noise = _draws(noise("ambient").standard_normal if noise else None)
        self._weights = [
            lobe_weights(sensor.tangents, exponent)
            for sensor, exponent in zip(self._sensors, calibration.proximity.lobe_exponent, strict=True)
        ]

    def convert(self, channel: int) -> tuple[int, int]:
        """Proximity and ambient counts of one sensor, as of the pose at the start of the last step."""
        calibration = self._calibration.ambient
        noise = calibration.noise_counts * next(self._ambient_noise)
        level = max(calibration.dark_counts - self._receivers.light(channel), calibration.floor_counts)
        range_left = (level - calibration.floor_counts) / (calibration.dark_counts - calibration.floor_counts)
        ambient = max(min(round(level + noise), calibration.ceiling_counts), 0)
        return self._proximity(self._sensors[channel], channel, range_left), ambient

    def _proximity(self, sensor: "_Sensor", channel: int, range_left: float) -> int:
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
        quantum, limit = calibration.quantum_counts, int(calibration.limit_counts * range_left)
        counts = min(round(min(level, limit) / quantum) * quantum, limit)
        return max(counts, min(int(idle), limit), 0)


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


def lobe_weights(tangents: NDArray[np.float64], exponent: float) -> list[float]:
    """Weights w_i of a cone's rays, from the tangents of their angles off the axis (n_rays,)."""
    weights = np.cos(np.arctan(tangents)) ** exponent
    return (weights / weights.sum()).tolist()


class _Sensor:
    """One sensor's view into the scene: its rays."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str,
        name: str,
        reflectances: NDArray[np.float64],
    ) -> None:
        camera = model.camera(prefix + name)
        rays = model.sensor(prefix + name + "_rays")
        first, size = int(rays.adr[0]), int(rays.dim[0])
        n_rays = size // _LENGTH_AND_NORMAL
        self._model, self._data = model, data
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
