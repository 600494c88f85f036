"""Readings of a robot as messages of its node."""

import math
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from khep_twin.log.channels import MAP
from khep_twin.log.decoding import decode
from khep_twin.robots.registry import find_model, installed_models
from khep_twin.ros.standard import SUPPLY_VOLTAGE
from khep_twin.ros.standard_output import StandardOutput
from khep_twin.ros.wire import NodeName
from khep_twin.sensing.calibration import read_for


class Publisher:
    """Publisher that stores its messages."""

    def __init__(self, messages: list[dict[str, Any]], type_name: str) -> None:
        self._messages, self._type_name = messages, type_name

    def send(self, message: bytes) -> None:
        self._messages.append(decode(self._type_name, message))


class StoringNode:
    """Node whose publishers store their messages, by topic."""

    def __init__(self, name: str) -> None:
        self.name = NodeName.of(name)
        self.messages: dict[str, list[dict[str, Any]]] = {}

    def publisher(self, topic: str, type_name: str, qos: object) -> Publisher:
        return Publisher(self.messages.setdefault(self.name.resolve(topic), []), type_name)


class Cycles:
    """Cycles of a robot's output.

    Attributes:
        messages: Messages by topic.
        time_ns: Time of the next cycle [ns].
        pose: True pose of the robot.
    """

    def __init__(self, model_name: str) -> None:
        model = find_model(model_name)
        node = StoringNode("lab/khepera0")
        calibration = read_for(model.calibration, model)
        self.messages, self.time_ns, self.pose = node.messages, 0, (0.0, 0.0, 0.0)
        self.output = StandardOutput(node, model, calibration, lambda: self.time_ns, lambda: self.pose)  # type: ignore[arg-type]
        self._widths = {
            name.partition(" ")[0]: len(read.values) * (5 if " " in name else 1)
            for name, read in model.dialect.reads.items()
        }

    def publish(self, *positions: int) -> None:
        channels = {name: [100] * width for name, width in self._widths.items()} | {"position": positions}
        self.output.begin()
        self.output.publish(channels)
        self.time_ns += 100_000_000


@pytest.mark.parametrize("name", installed_models())
def test_every_model_has_messages_with_the_names_of_its_node(name: str) -> None:
    cycles = Cycles(name)
    cycles.publish(0, 0)
    topics = {topic.removeprefix("/lab/khepera0/") for topic in cycles.messages}
    assert topics >= {"/tf", "/tf_static", "odom", "joint_states", "scan", "ps0", "ls0"}
    [odometry] = cycles.messages["/lab/khepera0/odom"]
    assert odometry["header"] == {"stamp": 1, "frame_id": "lab/khepera0/odom"}  # 0 would be no time
    [static] = cycles.messages["/tf_static"]
    [description] = cycles.messages["/lab/khepera0/robot_description"]
    links = {link.get("name") for link in ElementTree.fromstring(description["data"]).iter("link")}
    assert links >= {"lab/khepera0/base_link", "lab/khepera0/left_wheel"}
    frames = {transform["child_frame_id"]: transform for transform in static["transforms"]}
    moved = {item["child_frame_id"] for message in cycles.messages["/tf"] for item in message["transforms"]}
    assert links <= frames.keys() | moved
    assert frames.keys() <= links
    assert frames["lab/khepera0/ps0"]["header"]["frame_id"] == "lab/khepera0/base_link"


def test_the_base_of_a_twin_has_its_true_pose_in_the_map() -> None:
    cycles = Cycles("khepera1")
    for positions, pose in (
        ((0, 0), (0.3, 0.2, 1.0)),
        ((500, 800), (0.35, 0.3, 1.7)),
        ((0, 900), (0.1, 0.4, -2.0)),
    ):
        cycles.pose = pose
        cycles.publish(*positions)
        odometry_in_map, base_in_odometry = cycles.messages["/tf"][-2:]
        (first,), (second,) = odometry_in_map["transforms"], base_in_odometry["transforms"]
        assert (first["header"]["frame_id"], second["child_frame_id"]) == (MAP, "lab/khepera0/base_link")
        assert first["child_frame_id"] == second["header"]["frame_id"] == "lab/khepera0/odom"
        position = matrix(first) @ matrix(second)
        assert position[:2, 2] == pytest.approx(pose[:2], abs=1e-6)
        assert math.atan2(position[1, 0], position[0, 0]) == pytest.approx(pose[2], abs=1e-6)


def test_the_wheels_turn_forward_with_their_counters() -> None:
    cycles = Cycles("khepera1")
    cycles.publish(0, 0)
    cycles.publish(100, -50)
    wheels = cycles.messages["/tf"][-3]["transforms"]
    names = [transform["child_frame_id"] for transform in wheels]
    assert names == ["lab/khepera0/left_wheel", "lab/khepera0/right_wheel"]
    for transform, pulses, side in zip(wheels, (100, -50), (1, -1), strict=True):
        angle = pulses * 2 * math.pi / 600  # about the axis to the left
        rotation = transform["transform"]["rotation"]
        assert 2 * math.atan2(rotation["y"], rotation["w"]) == pytest.approx(angle, abs=1e-6)
        assert transform["transform"]["translation"]["y"] == pytest.approx(side * 0.0265, abs=1e-3)


def test_the_voltage_of_the_supply_is_that_of_a_battery() -> None:
    cycles = Cycles("khepera1")
    cycles.output.begin()
    cycles.output.publish({SUPPLY_VOLTAGE: [4.9]})
    [battery] = cycles.messages["/lab/khepera0/battery_state"]
    assert battery["voltage"] == pytest.approx(4.9)
    assert math.isnan(battery["current"])
    assert battery["present"] == 1


def test_the_odometry_begins_anew_after_a_reset() -> None:
    cycles = Cycles("khepera1")
    cycles.publish(0, 0)
    cycles.publish(500, 500)
    assert cycles.messages["/lab/khepera0/odom"][-1]["pose"]["pose"]["position"]["x"] > 0.03
    cycles.output.restart()
    cycles.publish(0, 0)
    assert cycles.messages["/lab/khepera0/odom"][-1]["pose"]["pose"]["position"]["x"] == 0


def matrix(transform: dict[str, Any]) -> NDArray[np.float64]:
    """Return a transform in the plane as a matrix (3, 3)."""
    place, rotation = transform["transform"]["translation"], transform["transform"]["rotation"]
    angle = 2 * math.atan2(rotation["z"], rotation["w"])
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, place["x"]], [sin, cos, place["y"]], [0, 0, 1]])
