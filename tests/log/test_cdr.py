"""Messages in CDR, against another library."""

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from khep_twin.log.cdr import Frame, encode
from khep_twin.log.decoding import DecodeError, decode
from khep_twin.log.message_types import SCHEMAS, Field, fields_of

STORE = get_typestore(Stores.ROS2_JAZZY)
RELEASED = [name for name in SCHEMAS if not name.startswith("foxglove_msgs/")]
TEXTS = ["", "a", "base", "khepera0/ps0"]


def draw(random: np.random.Generator, name: str) -> dict[str, Any]:
    """Return a random message of a type."""
    return {field.name: draw_field(random, field) for field in fields_of(name)}


def draw_field(random: np.random.Generator, field: Field) -> Any:
    if field.length is not None:
        count = field.length if field.length >= 0 else int(random.integers(4))
        return [draw_field(random, field._replace(length=None)) for _ in range(count)]
    name = field.type_name
    if name in ("builtin_interfaces/Time", "builtin_interfaces/Duration"):
        return int(random.integers(5 * 10**9))
    if name == "string":
        return TEXTS[random.integers(len(TEXTS))]
    if name.startswith("float"):
        return float(random.integers(-8, 8) / 4)
    return draw(random, name) if "/" in name else int(random.integers(2))


@pytest.mark.parametrize("name", RELEASED)
def test_another_library_reads_a_message_and_writes_the_same_bytes(name: str) -> None:
    random = np.random.default_rng(len(name))
    for _ in range(5):
        message = draw(random, name)
        data = encode(name, message)
        assert STORE.serialize_cdr(STORE.deserialize_cdr(data, name), name).tobytes() == data
        assert decode(name, data) == message


@pytest.mark.parametrize("name", SCHEMAS)
def test_absent_fields_are_empty(name: str) -> None:
    data = encode(name, {})
    assert encode(name, decode(name, data)) == data


def test_a_frame_gives_the_bytes_of_single_messages() -> None:
    name, shared = "sensor_msgs/msg/LaserScan", {"header": {"frame_id": "x"}, "angle_min": -1.0}
    frame = Frame(name, {**shared, "ranges": [0.0] * 3}, ["header.stamp", "ranges", "angle_max"])
    times_ns, ranges = np.array([7, 3 * 10**9 + 1]), np.array([[1, 2, np.inf], [-np.inf, 0.5, 4]])
    rows = frame.messages({"header.stamp": times_ns, "ranges": ranges, "angle_max": np.array([0.5, 1.5])})
    for row, time_ns, values, angle in zip(rows, times_ns.tolist(), ranges.tolist(), (0.5, 1.5), strict=True):
        header = {"stamp": time_ns, "frame_id": "x"}
        message = {**shared, "header": header, "ranges": values, "angle_max": angle}
        assert row.tobytes() == encode(name, message)


def test_a_frame_of_an_empty_sequence_is_one_message_for_each_row() -> None:
    frame = Frame("sensor_msgs/msg/JointState", {"name": []}, ["header.stamp", "position"])
    rows = frame.messages({"header.stamp": np.arange(3), "position": np.zeros((3, 0))})
    assert [decode("sensor_msgs/msg/JointState", row.tobytes())["header"]["stamp"] for row in rows] == [
        0,
        1,
        2,
    ]


@pytest.mark.parametrize(
    ("message", "reason"),
    [({"speed": 1}, "no field 'speed'"), ({"orientation_covariance": [1.0]}, "1 values; expected 9")],
)
def test_a_message_of_other_fields_is_an_error(message: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        encode("sensor_msgs/msg/Imu", message)


@pytest.mark.parametrize("name", RELEASED)
def test_cut_or_lengthened_bytes_are_refused(name: str) -> None:
    data = encode(name, draw(np.random.default_rng(1), name))
    for damaged in (data[:-1], data + b"\0", data[:3]):
        with pytest.raises(DecodeError, match="expected"):
            decode(name, damaged)
