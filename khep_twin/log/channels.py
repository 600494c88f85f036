"""Channels of a log, as ROS 2 messages in CDR, which rerun and Foxglove read without code of khep_twin.

    /robot_description          std_msgs/String             playpen and robots as URDF, once
    /channel_names              std_msgs/String             meaning of each channel's numbers, once
    /scene                      foxglove.SceneUpdate        the scene for Foxglove, once (`foxglove_scene`)
    /tf                         tf2_msgs/TFMessage          poses of all bodies
    /khepera0/proximity         std_msgs/Float64MultiArray  counts, of a Khepera in the order of N
    /khepera0/ambient           std_msgs/Float64MultiArray  counts, of a Khepera in the order of O
    /khepera0/speed             std_msgs/Float64MultiArray  left, right; setpoint left, right [pulses/10 ms]
    /khepera0/position          std_msgs/Float64MultiArray  left, right [pulses], in logs of sensor tests
    /khepera0/duty              std_msgs/Float64MultiArray  left, right, -255 to 255
    /khepera0/leds              std_msgs/Float64MultiArray  LED 0 (lateral), 1 (frontal), 1 when lit
    /khepera0/ultrasonic        std_msgs/Float64MultiArray  left to right [cm], of a Khepera IV, whose other
                                                channels are in its model
    /khepera0/registers         std_msgs/Int64MultiArray    complete state of the board
    /khepera0/gripper           std_msgs/Int64MultiArray    complete state of a turret, by its name
    /khepera0/vision            sensor_msgs/Image           greys from left to right, of a camera turret
    /khepera0/serial            rcl_interfaces/Log          transcript, one line per message
    /khepera0/host_events       std_msgs/Int64MultiArray    actions of the host (`host_events`)
    /state                      std_msgs/Int64MultiArray    hashes of the complete state (`snapshots`)
    /snapshot                   std_msgs/UInt8MultiArray    complete state, to resume a run (`snapshots`)
    /lamps                      std_msgs/Float64MultiArray  power of each lamp [W], if any changes; /lamps_2
                                                and so on for lamps set up later
    /events                     rcl_interfaces/Log          events
    /shadow/...                 several                     estimate and alarms (`shadow_channels`)

CDR is the serialization format of ROS 2, here little-endian: a header of four bytes, then each value at a
multiple of its size, counted from the end of the header; a length precedes strings and sequences. Frequent
messages have a fixed size: many copies of a prepared frame are filled in together.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.cdr import CDR_HEADER, Encoder, Frame, encode
from khep_twin.log.message_types import MessageFields

FLOATS = "std_msgs/msg/Float64MultiArray"
INTEGERS = "std_msgs/msg/Int64MultiArray"
BYTES = "std_msgs/msg/UInt8MultiArray"
POSE = "geometry_msgs/msg/PoseStamped"
IMAGE = "sensor_msgs/msg/Image"
LINES = "rcl_interfaces/msg/Log"
SCENE = "foxglove_msgs/msg/SceneUpdate"
STRING = "std_msgs/msg/String"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

MAP = "map"
"""Frame of the scene, as REP 105 names it: origin at the inner corner of the playpen."""

BASE_FRAME = "{}/base_link"
"""Frame of a robot's body by the robot's name, as REP 105 names it."""


class Level(IntEnum):
    """Severity of a line of a log."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line of a transcript or of the events."""

    time_ns: int
    level: int
    name: str
    text: str


class ArrayFrame:
    """Frame of messages of one std_msgs/Float64MultiArray or Int64MultiArray channel, all of one length.

    Args:
        length: Length of the array.
        kind: "f8" for float64, "i8" for int64.
        label: Description of the array's values.
    """

    def __init__(self, length: int, kind: str, label: str) -> None:
        message = {"layout": _layout(length, label), "data": np.zeros(length, kind)}
        self._frame = Frame(FLOATS if kind == "f8" else INTEGERS, message, ["data"])

    def messages(self, values: NDArray[np.generic]) -> NDArray[np.void]:
        """Return one message for each row of values (n, length), as rows of bytes (n,)."""
        return self._frame.messages({"data": values})


class ImageFrame:
    """Frame of messages of one sensor_msgs/Image channel: line images of `width` grey pixels."""

    def __init__(self, width: int, name: str) -> None:
        message = {"header": {"frame_id": name}, "height": 1, "width": width, "encoding": "mono8"}
        self._frame = Frame(IMAGE, {**message, "step": width, "data": bytes(width)}, ["header.stamp", "data"])

    def messages(self, times_ns: NDArray[np.int64], images: NDArray[np.generic]) -> NDArray[np.void]:
        """Return one message for each time (n,) [ns] and image: greys from the left, 0 to 255 (n, width)."""
        return self._frame.messages({"header.stamp": times_ns, "data": images})


def array_message(values: NDArray[np.generic], label: str) -> bytes:
    """Return one std_msgs/Int64MultiArray of any length."""
    return ArrayFrame(len(values), "i8", label).messages(values[None]).tobytes()


def bytes_message(data: bytes, label: str) -> bytes:
    """Return one std_msgs/UInt8MultiArray."""
    return encode(BYTES, {"layout": _layout(len(data), label), "data": data})


def _layout(length: int, label: str) -> MessageFields:
    """Return the layout of an array with one dimension."""
    return {"dim": [{"label": label, "size": length, "stride": length}]}


class TransformFrame:
    """Frame of messages of /tf: poses of bodies, by pairs of a parent's frame and the body's own."""

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        transforms = [
            {"header": {"frame_id": parent}, "child_frame_id": name, "transform": {"rotation": {"w": 1}}}
            for parent, name in frames
        ]
        self._n_bodies = len(frames)
        variables = [
            f"transforms.{index}.{path}"
            for index in range(len(frames))
            for path in ("header.stamp", "transform")
        ]
        self._frame = Frame(TRANSFORMS, {"transforms": transforms}, variables)

    def messages(self, times_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.void]:
        """Return one message for each time (n,) [ns], as rows of bytes (n,).

        The poses are position [m] and quaternion x, y, z, w of each body (n, bodies, 7).
        """
        values: MessageFields = {}
        for index in range(self._n_bodies):
            values[f"transforms.{index}.header.stamp"] = times_ns
            values[f"transforms.{index}.transform"] = poses[:, index]
        return self._frame.messages(values)

    def parse(self, messages: Sequence[bytes]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which messages have these frames (n,), and the poses of those that do (m, bodies, 7)."""
        has_frames, rows = self._frame.parse(messages)
        poses = [rows[f"transforms.{index}.transform"] for index in range(self._n_bodies)]
        return has_frames, np.stack(poses, axis=1) if poses else np.zeros((len(rows), 0, 7))


PLANAR_ROWS = [0, 1, 5]
"""Rows of x, y and heading in the covariance of a 3-D pose."""


def pose_message(
    time_ns: int, pose: tuple[float, float, float], covariance: NDArray[np.float64] | None = None
) -> bytes:
    """Return a PoseStamped of x, y [m] and heading [rad], or PoseWithCovarianceStamped with a (3, 3)."""
    x, y, heading = pose
    encoder = Encoder().time(time_ns).text(MAP)
    encoder.append("d", x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
    if covariance is not None:
        full_covariance = np.zeros((6, 6))
        full_covariance[np.ix_(PLANAR_ROWS, PLANAR_ROWS)] = covariance
        encoder.append("d", *full_covariance.ravel().tolist())
    return encoder.message()


def text_message(text: str) -> bytes:
    """Return a std_msgs/String."""
    return Encoder().text(text).message()


def line_message(line: TextLine) -> bytes:
    """Return an rcl_interfaces/Log."""
    return LineFrame(line.name, line.level).message(line.time_ns, line.text.encode("utf-8"))


_LINE_TAILS = [
    bytes(1 + -size % 4) + Encoder().text("").text("").append("I", 0).message()[len(CDR_HEADER) :]
    for size in range(4)
]
"""Ends of lines by their size modulo 4: terminating 0, padding, and empty fields."""


class LineFrame:
    """Frame of messages of one rcl_interfaces/Log channel, from one source and of one severity."""

    def __init__(self, name: str, level: int) -> None:
        encoder = Encoder().time(0).append("B", level).text(name)
        encoder.align(4)
        self._middle = encoder.message()[len(CDR_HEADER) + struct.calcsize("iI") :]
        self._head = struct.Struct(f"<4siI{len(self._middle)}sI")

    def message(self, time_ns: int, text: bytes) -> bytes:
        """Return a line as a message, `text` in UTF-8."""
        seconds, nanoseconds = divmod(time_ns, NS_PER_S)
        size = len(text) + 1
        head = self._head.pack(CDR_HEADER, seconds, nanoseconds, self._middle, size)
        return head + text + _LINE_TAILS[size % 4]
