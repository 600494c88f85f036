"""Transfer of the physical state to another scene: what both have by name goes on as it was.

Bodies, joints and motors go on with their positions, speeds and warm starts; the new scene's other things
stand as it has them. Everything is awake, as what slept may have lost what it leant on.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false, reportArgumentType=false

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Scene = tuple[mujoco.MjModel, mujoco.MjData]
"""Model and state of a scene."""

_POSITIONS = {0: 7, 1: 4, 2: 1, 3: 1}
_SPEEDS = {0: 6, 1: 3, 2: 1, 3: 1}
"""Number of values of each type of joint: free, ball, slide, hinge."""


def transfer_state(old: Scene, new: Scene, placed: Sequence[str]) -> None:
    """Set the state of a new scene to that of an old one, for all that both have.

    Args:
        old: Scene whose state goes on.
        new: Scene, reset.
        placed: Names of the bodies that stand as the new scene has them, at rest.
    """
    (model, data), (into, fresh) = old, new
    joints = _joints(model)
    for (body, turn), joint in _joints(into).items():
        source = joints.get((body, turn))
        if body in placed or source is None or model.jnt_type[source] != into.jnt_type[joint]:
            continue
        kind = int(into.jnt_type[joint])
        _copy(fresh.qpos, into.jnt_qposadr[joint], data.qpos, model.jnt_qposadr[source], _POSITIONS[kind])
        for speeds, before in ((fresh.qvel, data.qvel), (fresh.qacc_warmstart, data.qacc_warmstart)):
            _copy(speeds, into.jnt_dofadr[joint], before, model.jnt_dofadr[source], _SPEEDS[kind])
    names = {model.actuator(index).name: index for index in range(model.nu)}
    for motor in range(into.nu):
        if (source := names.get(into.actuator(motor).name)) is not None:
            fresh.ctrl[motor] = data.ctrl[source]
    _transfer_sensors(old, new)
    fresh.time = data.time


def place(scene: Scene, body: str, x: float, y: float, heading: float) -> None:
    """Put a body with a free joint upright and at rest at a position [m] with a heading [rad]."""
    model, data = scene
    joint = int(model.body(body).jntadr[0])
    at, half = int(model.jnt_qposadr[joint]), heading / 2
    data.qpos[at : at + 2] = x, y
    data.qpos[at + 3 : at + 7] = np.cos(half), 0, 0, np.sin(half)


def _joints(model: mujoco.MjModel) -> dict[tuple[str, int], int]:
    """Return the joints of a scene by their body's name and their turn there."""
    return dict(_named(model))


def _named(model: mujoco.MjModel) -> Iterator[tuple[tuple[str, int], int]]:
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        yield (model.body(body).name, joint - int(model.body_jntadr[body])), joint


def _copy(into: NDArray[np.float64], start: int, source: NDArray[np.float64], at: int, count: int) -> None:
    into[start : start + count] = source[at : at + count]


def _transfer_sensors(old: Scene, new: Scene) -> None:
    """Transfer readings of MuJoCo's own sensors, with those that are on their way."""
    (model, data), (into, fresh) = old, new
    names = {model.sensor(index).name: index for index in range(model.nsensor)}
    for sensor in range(into.nsensor):
        source = names.get(into.sensor(sensor).name)
        dim, samples = int(into.sensor_dim[sensor]), int(into.sensor_history[sensor, 0])
        if source is None or (dim, samples) != (model.sensor_dim[source], model.sensor_history[source, 0]):
            continue
        _copy(fresh.sensordata, into.sensor_adr[sensor], data.sensordata, model.sensor_adr[source], dim)
        if samples:
            start, at = into.sensor_historyadr[sensor], model.sensor_historyadr[source]
            _copy(fresh.history, start, data.history, at, 2 + samples * (1 + dim))
