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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S

CDR_HEADER = b"\x00\x01\x00\x00"
FLOATS = "std_msgs/msg/Float64MultiArray"
INTEGERS = "std_msgs/msg/Int64MultiArray"
BYTES = "std_msgs/msg/UInt8MultiArray"
POSE = "geometry_msgs/msg/PoseStamped"
IMAGE = "sensor_msgs/msg/Image"
LINES = "rcl_interfaces/msg/Log"
STRING = "std_msgs/msg/String"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

_ARRAY = "std_msgs/MultiArrayLayout layout\n{}[] data"
_XYZ = "float64 x\nfloat64 y\nfloat64 z"

_FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\n"
    "geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Quaternion": f"{_XYZ}\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "geometry_msgs/Vector3": _XYZ,
    "rcl_interfaces/Log": "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
    "uint32 line",
    "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data",
    "std_msgs/Float64MultiArray": _ARRAY.format("float64"),
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/Int64MultiArray": _ARRAY.format("int64"),
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/String": "string data",
    "std_msgs/UInt8MultiArray": _ARRAY.format("uint8"),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
"""Fields of each message type."""


def _definition(schema: str) -> str:
    """Return the definition of a type: its fields, then those of each type in them."""
    names: list[str] = []

    def add(name: str) -> None:
        if name in _FIELDS and name not in names:
            names.append(name)
            for line in _FIELDS[name].splitlines():
                add(line.split()[0].removesuffix("[]"))

    add(schema.replace("/msg/", "/"))
    inner = [f"{'=' * 80}\nMSG: {name}\n{_FIELDS[name]}" for name in names[1:]]
    return "\n".join([_FIELDS[names[0]], *inner])


_TYPES = FLOATS, INTEGERS, BYTES, IMAGE, POSE, POSE_WITH_COVARIANCE, LINES, STRING, TRANSFORMS
SCHEMAS = {schema: _definition(schema) for schema in _TYPES}
"""Definition of each message type, as text of a `ros2msg` schema."""


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


class Encoder:
    """Encoder of consecutive values, aligned as required by CDR."""

    def __init__(self) -> None:
        self._data = bytearray()

    def append(self, kind: str, *values: float) -> "Encoder":
        """Append numbers, `kind` as in `struct`."""
        self.align(struct.calcsize(kind))
        self._data += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, value: str) -> "Encoder":
        """Append a string."""
        data = value.encode("utf-8") + b"\0"
        self.append("I", len(data))
        self._data += data
        return self

    def time(self, time_ns: int) -> "Encoder":
        """Append a time since the start of the run."""
        return self.append("i", time_ns // NS_PER_S).append("I", time_ns % NS_PER_S)

    def align(self, size: int) -> int:
        """Pad to a multiple of `size`; return the offset in the finished message."""
        self._data += bytes(-len(self._data) % size)
        return len(CDR_HEADER) + len(self._data)

    def message(self) -> bytes:
        """Return the finished message."""
        return CDR_HEADER + bytes(self._data)


class ArrayFrame:
    """Frame of messages of one std_msgs/Float64MultiArray or Int64MultiArray channel, all of one length.

    Args:
        length: Length of the array.
        kind: "f8" for float64, "i8" for int64.
        label: Description of the array's values.
    """

    def __init__(self, length: int, kind: str, label: str) -> None:
        head = _array_head(length, label)
        self._frame = head + bytes(8 * length)
        self._dtype = _message_type(len(self._frame), {"values": (f"<{kind}", length, len(head))})

    def messages(self, values: NDArray[Any]) -> NDArray[np.void]:
        """Return one message for each row of values (n, length), as rows of bytes (n,)."""
        rows = _repeat_frame(self._frame, len(values), self._dtype)
        rows["values"] = values
        return rows


class ImageFrame:
    """Frame of messages of one sensor_msgs/Image channel: line images of `width` grey pixels."""

    def __init__(self, width: int, name: str) -> None:
        encoder = Encoder()
        stamp_offset = encoder.align(4)
        encoder.time(0).text(name).append("I", 1, width).text("mono8")
        encoder.append("B", 0).append("I", width, width)
        self._frame = encoder.message() + bytes(width)
        fields = {"stamp": ("<i4", 2, stamp_offset), "data": ("u1", width, len(self._frame) - width)}
        self._dtype = _message_type(len(self._frame), fields)

    def messages(self, times_ns: NDArray[np.int64], images: NDArray[Any]) -> NDArray[np.void]:
        """Return one message for each time (n,) [ns] and image: greys from the left, 0 to 255 (n, width)."""
        rows = _repeat_frame(self._frame, len(times_ns), self._dtype)
        rows["stamp"] = np.column_stack(np.divmod(times_ns, NS_PER_S))
        rows["data"] = images
        return rows


def array_message(values: NDArray[Any], label: str) -> bytes:
    """Return one std_msgs/Int64MultiArray of any length."""
    return _array_head(len(values), label) + values.astype("<i8").tobytes()


def bytes_message(data: bytes, label: str) -> bytes:
    """Return one std_msgs/UInt8MultiArray."""
    n = len(data)
    return Encoder().append("I", 1).text(label).append("I", n, n, 0, n).message() + data


def _array_head(length: int, label: str) -> bytes:
    """Return the message of an array without its values."""
    encoder = Encoder().append("I", 1).text(label).append("I", length, length, 0, length)
    encoder.align(8)
    return encoder.message()


class TransformFrame:
    """Frame of messages of /tf: poses of bodies, by the names of their frames, in the world frame."""

    def __init__(self, names: Sequence[str]) -> None:
        encoder = Encoder().append("I", len(names))
        fields: dict[str, tuple[str, int, int]] = {}
        for index, name in enumerate(names):
            fields[f"stamp {index}"] = ("<i4", 2, encoder.align(4))
            encoder.time(0).text("world").text(name)
            fields[f"pose {index}"] = ("<f8", 7, encoder.align(8))
            encoder.append("d", 0, 0, 0, 0, 0, 0, 1)
        self._n_bodies = len(names)
        self._frame = encoder.message()
        self._dtype = _message_type(len(self._frame), fields)

    def messages(self, times_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.void]:
        """Return one message for each time (n,) [ns], as rows of bytes (n,).

        The poses are position [m] and quaternion x, y, z, w of each body (n, bodies, 7).
        """
        rows = _repeat_frame(self._frame, len(times_ns), self._dtype)
        stamps = np.column_stack(np.divmod(times_ns, NS_PER_S))
        for index in range(self._n_bodies):
            rows[f"stamp {index}"] = stamps
            rows[f"pose {index}"] = poses[:, index]
        return rows


def _message_type(size: int, fields: dict[str, tuple[str, int, int]]) -> np.dtype[np.void]:
    """Return the type of a message of `size` bytes with named fields: format, length and offset."""
    formats = [(number_format, (length,)) for number_format, length, _ in fields.values()]
    offsets = [offset for _, _, offset in fields.values()]
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size})


def _repeat_frame(frame: bytes, count: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Return `count` copies of a message, to be filled in."""
    return np.frombuffer(bytearray(frame * count), dtype)


PLANAR_ROWS = [0, 1, 5]
"""Rows of x, y and heading in the covariance of a 3-D pose."""


def pose_message(
    time_ns: int, pose: tuple[float, float, float], covariance: NDArray[np.float64] | None = None
) -> bytes:
    """Return a PoseStamped of x, y [m] and heading [rad], or PoseWithCovarianceStamped with a (3, 3)."""
    x, y, heading = pose
    encoder = Encoder().time(time_ns).text("world")
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
