"""The live view in Foxglove, read by a client of its protocol: the messages of a log, during a run."""

import json
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from driving import SECOND, drive
from foxglove_client import FoxgloveClient, Sent, client
from log_contents import messages_of
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from khep_twin.errors import PortError
from khep_twin.log.channels import LINES
from khep_twin.ports.twin import TwinOptions, open_twin

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
from khep_twin.log.channels import SCENE
from khep_twin.log.decoding import decode
from khep_twin.log.foxglove_live import LAYOUT, FoxgloveRecorder, FoxgloveServer

SAMPLED = [f"/khepera0/{name}" for name in ("proximity", "ambient", "speed", "duty", "leds", "registers")]
STANDING = ["/robot_description", "/channel_names", "/scene"]


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with closing(FoxgloveServer("127.0.0.1", 0, "test")) as server:
        yield server


def by_topic(log: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Times [ns] and messages of a log by topic."""
    messages: defaultdict[str, list[tuple[int, bytes]]] = defaultdict(list)
    for topic, message in messages_of(log):
        messages[topic].append((message.log_time, message.data))
    return messages


def decoded(watcher: FoxgloveClient, message: Sent) -> object:
    """A ROS 2 message, read by the definition that its channel was advertised with."""
    channel = watcher.channels[message.topic]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode(message.data)


def test_a_client_has_the_messages_of_the_log_byte_by_byte(server: FoxgloveServer, tmp_path: Path) -> None:
    topics = [*SAMPLED, "/tf", "/khepera0/serial", "/events", *STANDING]
    with open_twin("obstacles", TwinOptions(seed=3)) as twin, client(server.address) as watcher:
        twin.record(tmp_path / "run.mcap")
        twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
        watcher.subscribe(*topics)
        watcher.receive_until("/scene")  # it has subscribed
        twin.world.log_event(0, "put down")
        drive(twin)
        twin.flush()
        twin.world.log_event(0, "taken away")
        messages = watcher.receive_until("/events", 2 * SECOND)
    sent: defaultdict[str, list[tuple[int, bytes]]] = defaultdict(list)
    for message in messages:
        sent[message.topic].append((message.time_ns, message.data))
    logged = by_topic(tmp_path / "run.mcap")
    assert logged["/events"][-2:] == sent["/events"]
    for topic in [*SAMPLED, "/tf"]:
        assert sent[topic] == logged[topic][1:], topic  # the first one was before it came
    assert sent["/khepera0/serial"]
    assert sent["/khepera0/serial"] == logged["/khepera0/serial"]


def test_an_independent_reader_decodes_them(server: FoxgloveServer) -> None:
    with open_twin("obstacles", TwinOptions(seed=3)) as twin, client(server.address) as watcher:
        twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
        watcher.subscribe("/khepera0/speed", "/tf", "/khepera0/serial", "/events", "/scene")
        scene = watcher.receive_until("/scene")[-1]
        drive(twin)
        twin.flush()
        twin.world.log_event(0, "taken away")
        messages = watcher.receive_until("/events", 2 * SECOND)
        assert watcher.info["capabilities"] == ["time"]  # nothing that a client could change
    last = {message.topic: decoded(watcher, message) for message in messages}
    assert last["/khepera0/speed"].data[2:] == [8.0, 5.0]
    poses = {
        transform.child_frame_id: transform.transform.translation for transform in last["/tf"].transforms
    }
    x, y, _ = twin.robot.pose
    assert (poses["khepera0/base_link"].x, poses["khepera0/base_link"].y) == pytest.approx((x, y), abs=1e-8)
    assert last["/khepera0/serial"].name in ("host", "robot")
    channel = watcher.channels["/scene"]
    assert (channel["encoding"], channel["schemaName"]) == ("cdr", SCENE)
    assert "khepera0/base_link" in {entity["id"] for entity in decode(SCENE, scene.data)["entities"]}


def test_who_subscribes_late_has_the_scene_and_the_time(server: FoxgloveServer, tmp_path: Path) -> None:
    with open_twin("default", TwinOptions()) as twin:
        twin.record(tmp_path / "run.mcap")
        twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
        drive(twin, 1)
        with client(server.address) as watcher:
            watcher.subscribe("/events", *STANDING)
            messages = watcher.receive_until(STANDING[-1])  # it has subscribed
            twin.flush()
            twin.world.log_event(0, "taken away")
            watcher.receive_until("/events")
            watcher.until_time(SECOND)
    logged = by_topic(tmp_path / "run.mcap")
    assert {message.topic: message.data for message in messages} == {
        topic: logged[topic][0][1] for topic in STANDING
    }
    assert watcher.time_ns == SECOND


def test_a_client_that_never_reads_holds_no_run_up(server: FoxgloveServer) -> None:
    ended = threading.Event()
    with open_twin("default", TwinOptions()) as twin, client(server.address) as watcher:
        twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
        watcher.subscribe(*SAMPLED, "/tf", "/scene")
        watcher.receive_until("/scene")

        def go() -> None:
            twin.advance_to(20 * SECOND)
            ended.set()

        threading.Thread(target=go, daemon=True).start()
        assert ended.wait(300)


def test_another_run_begins_a_new_session(server: FoxgloveServer) -> None:
    with client(server.address) as watcher:
        reply: dict[str, object] = {}
        for _ in range(60):  # the server may not know its client yet
            with open_twin("default", TwinOptions()) as twin:
                twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
                drive(twin, 1)
            with suppress(TimeoutError):
                while reply.get("op") != "serverInfo":
                    text = watcher.connection.recv(1)
                    reply = json.loads(text) if isinstance(text, str) else {}
                break
    assert reply["sessionId"] != watcher.info["sessionId"]


def test_a_port_in_use_is_one_line(server: FoxgloveServer) -> None:
    port = int(server.address.rpartition(":")[2])
    message = f"^127.0.0.1:{port}: Foxglove cannot be served here: Address already in use$"
    with pytest.raises(PortError, match=message):
        FoxgloveServer("127.0.0.1", port, "second")


def test_the_layout_shows_channels_that_a_log_has(log: Path) -> None:
    layout = json.loads(LAYOUT.read_text())
    topics = {topic for topic, _ in messages_of(log)}
    panels = layout["configById"].values()
    shown_topics = {path["value"].partition(".")[0] for panel in panels for path in panel.get("paths", [])}
    shown_topics |= {panel["topicToRender"] for panel in panels if "topicToRender" in panel}
    shown_topics |= {topic for panel in panels for topic in panel.get("topics", {})}
    assert shown_topics
    assert shown_topics <= topics


def test_what_a_client_sends_changes_nothing(server: FoxgloveServer) -> None:
    with open_twin("default", TwinOptions()) as twin, client(server.address) as watcher:
        twin.watch(FoxgloveRecorder(server, twin.world, real_time=False))
        channel = {
            "id": 1,
            "topic": "/khepera0/serial",
            "encoding": "cdr",
            "schemaName": LINES,
        }
        watcher.connection.send(json.dumps({"op": "advertise", "channels": [channel]}))
        watcher.connection.send(b"\x01\x01\x00\x00\x00D,9,9\n")
        watcher.connection.send("no JSON")
        watcher.subscribe("/khepera0/speed", "/scene")
        watcher.receive_until("/scene")
        drive(twin, 1)
        twin.flush()
        speeds = decoded(watcher, watcher.receive_until("/khepera0/speed", SECOND)[-1])
    with open_twin("default", TwinOptions()) as alone:
        drive(alone, 1)
    assert speeds.data[2:] == [8.0, 5.0]
    assert twin.robot.pose == alone.robot.pose
