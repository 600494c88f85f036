"""Transfer of the physical state to another scene: bodies, motors and sensors with the same names.

Bodies, joints and motors keep their positions, speeds and warm starts; new bodies start at their positions in
the new scene. All bodies are awake, as sleeping ones may have lost their support.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false, reportArgumentType=false

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Scene = tuple[mujoco.MjModel, mujoco.MjData]
"""Model and state of a scene."""

_N_POSITIONS = {0: 7, 1: 4, 2: 1, 3: 1}
_N_SPEEDS = {0: 6, 1: 3, 2: 1, 3: 1}
"""Number of values of each type of joint: free, ball, slide, hinge."""


def transfer_state(old: Scene, new: Scene, placed_bodies: Sequence[str]) -> None:
    """Set the state of a new scene to that of an old one, for parts with the same names in both.

    Args:
        old: Scene whose state is transferred.
        new: New scene after a reset.
        placed_bodies: Names of the bodies that keep their poses in the new scene, at rest.
    """
    (model, data), (new_model, new_data) = old, new
    old_joints = _joints_by_body(model)
    for (body, index), joint in _joints_by_body(new_model).items():
        source = old_joints.get((body, index))
        if body in placed_bodies or source is None or model.jnt_type[source] != new_model.jnt_type[joint]:
            continue
        joint_type = int(new_model.jnt_type[joint])
        start, source_start = new_model.jnt_qposadr[joint], model.jnt_qposadr[source]
        _copy(new_data.qpos, start, data.qpos, source_start, _N_POSITIONS[joint_type])
        start, source_start = new_model.jnt_dofadr[joint], model.jnt_dofadr[source]
        _copy(new_data.qvel, start, data.qvel, source_start, _N_SPEEDS[joint_type])
        _copy(new_data.qacc_warmstart, start, data.qacc_warmstart, source_start, _N_SPEEDS[joint_type])
    old_motors = {model.actuator(index).name: index for index in range(model.nu)}
    for motor in range(new_model.nu):
        if (source := old_motors.get(new_model.actuator(motor).name)) is not None:
            new_data.ctrl[motor] = data.ctrl[source]
    _transfer_sensors(old, new)
    new_data.time = data.time


def place_body(scene: Scene, body: str, x: float, y: float, heading: float) -> None:
    """Put a body with a free joint upright and at rest at a position [m] with a heading [rad]."""
    model, data = scene
    joint = int(model.body(body).jntadr[0])
    address, half = int(model.jnt_qposadr[joint]), heading / 2
    data.qpos[address : address + 2] = x, y
    data.qpos[address + 3 : address + 7] = np.cos(half), 0, 0, np.sin(half)


def _joints_by_body(model: mujoco.MjModel) -> dict[tuple[str, int], int]:
    """Return the joints of a scene by their body's name and their index among its joints."""
    bodies: list[int] = model.jnt_bodyid.tolist()
    names = ((model.body(body).name, body, joint) for joint, body in enumerate(bodies))
    return {(name, joint - int(model.body_jntadr[body])): joint for name, body, joint in names}


def _copy(target: Floats, start: int, source: Floats, source_start: int, count: int) -> None:
    target[start : start + count] = source[source_start : source_start + count]


def _transfer_sensors(old: Scene, new: Scene) -> None:
    """Transfer the readings of MuJoCo's sensors, with the delayed ones."""
    (model, data), (new_model, new_data) = old, new
    old_sensors = {model.sensor(index).name: index for index in range(model.nsensor)}
    for sensor in range(new_model.nsensor):
        source = old_sensors.get(new_model.sensor(sensor).name)
        dim, n_samples = int(new_model.sensor_dim[sensor]), int(new_model.sensor_history[sensor, 0])
        if source is None or (dim, n_samples) != (model.sensor_dim[source], model.sensor_history[source, 0]):
            continue
        start, source_start = new_model.sensor_adr[sensor], model.sensor_adr[source]
        _copy(new_data.sensordata, start, data.sensordata, source_start, dim)
        if n_samples:
            start, source_start = new_model.sensor_historyadr[sensor], model.sensor_historyadr[source]
            _copy(new_data.history, start, data.history, source_start, 2 + n_samples * (1 + dim))
