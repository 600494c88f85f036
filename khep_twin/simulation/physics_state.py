"""State of MuJoCo's physics, and the fingerprint of the scene that it belongs to.

A step depends only on MuJoCo's state for integration, with warm starts, as long as no body sleeps. Sleeping
bodies keep the positions and forces of the step in which they fell asleep. These are restored by one forward
computation with all bodies awake, and the lists of awake bodies by `tree_asleep`.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import hashlib
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from pydantic import Base64UrlBytes, Field

from khep_twin.simulation.faulty_wheels import WHEEL_FIELDS

FIELDS_CHANGED_BY_RUNS = ("body_pos", *WHEEL_FIELDS)
"""Arrays of a model that a run changes: LEDs are moved, and faults change the wheels."""

_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_AWAKE = -(1 + mujoco.mjMINAWAKE)
"""Lowest value of `tree_asleep`: that of a tree that has just moved."""


class PhysicsState(NamedTuple):
    """State of the physics.

    Attributes:
        integration: MuJoCo's state for integration, as 64-bit floats.
        sensors: Readings of MuJoCo's sensors, as 64-bit floats.
        asleep: MuJoCo's `tree_asleep` (n_trees,).
        warnings: Number of warnings of each kind.
    """

    integration: Base64UrlBytes
    sensors: Base64UrlBytes
    asleep: tuple[Annotated[int, Field(ge=_AWAKE, lt=2**31)], ...]
    warnings: tuple[Annotated[int, Field(ge=0, lt=2**31)], ...]


def physics_state(model: mujoco.MjModel, data: mujoco.MjData) -> PhysicsState:
    """Return the state of the physics."""
    values = np.empty(mujoco.mj_stateSize(model, _INTEGRATION))
    mujoco.mj_getState(model, data, values, _INTEGRATION)
    asleep, warnings = data.tree_asleep.tolist(), data.warning.number.tolist()
    return PhysicsState(values.tobytes(), data.sensordata.tobytes(), tuple(asleep), tuple(warnings))


def set_physics_state(
    model: mujoco.MjModel, data: mujoco.MjData, state: PhysicsState, *, has_diverged: bool = False
) -> None:
    """Restore a state of the physics.

    Args:
        model: Model of the scene.
        data: State of the scene.
        state: State to restore.
        has_diverged: Whether the run has ended, whose numbers may be infinite or not a number.

    Raises:
        ValueError: The state is of another scene, or MuJoCo cannot continue from it.
    """
    for name, array in (("integration", state.integration), ("sensors", state.sensors)):
        if len(array) % 8:
            raise ValueError(f"physics.{name} = {len(array)} bytes; expected a multiple of 8")
    values, sensors = np.frombuffer(state.integration), np.frombuffer(state.sensors)
    size = mujoco.mj_stateSize(model, _INTEGRATION), model.nsensordata
    sizes = len(values), len(sensors), len(state.asleep), len(state.warnings)
    if sizes != (expected := (*size, model.ntree, len(data.warning.number))):
        raise ValueError(f"a physical state of size {sizes}; expected {expected}")
    # The value of a sleeping tree is the next one in a cycle of trees that fell asleep together.
    sleepers = [tree for tree, next_tree in enumerate(state.asleep) if next_tree >= 0]
    if sorted(next_tree for next_tree in state.asleep if next_tree >= 0) != sleepers:
        raise ValueError(f"sleeping trees {list(state.asleep)}; expected rings of them")
    for name, numbers in (("integration", values), ("sensors", sensors)):
        if not (has_diverged or np.isfinite(numbers).all()):
            index = int(np.flatnonzero(~np.isfinite(numbers))[0])
            raise ValueError(f"physics.{name}[{index}] = {numbers[index]}; expected a finite number")
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, values, _INTEGRATION)
    _check_history(model, data)
    mujoco.mj_forward(model, data)
    mujoco.mj_setState(model, data, values, _INTEGRATION)
    data.sensordata[:] = sensors
    data.tree_asleep[:] = state.asleep
    _list_awake(model, data)
    data.warning.number[:] = state.warnings


def fingerprint(model: mujoco.MjModel, *extras: object) -> str:
    """Return a hash of the constant arrays of a compiled scene, and of the `repr` of `extras`."""
    digest = hashlib.sha256(repr(extras).encode("utf-8"))
    digest.update(model.names)
    for name in sorted(vars(type(model))):
        if not name.startswith("_") and name not in FIELDS_CHANGED_BY_RUNS:
            value = getattr(model, name)
            if isinstance(value, np.ndarray):
                array: NDArray[np.generic] = value
                digest.update(f"{name} {array.shape}".encode())
                digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def _check_history(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise a `ValueError` if the write index of a delayed sensor's buffer is invalid."""
    for samples, start in zip(model.sensor_history[:, 0], model.sensor_historyadr, strict=True):
        if samples and data.history[start + 1] not in range(samples):
            raise ValueError(
                f"place {data.history[start + 1]} in a sensor's history; expected 0 to {samples - 1}"
            )


def _list_awake(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Update the lists of awake bodies, as MuJoCo does after each change of `tree_asleep`."""
    awake = data.tree_asleep < 0
    trees, is_mocap = model.body_treeid, model.body_mocapid[model.body_rootid] >= 0
    static = np.where(is_mocap, mujoco.mjtSleepState.mjS_AWAKE, mujoco.mjtSleepState.mjS_STATIC)
    bodies = np.where(trees < 0, static, np.append(awake, False)[trees])
    data.tree_awake[:], data.body_awake[:] = awake, bodies
    data.ntree_awake = int(awake.sum())
    is_moving = bodies != mujoco.mjtSleepState.mjS_ASLEEP
    data.nbody_awake = _write(data.body_awake_ind, np.flatnonzero(is_moving))
    data.nparent_awake = _write(data.parent_awake_ind, 1 + np.flatnonzero(is_moving[model.body_parentid[1:]]))
    dof_bodies = model.dof_bodyid
    is_awake = (trees[dof_bodies] >= 0) & (bodies[dof_bodies] > 0)
    data.nv_awake = _write(data.dof_awake_ind, np.flatnonzero(is_awake))


def _write(memory: NDArray[np.int32], values: NDArray[np.intp]) -> int:
    """Write values to the start of a list; return their number."""
    memory[: len(values)] = values
    return len(values)
