"""The scene as URDF: which parts are drawn, and where."""

import math
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from khep_twin.log.description import urdf

SCENE = """
<mujoco model="scene">
  <worldbody>
    <geom name="floor" type="plane" size="0.4 0.3 0.01"/>
    <geom name="wall" type="box" size="0.1 0.01 0.02" pos="0 0.3 0.02" rgba="1 0.5 0 1"/>
    <geom name="ghost" type="box" size="1 1 1" rgba="1 1 1 0"/>
    <site name="lamp" size="0.01" pos="0.1 0 0.015"/>
    <body name="post" pos="0.2 0 0">
      <geom name="pole" type="capsule" size="0.01 0.05"/>
    </body>
    <body name="khepera0/base" pos="0 0 0.1">
      <freejoint/>
      <geom name="shell" type="sphere" size="0.03" group="3"/>
      <geom name="disc" type="cylinder" size="0.03 0.01" group="2"/>
      <geom name="egg" type="ellipsoid" size="0.1 0.2 0.3"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def robot() -> ElementTree.Element:
    return ElementTree.fromstring(urdf(mujoco.MjModel.from_xml_string(SCENE)))


def visuals(robot: ElementTree.Element, link: str) -> dict[str, ElementTree.Element]:
    return {visual.attrib["name"]: visual for visual in robot.findall(f"link[@name='{link}']/visual")}


def shape(visual: ElementTree.Element) -> tuple[str, dict[str, str]]:
    (element,) = visual.iterfind("geometry/*")
    return element.tag, element.attrib


def test_every_body_is_a_link_named_as_its_frame(robot: ElementTree.Element) -> None:
    assert [link.attrib["name"] for link in robot.findall("link")] == ["map", "post", "khepera0/base_link"]
    assert [child.attrib["link"] for child in robot.iterfind("joint/child")] == ["post", "khepera0/base_link"]


def test_what_is_transparent_or_for_contact_only_is_not_drawn(robot: ElementTree.Element) -> None:
    assert set(visuals(robot, "map")) == {"floor", "wall", "lamp"}
    assert set(visuals(robot, "khepera0/base_link")) == {"disc"}


def test_half_sizes_become_whole_ones(robot: ElementTree.Element) -> None:
    world = visuals(robot, "map")
    assert shape(world["floor"]) == ("box", {"size": "0.8 0.6 0.0002"})
    assert shape(world["wall"]) == ("box", {"size": "0.2 0.02 0.04"})
    assert shape(world["lamp"]) == ("sphere", {"radius": "0.01"})
    assert shape(visuals(robot, "post")["pole"]) == ("capsule", {"radius": "0.01", "length": "0.1"})
    assert shape(visuals(robot, "khepera0/base_link")["disc"]) == (
        "cylinder",
        {"radius": "0.03", "length": "0.02"},
    )


def test_positions_and_colours_are_the_models(robot: ElementTree.Element) -> None:
    wall = visuals(robot, "map")["wall"]
    assert wall.find("origin").attrib["xyz"] == "0 0.3 0.02"
    assert wall.find("material/color").attrib["rgba"] == "1 0.5 0 1"


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


@pytest.mark.parametrize("yaw", [0.0, 0.8, -2.5, math.pi])
@pytest.mark.parametrize("pitch", [0.0, 0.3, math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize("roll", [0.0, -1.1, math.pi / 2])
def test_rotations_survive_the_angles_of_urdf(roll: float, pitch: float, yaw: float) -> None:
    quaternion, expected = np.zeros(4), turned(roll, pitch, yaw)
    mujoco.mju_mat2Quat(quaternion, expected.flatten())
    quat = " ".join(map(str, quaternion))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom name="g" type="box" size="1 2 3" quat="{quat}"/></worldbody></mujoco>'
    )
    origin = visuals(ElementTree.fromstring(urdf(model)), "map")["g"].find("origin")
    rotation = turned(*map(float, origin.attrib["rpy"].split()))
    assert rotation == pytest.approx(expected, abs=1e-6)
