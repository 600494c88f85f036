"""Contacts of robots in MuJoCo."""

import mujoco
import numpy as np


def in_contact(data: mujoco.MjData, base: str) -> bool:
    """Return whether forces act between a robot and anything but the floor.

    Args:
        data: State of the scene.
        base: Name of the robot's first body.
    """
    model, contacts = data.model, data.contact
    roots = model.body_rootid[model.geom_bodyid[contacts.geom]]
    is_robot = roots == model.body(base).id
    is_contact = (is_robot.sum(axis=1) == 1) & (contacts.geom != model.geom("floor").id).all(axis=1)
    return bool(np.any(is_contact & (contacts.efc_address >= 0)))
