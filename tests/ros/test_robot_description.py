"""URDF with joints: the same frames as in MuJoCo at any position of the joints."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from command_line import complaint, good
from numpy.typing import NDArray
from scenes import arena, robot

from khep_twin import playpen as playpens
from khep_twin.log.frames import frame_name
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ros.robot_description import robot_description

PLAYPEN = "".join(
    [arena(900, 700), robot(200, 350, 30, model="khepera4"), robot(500, 350, turrets=["gripper"])]
)
SENSORS = [("khepera0/base_link", "khepera0/ps0", (0.01, 0.02, 0.03, 0.0, 0.0, 1.0, 0.0))]

Matrix = NDArray[np.float64]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return to_spec(playpens.parse(PLAYPEN, "two")).compile()


@pytest.fixture(scope="module")
def urdf(model: mujoco.MjModel) -> ElementTree.Element:
    return ElementTree.fromstring(robot_description(model, SENSORS))


def joints_of(urdf: ElementTree.Element) -> dict[str, ElementTree.Element]:
    """Return the joints by the names of their links."""
    return {joint.find("child").attrib["link"]: joint for joint in urdf.iterfind("joint")}


def numbers(text: str) -> Matrix:
    return np.array([float(word) for word in text.split()])


def turned(axis: Matrix, angle: float) -> Matrix:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def pose_of(joint: ElementTree.Element, position: float) -> tuple[Matrix, Matrix]:
    """Return place and rotation of a joint's link in its parent at a position of the joint."""
    origin = joint.find("origin")
    place, (roll, pitch, yaw) = (numbers(origin.attrib[key]) for key in ("xyz", "rpy"))
    x, y, z = np.eye(3)
    rotation = turned(z, yaw) @ turned(y, pitch) @ turned(x, roll)
    if joint.attrib["type"] == "fixed":
        return place, rotation
    axis = numbers(joint.find("axis").attrib["xyz"])
    if joint.attrib["type"] == "prismatic":
        return place + rotation @ axis * position, rotation
    return place, rotation @ turned(axis, position)


def test_links_are_a_tree_with_the_map_as_its_root(urdf: ElementTree.Element) -> None:
    links, joints = {link.attrib["name"] for link in urdf.iterfind("link")}, joints_of(urdf)
    assert links - joints.keys() == {"map"}
    assert {joint.find("parent").attrib["link"] for joint in joints.values()} <= links
    assert len(urdf.findall("joint")) == len(joints)
    chain = "khepera1/gripper/arm"
    names = [chain]
    while chain != "map":
        names.append(chain := joints[chain].find("parent").attrib["link"])
    assert names[-3:] == ["khepera1/base_link", "khepera1/odom", "map"]


def test_joints_have_the_kinds_and_names_of_their_links(urdf: ElementTree.Element) -> None:
    joints = joints_of(urdf)
    assert all(joint.attrib["name"] == f"{link}_joint" for link, joint in joints.items())
    kinds = {
        "khepera0/odom": "floating",
        "khepera0/base_link": "floating",
        "khepera0/left_wheel": "continuous",
        "khepera0/ps0": "fixed",
        "khepera0/led_0_light": "fixed",
        "khepera1/right_wheel": "continuous",
        "khepera1/gripper/arm": "revolute",
        "khepera1/gripper/left_finger": "prismatic",
    }
    assert {link: joints[link].attrib["type"] for link in kinds} == kinds


def test_parts_are_where_mujoco_has_them_at_any_position_of_the_joints(
    model: mujoco.MjModel, urdf: ElementTree.Element
) -> None:
    data, joints, rng = mujoco.MjData(model), joints_of(urdf), np.random.default_rng(2)
    for index in np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE).tolist():
        low, high = model.jnt_range[index] if model.jnt_limited[index] else (-3, 3)
        data.qpos[model.jnt_qposadr[index]] = rng.uniform(low, high)
    mujoco.mj_kinematics(model, data)
    compared = 0
    for body in range(1, model.nbody):
        joint, parent = joints[frame_name(model, body)], model.body_parentid[body]
        if joint.attrib["type"] == "floating":
            continue
        address = model.jnt_qposadr[model.body_jntadr[body]]
        moved = data.qpos[address] - model.qpos0[address] if model.body_jntnum[body] else 0.0
        place, rotation = pose_of(joint, moved)
        frame = data.xmat[parent].reshape(3, 3)
        assert data.xpos[parent] + frame @ place == pytest.approx(data.xpos[body], abs=1e-8)
        assert frame @ rotation == pytest.approx(data.xmat[body].reshape(3, 3), abs=1e-8)
        if (limit := joint.find("limit")) is not None:
            assert float(limit.attrib["lower"]) <= moved <= float(limit.attrib["upper"])
        compared += 1
    assert compared > 10


def test_a_link_has_mass_and_inertia_and_what_it_touches_with(
    model: mujoco.MjModel, urdf: ElementTree.Element
) -> None:
    base = urdf.find("link[@name='khepera0/base_link']")
    mass = float(base.find("inertial/mass").attrib["value"])
    assert mass == pytest.approx(model.body("khepera0/base").mass[0])
    assert float(base.find("inertial/inertia").attrib["izz"]) > 0
    assert {part.attrib["name"] for part in base.iterfind("collision")} >= {"khepera0/front_support"}


def test_a_sensor_has_the_pose_of_its_frame(urdf: ElementTree.Element) -> None:
    place, rotation = pose_of(joints_of(urdf)["khepera0/ps0"], 0.0)
    assert place.tolist() == [0.01, 0.02, 0.03]
    assert rotation == pytest.approx(np.diag([-1, -1, 1]), abs=1e-8)


def test_a_robot_alone_is_written_with_its_sensors(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(PLAYPEN)
    path = tmp_path / "robot.urdf"
    message = good("playpen", "urdf", tmp_path / "two.toml", "--robot", 0, "-o", path)
    assert message.split() == ["URDF", str(path)]
    urdf = ElementTree.parse(path).getroot()
    links = {link.attrib["name"] for link in urdf.iterfind("link")}
    assert links - joints_of(urdf).keys() == {"khepera0/base_link"}
    assert {"khepera0/us4", "khepera0/gs3", "khepera0/ps7", "khepera0/right_wheel"} <= links
    assert not any(link.startswith("khepera1") for link in links)


def test_a_robot_that_is_not_there_is_refused() -> None:
    message = complaint("playpen", "urdf", "gripper", "--robot", 1)
    assert message == "--robot 1: number of robots = 1; expected a number below 1"


def test_without_a_file_the_whole_default_playpen_is_printed() -> None:
    urdf = ElementTree.fromstring(good("playpen", "urdf"))
    assert urdf.find("link[@name='map']/visual[@name='floor']") is not None
