"""MuJoCo's private addresses: the memory there equals the arrays of its Python module."""

import ctypes

import mujoco
import numpy as np

from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.simulation import addresses


def test_a_step_by_address_is_a_step() -> None:
    model = to_spec(Playpen.load("obstacles")).compile()
    by_module, by_address = mujoco.MjData(model), mujoco.MjData(model)
    step = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(addresses.function_address("mj_step"))
    for data in (by_module, by_address):
        data.ctrl[:] = 1.0, -0.5
    for _ in range(200):
        mujoco.mj_step(model, by_module)
        step(addresses.object_address(model), addresses.object_address(by_address))
    assert by_address.time == by_module.time > 0.4
    assert np.abs(by_module.qvel).max() > 0.1
    assert by_address.qpos.tobytes() == by_module.qpos.tobytes()
