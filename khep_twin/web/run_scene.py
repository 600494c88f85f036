"""Scene of a finished run as its page draws it: with few moving bodies, as each takes room in the file."""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

from khep_twin.log.foxglove_scene import compose
from khep_twin.web.scene import DrawnScene


def describe_replay(model: mujoco.MjModel, frames: Collection[str]) -> dict[str, Any]:
    """Return the scene for the page that plays a run.

    Bodies without a frame, and wheels, are fixed to their parents. "parents" has the index of a robot's base
    for each part of it that moves, None for other bodies.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    scene: dict[str, Any] = DrawnScene(model, data).describe()
    names: list[str] = scene["bodies"]
    moving = [name for name in names if name in frames and not _is_wheel(model, model.body(name).id)]
    for shape in scene["shapes"]:
        if shape["body"] is None or names[shape["body"]] in moving:
            continue
        body = parent = model.body(names[shape["body"]]).id
        while parent and model.body(parent).name not in moving:
            parent = model.body_parentid[parent]
        local = np.array(shape["pose"])
        pose = compose(data.xpos[body], data.xquat[body], local[:3], local[3:])
        inverse = np.zeros(3), np.zeros(4)
        mujoco.mju_negPose(*inverse, data.xpos[parent], data.xquat[parent])
        shape["pose"] = np.concatenate(compose(*inverse, *pose)).round(5).tolist()
        shape["body"] = names.index(model.body(parent).name) if parent else None
    for shape in scene["shapes"]:
        shape["body"] = None if shape["body"] is None else moving.index(names[shape["body"]])
    scene["poses"] = [scene["poses"][names.index(name)] for name in moving]
    scene["bodies"] = moving
    bases = [f"{name.partition('/')[0]}/base" for name in moving]
    is_part = zip(moving, bases, strict=True)
    scene["parents"] = [
        moving.index(base) if base in moving and base != name else None for name, base in is_part
    ]
    return scene


def _is_wheel(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body turns without limits about one axis."""
    joint = model.body_jntadr[body]
    is_hinge = model.body_jntnum[body] == 1 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    return bool(is_hinge and not model.jnt_limited[joint])
