"""The infrared sensors: from reflected light and lamps to the counts of the converter.

Proximity is reflected light less the ambient light, clipped at both ends (the form is fitted to real robots,
the numbers are in assets/calibration):

    counts = clip(gain light - threshold + noise, idle, limit)

with the light of `sensing.reflection`, an integral over all visible surfaces, seen from the chip, `offset`
behind its face. `idle` is the noise with nothing in reach. No reading is below the calibration's floor; a
negative one, of reflected less ambient light with a sign, is added to `idle`. Ambient counts are high in the
dark, and saturate:

    counts = clip(max(dark - light, floor) + noise, 0, ceiling)

with the light of lamps as in `ambient`. A sensor's proximity is the difference of two of these readings, with
its emitter on and off. So its limit falls by (dark - light - floor) / (dark - floor) in bright light, to 0
where ambient light alone saturates it. The threshold includes the light of the floor. Where a calibration has
`floor_light_counts`, a part of it and the mirror images of objects depend on the floor's reflectance. Not
modelled: light reflected more than once, except by the floor.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from khep_twin.playpen import RobotEntry
from khep_twin.sensing import lobes
from khep_twin.sensing.ambient import ambient_optics
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import DeviceFaults
from khep_twin.sensing.mujoco_scene import visible_geoms
from khep_twin.sensing.optics import NEGLIGIBLE
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import Proximity, RobotSensors
from khep_twin.sensing.seen_surfaces import N_COLUMNS, N_SURFACES

_RANGE = 1.5
"""Range of a sensor, in distances at which an endless wall gives as much light as the threshold."""


def robot_sensors(model: mujoco.MjModel, robot: RobotIndices, calibration: Calibration) -> RobotSensors:
    """Return the infrared sensors of a robot in a scene."""
    optics = proximity_optics(model, robot, calibration), ambient_optics(calibration.ambient)
    return RobotSensors(robot.base, list(robot.cameras), *optics)


class RobotFields:
    """Fields of a core's state that most models have.

    Attributes:
        angles: Indices of the wheels' positions, left and right (2,).
        speeds: Indices of the wheels' speeds (2,).
        motors: Indices of the motors (2,).
        pose: Index of the robot's pose.
        radius: Radius of the robot [m].
        motor_constant: Torque per current [N m/A].
        sensors: Infrared sensors.
        faults: Faults of sensors and motors.
        noise: Key of the robot's random draws, as two words (2,).
    """

    angles: Sequence[int]
    speeds: Sequence[int]
    motors: Sequence[int]
    pose: int
    radius: float
    motor_constant: float
    sensors: RobotSensors
    faults: DeviceFaults
    noise: Vector[int]


def core_fields(
    model: mujoco.MjModel,
    robot: RobotIndices,
    calibration: Calibration,
    entry: RobotEntry,
    first_moment: int,
) -> dict[str, Any]:
    """Return the `RobotFields` of a core's state; the arguments are those of `make_state`."""
    return {
        "angles": list(robot.wheel_qpos),
        "speeds": list(robot.wheel_dofs),
        "motors": list(robot.motors),
        "pose": robot.pose,
        "radius": entry.body.radius,
        "motor_constant": calibration.motors.constant,
        "sensors": robot_sensors(model, robot, calibration),
        "faults": DeviceFaults.of(entry.body),
        "noise": np.zeros(2, np.int64),
    }


def proximity_optics(model: mujoco.MjModel, robot: RobotIndices, calibration: Calibration) -> Proximity:
    """Return the parameters of a robot's proximity sensors in a scene."""
    proximity = calibration.proximity
    # The robot's own body is not seen; its turrets are.
    geoms = [geom for geom in visible_geoms(model) if model.geom_bodyid[geom] != robot.base]
    brightest = float(model.geom_user[geoms, 0].max(initial=0.0))
    exponents = proximity.lobe_exponent
    gains = [gain * 1e-6 for gain in proximity.gain_counts_mm2]
    return Proximity(
        gain=gains,
        bound=[
            gain * brightest * lobes.width(exponent) / lobes.norm(exponent) * max(proximity.mirror, 1.0)
            for gain, exponent in zip(gains, exponents, strict=True)
        ],
        threshold=list(proximity.threshold_counts),
        offset=[offset * 1e-3 for offset in proximity.offset_mm],
        reach=[
            _RANGE * math.sqrt(gain * brightest / max(threshold, NEGLIGIBLE))
            for gain, threshold in zip(gains, proximity.threshold_counts, strict=True)
        ],
        exponent=[int(exponent) for exponent in exponents],
        fraction=[exponent - int(exponent) for exponent in exponents],
        norm=[lobes.norm(exponent) for exponent in exponents],
        width=[lobes.width(exponent) / lobes.norm(exponent) for exponent in exponents],
        table=[lobes.table(exponent) for exponent in exponents],
        limit=proximity.limit_counts,
        floor=proximity.floor_counts,
        quantum=proximity.quantum_counts,
        noise=list(proximity.noise_counts),
        noise_growth=proximity.noise_growth,
        idle=proximity.idle_counts,
        saturates=int(proximity.saturates),
        floor_light=list(proximity.floor_light_counts or [0.0] * len(gains)),
        narrowing=proximity.elevation_exponent // 2 - 1,
        mirror=proximity.mirror,
        surfaces=[0.0] * (N_SURFACES * N_COLUMNS),
    )
