"""Indices of a robot: each belongs to the part of that name, also for the second robot of a scene."""

import dataclasses
import math

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.units import Sensor
from khep_twin.world import World

TWO = """
version = 1
name = "two"
[arena]
width_mm = 600
height_mm = 500
[[robot]]
x_mm = 100
y_mm = 100
heading_deg = 0
turrets = ["gripper"]
[[robot]]
x_mm = 400
y_mm = 300
heading_deg = 90
"""


@pytest.fixture(scope="module")
def world() -> World:
    return World(playpen.parse(TWO, "two"), noise=False)


@pytest.mark.parametrize("name", ["khepera0", "khepera1"])
def test_each_index_bears_the_name_of_its_part(world: World, name: str) -> None:
    model, indices = world.model, RobotIndices.of(world.model, name)
    assert model.body(indices.base).name == f"{name}/base"
    assert [model.body(index).name for index in indices.wheels] == [
        f"{name}/left_wheel",
        f"{name}/right_wheel",
    ]
    assert [model.actuator(index).name for index in indices.motors] == [
        f"{name}/left_motor",
        f"{name}/right_motor",
    ]
    names = [f"{name}/{sensor.key}" for sensor in Sensor]
    assert [model.camera(index).name for index in indices.cameras] == names
    assert [model.site(index).name for index in indices.leds] == [f"{name}/led_0", f"{name}/led_1"]
    assert [model.body(index).name for index in indices.led_lights] == [
        f"{name}/led_0_light",
        f"{name}/led_1_light",
    ]
    joints = [f"{name}/pose", f"{name}/left_axle", f"{name}/right_axle"]
    assert [model.joint(index).qposadr[0] for index in joints] == [indices.pose, *indices.wheel_qpos]
    assert [model.joint(index).dofadr[0] for index in joints] == [indices.velocity, *indices.wheel_dofs]


def test_the_pose_is_that_of_the_playpen(world: World) -> None:
    start = RobotIndices.of(world.model, "khepera1").pose_in(world.model.qpos0)
    assert start == pytest.approx((0.4, 0.3, math.pi / 2))
    assert world.robots[1].indices == RobotIndices.of(world.model, "khepera1")


def test_indices_are_of_one_robot_and_do_not_change(world: World) -> None:
    indices = RobotIndices.of(world.model, "khepera0")
    with pytest.raises(dataclasses.FrozenInstanceError):
        indices.base = 1  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(KeyError, match="khepera2"):
        RobotIndices.of(world.model, "khepera2")
    assert np.intersect1d(indices.motors, world.robots[1].indices.motors).size == 0
