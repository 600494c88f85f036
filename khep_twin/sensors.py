"""The infrared sensors: from rays and lamps to the counts of the converter.

Proximity is reflected light less the ambient light, clipped at both ends (the form is fitted to a real robot,
the numbers are in assets/calibration):

    counts = clip(gain sum_i w_i rho_i cos(phi_i)^m / (d_i + offset)^2 - threshold + noise, idle, limit)

over the rays i of a sensor's cone: length d_i, incidence phi_i, reflectance rho_i of what it hits and weight
w_i = cos(theta_i)^n / sum, theta_i off the axis; idle is the noise with nothing in reach, and no reading
is below the calibration's floor, which is 0 except for a Khepera II. Ambient counts are high in the dark, and
saturate:

    counts = clip(max(dark - light, floor) + noise, 0, ceiling)

with the light of lamps as in `ambient`. A sensor's proximity is the difference of two such readings, with
its emitter on and off; so in bright light its limit falls by (dark - light - floor) / (dark - floor), to 0
where ambient light alone saturates it. Not modelled: light reflected off walls, the cone's vertical width.
"""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.optics import Proximity
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import LENGTH_AND_NORMAL


def proximity_optics(model: mujoco.MjModel, robot: RobotIndices, calibration: Calibration) -> Proximity:
    """Return the numbers of a robot's proximity in a scene."""
    numbers = calibration.proximity
    weights: list[list[float]] = []
    tangential: list[list[float]] = []
    for channel, camera in enumerate(robot.cameras):
        tangents = ray_tangents(model, camera)
        tangential.append(tangents.tolist())
        weights.append(lobe_weights(tangents, numbers.lobe_exponent[channel]))
    # Rays hit what is visible, except the floor and the robot's own body; its turrets are included.
    upright = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    seen = model.geom_user[(model.geom_rgba[:, 3] > 0) & upright & (model.geom_bodyid != robot.base), 0]
    brightest, n_rays = float(seen.max(initial=0.0)), len(tangential[0])
    return Proximity(
        gain=[gain * 1e-6 for gain in numbers.gain_counts_mm2],
        threshold=list(numbers.threshold_counts),
        offset=[offset * 1e-3 for offset in numbers.offset_mm],
        incidence_exponent=list(numbers.incidence_exponent),
        limit=numbers.limit_counts,
        floor=numbers.floor_counts,
        quantum=numbers.quantum_counts,
        noise=numbers.noise_counts,
        idle=numbers.idle_counts,
        weights=weights,
        tangential=tangential,
        brightest=brightest,
        uniform=bool(np.all(seen == brightest)),
        found=[0.0] * (LENGTH_AND_NORMAL * n_rays),
        directions=[0.0] * (3 * n_rays),
        incidences=[0.0] * n_rays,
        reflectances=[brightest] * n_rays,
    )


def ray_tangents(model: mujoco.MjModel, camera: int) -> NDArray[np.float64]:
    """Return the tangents of a sensor's rays (width,), which go through the camera's pixels, left to right.

    They are computed as in MuJoCo, so that a ray that is cast again is the same to the last bit.
    """
    width, height = map(int, model.cam_resolution[camera])
    focal_length = height / 2 / math.tan(float(model.cam_fovy[camera]) * math.pi / 360)
    return (np.arange(width, dtype=np.float64) + 0.5 - width / 2) / focal_length


def lobe_weights(tangents: NDArray[np.float64], exponent: float) -> list[float]:
    """Return the weights w_i of a cone's rays, from the tangents of their angles off the axis (n_rays,)."""
    weights = np.cos(np.arctan(tangents)) ** exponent
    return (weights / weights.sum()).tolist()
