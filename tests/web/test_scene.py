"""Scenes of the 3-D view: visible shapes of the compiled model, and their poses."""

from typing import Any

import mujoco
import numpy as np
import pytest

from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.web.scene import DrawnScene, compile_scene
from khep_twin.world import World
from tests.web.conftest import Client
from tests.web.test_guard import DRAFT


def describe(name: str) -> Any:
    return compile_scene(to_spec(Playpen.load(name))).describe()


def test_shapes_that_stand_still_are_where_the_model_has_them() -> None:
    shapes = {shape["name"]: shape for shape in describe("obstacles")["shapes"]}
    block = shapes["block4"]
    drawn = Playpen.load("obstacles").blocks[4]
    assert (block["kind"], block["body"]) == ("box", None)
    assert block["size"][:2] == [drawn.length_mm / 2000, drawn.width_mm / 2000]
    assert block["pose"][:2] == [drawn.x_mm / 1000, drawn.y_mm / 1000]
    angle_deg = 2 * np.degrees(np.arctan2(block["pose"][6], block["pose"][3]))
    assert angle_deg == pytest.approx(drawn.angle_deg, abs=0.01)
    assert shapes["floor"]["kind"] == "plane"
    assert shapes["lamp0"]["rgba"][3] == 1


def test_what_only_collides_is_not_shown() -> None:
    names = [shape["name"] for shape in describe("gripper")["shapes"]]
    assert "khepera0/base" in names
    assert not {"khepera0/shell", "khepera0/left_tyre", "khepera0/front_support"} & set(names)


def test_bodies_that_move_have_their_shapes_in_their_own_frames() -> None:
    scene = describe("gripper")
    assert {"cylinder0", "khepera0/base", "khepera0/gripper/arm"} <= set(scene["bodies"])
    assert len(scene["poses"]) == len(scene["bodies"])
    loose = next(shape for shape in scene["shapes"] if shape["body"] == scene["bodies"].index("cylinder0"))
    assert loose["pose"] == [0, 0, 0, 1, 0, 0, 0]
    drawn = Playpen.load("gripper").cylinders[0]
    pose = scene["poses"][scene["bodies"].index("cylinder0")]
    assert pose[:2] == [drawn.x_mm / 1000, drawn.y_mm / 1000]


def test_the_poses_follow_the_physics() -> None:
    world = World(Playpen.load("default"))
    scene = DrawnScene(world.model, world.data)
    before = scene.poses()
    world.data.qpos[world.robots[0].indices.pose] += 0.1
    mujoco.mj_forward(world.model, world.data)
    base = world.robots[0].indices.base
    assert scene.poses() != before
    assert scene.poses()[0][:3] == world.data.xpos[base].round(5).tolist()


def test_meshes_and_materials_are_shown() -> None:
    corners = "0 0 0  1 0 0  0 1 0  0 0 1"
    model = mujoco.MjSpec.from_string(
        f"""<mujoco><asset><mesh name="m" vertex="{corners}"/><material name="red" rgba="1 0 0 1"/></asset>
        <worldbody><geom type="mesh" mesh="m" material="red"/><light type="spot" pos="0 0 2"/>
        </worldbody></mujoco>"""
    )
    scene: Any = compile_scene(model).describe()
    assert (scene["shapes"][0]["kind"], scene["shapes"][0]["mesh"]) == ("mesh", 0)
    assert scene["shapes"][0]["rgba"] == [1, 0, 0, 1]
    assert (len(scene["meshes"][0]["points"]), len(scene["meshes"][0]["faces"])) == (4, 4)
    assert (scene["lights"][0]["directional"], scene["lights"][0]["at"]) == (False, [0, 0, 2])


def test_the_page_gets_the_scene_of_a_draft_and_that_of_a_running_twin(client: Client) -> None:
    status, drawn = client.do("scene", draft=DRAFT)
    assert status == 200
    status, reply = client.do("scene")
    assert (status, reply["error"]) == (
        400,
        "nothing runs; expected a started twin, or a connection to a robot",
    )
    assert client.do("start", draft=DRAFT, paused=True)[0] == 200
    while (response := client.do("scene"))[0] != 200:
        assert "not there yet" in response[1]["error"]
    assert response[1]["shapes"] == drawn["shapes"]
    assert response[1]["bodies"] == drawn["bodies"]
    wrong = {**DRAFT, "robot": [{"x_mm": 0, "y_mm": 0, "heading_deg": 0}]}
    assert client.do("scene", draft=wrong)[0] == 400
