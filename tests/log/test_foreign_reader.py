"""Logs read by mcap and mcap-ros2-support, which know nothing of khep_twin: the same values as by ours."""

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driving import drive
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from khep_twin.log.message_types import SCHEMAS
from khep_twin.log.reader import read_series
from khep_twin.ports.twin import TwinOptions, open_twin

PLAYPENS = ["obstacles", "stripes", "gripper", "two-lamps"]
FOR_REPEAT = ("host_events", "state", "snapshot")


@pytest.fixture(scope="module", params=PLAYPENS)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of two seconds in a playpen: with turrets, an image, objects, lamps."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with open_twin(request.param, TwinOptions(seed=3, log=str(path))) as twin:
        drive(twin)
        twin.world.log_event(0, "taken away — au revoir")
    return path


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return all ROS 2 messages by topic, in order of time, as objects of that package."""
    messages: defaultdict[str, list[tuple[int, Any]]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        for decoded_message in reader.iter_decoded_messages():
            messages[decoded_message.channel.topic].append(
                (decoded_message.message.log_time, decoded_message.decoded_message)
            )
    return messages


def test_numbers_are_the_same(run: Path) -> None:
    messages, series = decoded(run), read_series(run).series
    compared = set()
    for topic, (first, *_) in (
        (topic, [message for _, message in series]) for topic, series in messages.items()
    ):
        if topic in series and topic.split("/")[-1] not in FOR_REPEAT:
            values = np.array([list(message.data) for _, message in messages[topic]])
            assert [time_ns for time_ns, _ in messages[topic]] == series[topic].times_ns.tolist()
            assert values.tolist() == series[topic].values.tolist()
            if hasattr(first, "layout"):
                assert [first.layout.dim[0].size, first.layout.data_offset] == [values.shape[1], 0]
                assert first.layout.dim[0].label
            compared.add(topic)
    assert {"/khepera0/proximity", "/khepera0/speed", "/khepera0/registers"} < compared


def test_an_image_has_its_shape_and_time(run: Path) -> None:
    images = decoded(run).get("/khepera0/vision")
    if "stripes" not in read_series(run).label.metadata["playpen"]:
        assert images is None
        return
    assert images is not None
    for time_ns, image in images:
        assert (image.height, image.width, image.encoding, image.step) == (1, 64, "mono8", 64)
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == time_ns
        assert image.header.frame_id == "khepera0/k213"


def test_poses_are_the_same(run: Path) -> None:
    expected = read_series(run).series["/khepera0/pose"]
    frames = decoded(run)["/tf"]
    assert [time_ns for time_ns, _ in frames] == expected.times_ns.tolist()
    for (time_ns, frame), (x, y, heading) in zip(frames, expected.values.tolist(), strict=True):
        (base,) = (pose for pose in frame.transforms if pose.child_frame_id == "khepera0/base_link")
        assert base.header.frame_id == "map"
        assert base.header.stamp.sec * 10**9 + base.header.stamp.nanosec == time_ns
        place, turn = base.transform.translation, base.transform.rotation
        assert (place.x, place.y) == (x, y)
        yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
        assert yaw == pytest.approx(heading, abs=1e-12)


def test_lines_are_the_same(run: Path) -> None:
    messages = decoded(run)
    for topic, lines in read_series(run).lines.items():
        assert lines
        assert [
            (time_ns, message.level, message.name, message.msg) for time_ns, message in messages[topic]
        ] == [(line.time_ns, line.level, line.name, line.text) for line in lines]
        for time_ns, logged in messages[topic]:
            assert logged.stamp.sec * 10**9 + logged.stamp.nanosec == time_ns
    assert messages["/events"][-1][1].msg == "taken away — au revoir"


def test_texts_are_whole(run: Path) -> None:
    messages = decoded(run)
    assert messages["/robot_description"][0][1].data.endswith("</robot>")
    assert "proximity" in messages["/channel_names"][0][1].data
    with run.open("rb") as file:
        settings = {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}
    assert json.loads(settings["configuration.json"])["seed"] == 3
    assert {type(message).__name__ for series in messages.values() for _, message in series} <= {
        name.rpartition("/")[2] for name in SCHEMAS
    }
