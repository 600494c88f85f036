"""The scene for Foxglove, read by the classes of another library from the definition in the log."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from log_contents import messages_of
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scenes import arena, robot, table

from khep_twin import playpen as playpens
from khep_twin.log.channels import SCENE, TRANSFORMS
from khep_twin.log.decoding import decode
from khep_twin.log.foxglove_scene import scene_update
from khep_twin.log.message_types import SCHEMAS
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

SHIPPED = sorted(
    path.stem for path in (Path(playpens.__file__).parents[1] / "assets" / "playpens").glob("*.toml")
)

STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(get_types_from_msg(SCHEMAS[SCENE], SCENE))

PLAYPEN = (
    arena()
    + table("block", x_mm=120, y_mm=200, angle_deg=30, length_mm=60, width_mm=20, height_mm=50)
    + table("cylinder", x_mm=300, y_mm=400, radius_mm=12.5, height_mm=40)
    + table("cylinder", x_mm=400, y_mm=100, radius_mm=20, height_mm=30, movable=True, mass_g=20)
    + table("lamp", x_mm=50, y_mm=450, z_mm=40, power_w=7)
    + robot(300, 250, 90)
)


@pytest.fixture(scope="module")
def scene() -> Any:
    """The scene of a playpen with a block, a lamp and two cylinders, one of them movable."""
    return parse(scene_update(to_spec(playpens.parse(PLAYPEN, "mine")).compile()))


def parse(data: bytes) -> Any:
    """Return a scene as an object of that library."""
    return STORE.deserialize_cdr(data, SCENE)


def entity(scene: Any, name: str) -> Any:
    (entity,) = [candidate for candidate in scene.entities if candidate.id == name]
    return entity


def place(pose: Any) -> list[float]:
    return [pose.position.x, pose.position.y, pose.position.z]


def size(primitive: Any) -> list[float]:
    return [primitive.size.x, primitive.size.y, primitive.size.z]


@pytest.mark.parametrize("name", SHIPPED)
def test_another_library_reads_the_scene_and_writes_the_same_bytes(name: str) -> None:
    model = to_spec(Playpen.load(name)).compile()
    data = scene_update(model)
    read = parse(data)
    assert STORE.serialize_cdr(read, SCENE).tobytes() == data
    names = [entity.id for entity in read.entities]
    assert len(set(names)) == len(names)
    assert scene_update(to_spec(Playpen.load(name)).compile()) == data


def test_every_entity_holds_for_ever_and_follows_its_frame(scene: Any) -> None:
    for entity in scene.entities:
        assert entity.frame_locked
        assert (entity.timestamp.sec, entity.timestamp.nanosec) == (0, 0)
        assert (entity.lifetime.sec, entity.lifetime.nanosec) == (0, 0)
    assert not len(scene.deletions)


def test_walls_and_blocks_stand_in_the_world_as_the_playpen_has_them(scene: Any) -> None:
    fixed = {entity.id for entity in scene.entities if entity.frame_id == "map"}
    walls = {f"map/wall_{side}" for side in ("left", "right", "bottom", "top")}
    assert fixed == walls | {"map/floor", "map/block0", "map/cylinder0", "map/lamp0"}
    (block,) = entity(scene, "map/block0").cubes
    assert place(block.pose) == pytest.approx([0.12, 0.2, 0.025])
    assert size(block) == pytest.approx([0.06, 0.02, 0.05])
    turn = block.pose.orientation
    half = np.radians(15)
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx([0, 0, np.sin(half), np.cos(half)])
    (cylinder,) = entity(scene, "map/cylinder0").cylinders
    assert place(cylinder.pose) == pytest.approx([0.3, 0.4, 0.02])
    assert size(cylinder) == pytest.approx([0.025, 0.025, 0.04])
    assert (cylinder.bottom_scale, cylinder.top_scale) == (1, 1)
    (lamp,) = entity(scene, "map/lamp0").spheres
    assert place(lamp.pose) == pytest.approx([0.05, 0.45, 0.04])
    (floor,) = entity(scene, "map/floor").cubes
    assert size(floor)[0] >= 0.6
    assert size(floor)[1] >= 0.5
    for wall in walls:
        (cube,) = entity(scene, wall).cubes
        assert min(size(cube)) > 0
        assert cube.color.a == 1


def test_what_moves_is_drawn_in_its_own_frame(scene: Any) -> None:
    (post,) = entity(scene, "cylinder1").cylinders
    assert entity(scene, "cylinder1").frame_id == "cylinder1"
    assert size(post) == pytest.approx([0.04, 0.04, 0.03])
    # Where it stands in the playpen is told by /tf alone.
    assert np.abs(place(post.pose)).max() < 0.03
    base = entity(scene, "khepera0/base_link")
    assert base.frame_id == "khepera0/base_link"
    assert max(size(cylinder)[0] for cylinder in base.cylinders) == pytest.approx(0.055, abs=0.002)
    # Wheels look the same however they turn, and are drawn with the base.
    assert sum(size(cylinder)[2] == pytest.approx(0.003) for cylinder in base.cylinders) == 2


def test_colours_are_the_models() -> None:
    geom = '<geom name="g" type="box" size="1 2 3" rgba="0.25 0.5 0 0.75"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}</worldbody></mujoco>")
    (cube,) = parse(scene_update(model)).entities[0].cubes
    assert [cube.color.r, cube.color.g, cube.color.b, cube.color.a] == [0.25, 0.5, 0, 0.75]


def test_capsules_and_things_on_what_stands_still_are_drawn_where_they_are() -> None:
    model = mujoco.MjModel.from_xml_string(
        """
        <mujoco><worldbody>
          <body name="shelf" pos="1 0 0" euler="0 0 90">
            <geom name="pin" type="capsule" size="0.01 0.05" pos="0.2 0 0" euler="90 0 0"/>
            <body name="box" pos="0 0 0.3"><geom name="lid" type="box" size="0.1 0.1 0.1"/></body>
          </body>
        </worldbody></mujoco>
        """
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    read = parse(scene_update(model))
    assert {entity.frame_id for entity in read.entities} == {"map"}
    pin = entity(read, "map/pin")
    (cylinder,) = pin.cylinders
    assert place(cylinder.pose) == pytest.approx(data.geom("pin").xpos.tolist(), abs=1e-12)
    assert size(cylinder) == pytest.approx([0.02, 0.02, 0.1])
    axis = 0.05 * data.geom("pin").xmat.reshape(3, 3)[:, 2]
    for ball, side in zip(pin.spheres, (-1, 1), strict=True):
        assert place(ball.pose) == pytest.approx((data.geom("pin").xpos + side * axis).tolist(), abs=1e-12)
        assert size(ball) == pytest.approx([0.02, 0.02, 0.02])
    (lid,) = entity(read, "map/lid").cubes
    assert place(lid.pose) == pytest.approx([1, 0, 0.3])


def test_a_log_has_the_scene_once_and_a_frame_for_every_entity(
    tmp_path: Path, start: Callable[[Path], Twin]
) -> None:
    log = tmp_path / "run.mcap"
    with open_twin("gripper", TwinOptions(log=str(log))) as twin:
        twin.advance_to(100_000_000)
        expected = scene_update(twin.world.model)
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages(topics=["/scene"]))
    frames = {
        transform["child_frame_id"]
        for topic in ("/tf", "/tf_static")
        for _, message in messages_of(log, topic)
        for transform in decode(TRANSFORMS, message.data)["transforms"]
    }
    ((schema, channel, message),) = messages
    assert schema is not None
    assert schema.name == SCENE
    assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
    assert schema.data.decode() == SCHEMAS[SCENE]
    assert (message.log_time, message.data) == (0, expected)
    entities = parse(message.data).entities
    assert {entity.frame_id for entity in entities} <= frames | {"map"}
    assert {"cylinder0", "khepera0/gripper/left_finger"} <= {entity.frame_id for entity in entities}
