"""Readings of a robot as standard messages of its node, with the frames of its sensors."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.cdr import encode
from khep_twin.log.channels import BASE_FRAME, MAP, STRING, TRANSFORMS, TransformFrame, text_message
from khep_twin.log.decoding import decode
from khep_twin.log.frames import MovingBodies
from khep_twin.log.message_types import Message, MessageFields
from khep_twin.log.output import split_rows
from khep_twin.log.qos import LATCHED, qos_of
from khep_twin.log.transforms import compose, from_planar, invert
from khep_twin.playpen import parse
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.robots.body import Body
from khep_twin.robots.model import RobotModel, robot_name
from khep_twin.ros.distances import Floats
from khep_twin.ros.graph import Node, Publisher
from khep_twin.ros.robot_description import robot_description
from khep_twin.ros.standard import JOINTS, ODOM_FRAME, StandardMessages, transform_fields
from khep_twin.sensing.calibration import Calibration

_ARENA = """
version = 1
name = "robot"

[arena]
width_mm = 1000
height_mm = 1000

[[robot]]
model = "{}"
x_mm = 500
y_mm = 500
heading_deg = 0
"""
"""Playpen of one robot, for its description."""

_SCENE_NAME = robot_name(0)
"""Name of the robot in this playpen."""

Pose = tuple[float, float, float]
"""Position x, y [m] and heading [rad]."""


class StandardOutput:
    """Publishers of a robot's standard messages; each is made at the first message of its topic.

    Args:
        node: Node of the robot.
        model: Model of the robot.
        calibration: Calibration of the robot.
        now: Function that returns the time of stamps [ns].
        find_pose: Function that returns the true pose in the map, for a twin: the node then publishes the
            frame of odometry in the map so that the base has its true pose.
    """

    def __init__(
        self,
        node: Node,
        model: RobotModel,
        calibration: Calibration,
        now: Callable[[], int],
        find_pose: Callable[[], Pose] | None = None,
    ) -> None:
        self._node, self._now, self._find_pose = node, now, find_pose
        name = str(node.name).removeprefix("/")
        self._messages = StandardMessages(model, calibration, name)
        self._publishers: dict[str, Publisher] = {}
        self._time_ns, self._pose = 0, (0.0, 0.0, 0.0)
        self._odometry_in_map = TransformFrame([(MAP, ODOM_FRAME.format(name))])
        base, self._body = BASE_FRAME.format(name), model.body
        self._wheels = TransformFrame([(base, f"{name}/{side}_wheel") for side in ("left", "right")])
        scene = to_spec(parse(_ARENA.format(model.name), model.name)).compile()
        sensors = StandardMessages(model, calibration, _SCENE_NAME).static_transforms()
        fixed = decode(TRANSFORMS, MovingBodies(scene).static_message)["transforms"]
        static = {"transforms": [_rename(frame, name) for frame in (*fixed, *map(transform_fields, sensors))]}
        node.publisher("/tf_static", TRANSFORMS, LATCHED).send(encode(TRANSFORMS, static))
        description = robot_description(scene, sensors, _SCENE_NAME)
        description = description.replace(f'"{_SCENE_NAME}/', f'"{name}/')
        node.publisher("~/robot_description", STRING, LATCHED).send(text_message(description))

    def begin(self) -> None:
        """Take the time of a cycle, and the true pose."""
        self._time_ns = max(self._now(), 1)  # ROS takes 0 for no time
        if self._find_pose is not None:
            self._pose = self._find_pose()

    def publish(self, channels: Mapping[str, Sequence[float]]) -> None:
        """Publish the readings of the cycle by channel."""
        times_ns = np.array([self._time_ns])
        arrays = {name: np.array([values]) for name, values in channels.items()}
        for rows in self._messages.messages(times_ns, arrays):
            if rows.type_name == TRANSFORMS and self._find_pose is not None:
                truth = from_planar(np.array([self._pose]))
                pose = compose(truth, invert(rows.messages["transforms.0.transform"]))
                self._send_transforms(self._odometry_in_map.messages(times_ns, pose[:, None]))
            elif rows.type_name == JOINTS:
                poses = _wheel_poses(self._body, rows.messages["position"])
                self._send_transforms(self._wheels.messages(times_ns, poses))
            self._send(rows.topic, rows.type_name, rows.messages)

    def restart(self) -> None:
        """Restart the odometry."""
        self._messages.odometry.restart()

    def _send_transforms(self, messages: NDArray[np.void]) -> None:
        self._send("/tf", TRANSFORMS, messages)

    def _send(self, topic: str, type_name: str, messages: NDArray[np.void]) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self._node.publisher(topic, type_name, qos_of(topic))
        for message in split_rows(messages):
            self._publishers[topic].send(message)


def _wheel_poses(body: Body, angles: Floats) -> Floats:
    """Return poses of the wheels in the base, position and quaternion (n, 2, 7), by their angles (n, 2)."""
    poses = np.zeros((*angles.shape, 7))
    poses[..., 1] = np.array([0.5, -0.5]) * body.wheel_base
    poses[..., 2] = body.wheel_radius
    poses[..., 4], poses[..., 6] = np.sin(angles / 2), np.cos(angles / 2)
    return poses


def _rename(transform: Message, name: str) -> MessageFields:
    """Return a fixed transform of the scene's robot with the name of the robot of a node."""
    parent, child = (
        f"{name}/{frame.removeprefix(f'{_SCENE_NAME}/')}"
        for frame in (transform["header"]["frame_id"], transform["child_frame_id"])
    )
    return {**transform, "header": {"frame_id": parent}, "child_frame_id": child}
