"""Bags of ROS 2: the rules of rosbag2, and the readers of rosbags, which know nothing of khep_twin."""

import json
import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import complaint, good
from log_rewriting import rewritten
from mcap.reader import make_reader
from numpy.typing import NDArray
from relay_logs import in_turn, relayed
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import StoragePlugin, Writer, storage_mcap
from rosbags.rosbag2 import reader as bag_reader
from rosbags.typesys import Stores, get_typestore
from scenes import arena, robot, table

from khep_twin import playpen as playpens
from khep_twin.log import reader
from khep_twin.log.decoding import decode
from khep_twin.log.message_types import type_hash
from khep_twin.log.reader import LoggedRun, read_log, read_series
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.ros.bag import write_bag

JAZZY = get_typestore(Stores.ROS2_JAZZY)
QOS_KEYS = (
    *("history", "depth", "reliability", "durability", "deadline", "lifespan", "liveliness"),
    *("liveliness_lease_duration", "avoid_ros_namespace_conventions"),
)
LOG_OF_1_0 = Path(__file__).parents[1] / "data" / "log_of_1_0.mcap"
LATCHED = {"/robot_description", "/tf_static", "/scene", "/channel_names"}
Topics = dict[str, list[tuple[int, dict[str, Any]]]]
BLOCK = table("block", x_mm=600, y_mm=350, length_mm=40, width_mm=40, height_mm=40, movable=True)
ROBOTS = robot(200, 350, 30, model="khepera4"), robot(400, 350, 90, turrets=["gripper", "k213"])
PLAYPEN = "".join([arena(900, 700), BLOCK, *ROBOTS])


@pytest.fixture(scope="module", autouse=True)
def cached_profiles() -> Iterator[None]:
    """Have rosbags parse each text of a quality of service once, which takes it 6 ms."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (bag_reader, storage_mcap):
            patch.setattr(module, "parse_qos", cache(module.parse_qos))
        yield


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 1 s: a Khepera IV, a Khepera with turrets, a block that moves."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with open_twin(playpens.parse(PLAYPEN, "two"), TwinOptions(seed=3, log=str(path))) as twin:
        for driven, order in zip(twin.world.robots, (b"D,200,300\n", b"D,8,5\n"), strict=True):
            driven.send(order)
        twin.advance_to(1_000_000_000)
    return path


@pytest.fixture(scope="module")
def bag(log: Path) -> Path:
    """That log as a bag."""
    folder = log.with_name("bag")
    write_bag(log, folder)
    return folder


@pytest.fixture(scope="module")
def topics(bag: Path) -> Topics:
    """Return its messages."""
    return read(bag)


def check_rules(path: Path) -> None:
    """Check what rosbag2 requires of a bare file: one encoding, types, statistics, QoS and hashes."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values())
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (schema.encoding, schema.name.split("/")[1]) == ("ros2msg", "msg")
        assert channel.metadata["topic_type_hash"] == type_hash(schema.name)
        if "foxglove" not in schema.name:
            assert type_hash(schema.name) == JAZZY.hash_rihs01(schema.name)
        lines = channel.metadata["offered_qos_profiles"].splitlines()
        assert [line[2:].split(":")[0] for line in lines] == [*QOS_KEYS]


def messages_of(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield topic, type, time [ns] and content of the messages of a file, or of the one of a bag."""
    (file_path,) = [path] if path.is_file() else path.glob("*.mcap")
    with file_path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            yield channel.topic, schema.name, message.log_time, message.data


def read(path: Path) -> Topics:
    """Return times and decoded messages of each topic."""
    topics: defaultdict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    for topic, type_name, time_ns, data in messages_of(path):
        topics[topic].append((time_ns, decode(type_name, data)))
    return topics


def test_logs_and_bags_keep_the_rules_of_rosbag2(log: Path, bag: Path) -> None:
    check_rules(log)
    check_rules(bag / "bag.mcap")


def check_messages(foreign: AnyReader) -> None:
    """Check that each message has the bytes that the type of the distribution encodes."""
    for connection, _, data in foreign.messages():
        if "foxglove" not in (type_name := connection.msgtype):
            message = JAZZY.deserialize_cdr(data, type_name)
            assert JAZZY.serialize_cdr(message, type_name) == data, connection.topic


def test_rosbags_reads_a_bare_log_and_its_messages_are_jazzys(log: Path) -> None:
    with AnyReader([log]) as foreign:
        check_messages(foreign)


def test_rosbags_reads_a_bag_with_qos_and_writes_it_again(bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    with AnyReader([bag]) as foreign, Writer(copy, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        check_messages(foreign)
        connections: dict[int, Any] = {}
        for connection in foreign.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            profiles = connection.ext.offered_qos_profiles
            is_latched = profiles[0].durability.name == "TRANSIENT_LOCAL"
            assert is_latched == (connection.topic in LATCHED)
            connections[connection.id] = writer.add_connection(
                connection.topic,
                connection.msgtype,
                typestore=foreign.typestore,
                offered_qos_profiles=profiles,
            )
        for connection, time_ns, data in foreign.messages():
            writer.write(connections[connection.id], time_ns, data)
    assert sorted(messages_of(copy)) == sorted(messages_of(bag))


def test_the_metadata_counts_the_messages_of_the_file(bag: Path) -> None:
    information = json.loads((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    counts = {
        item["topic_metadata"]["name"]: item["message_count"]
        for item in information["topics_with_message_count"]
    }
    messages = [*messages_of(bag / "bag.mcap")]
    assert counts == {topic: sum(m[0] == topic for m in messages) for topic in {m[0] for m in messages}}
    assert (information["version"], information["relative_file_paths"]) == (8, ["bag.mcap"])
    assert information["duration"]["nanoseconds"] == messages[-1][2] - messages[0][2]


def test_a_bag_has_the_raw_channels_and_standard_messages_of_each_robot(log: Path, topics: Topics) -> None:
    raw = read(log)
    for topic in (
        "/khepera0/battery",
        "/khepera1/registers",
        "/khepera1/gripper",
        "/events",
        "/khepera1/serial",
    ):
        assert topics[topic] == raw[topic]
    assert not {
        topic for topic in topics if topic.endswith(("host_events", "state", "snapshot", "1/vision"))
    } - {"/khepera0/battery_state"}
    names = {"odom", "joint_states", "scan", *(f"ps{k}" for k in range(8)), *(f"ls{k}" for k in range(8))}
    more = {"imu", "battery_state", *(f"us{k}" for k in range(5)), *(f"gs{k}" for k in range(4))}
    assert {f"/khepera0/{name}" for name in names | more} <= topics.keys()
    assert {f"/khepera1/{name}" for name in names | {"vision/image_raw"}} <= topics.keys()
    assert [m["data"] for _, m in topics["/khepera1/vision/image_raw"]] == [
        m["data"] for t, m in raw["/khepera1/vision"] if t
    ]


def test_no_stamp_is_0_and_each_is_the_time_of_its_message(topics: Topics) -> None:
    for topic in topics.keys() - LATCHED:
        for time_ns, message in topics[topic]:
            stamps = [message[key] for key in ("clock", "stamp") if key in message]
            stamps += [message["header"]["stamp"]] if "header" in message else []
            stamps += [item["header"]["stamp"] for item in message.get("transforms", [])]
            assert all(stamp == time_ns > 0 or topic.endswith(("events", "serial")) for stamp in stamps)
    assert [m["clock"] for _, m in topics["/clock"]] == [20_000_000 * k for k in range(1, 51)]


def rotation(heading: float) -> NDArray[np.float64]:
    return np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])


def check_tree(topics: Topics, run: LoggedRun) -> dict[str, str]:
    """Check that the robots of a bag are at their true places at the end; return the parents of frames."""
    parents: dict[str, str] = {}
    for topic in ("/tf", "/tf_static"):
        for _, message in topics[topic]:
            for item in message["transforms"]:
                parent = item["header"]["frame_id"]
                assert parents.setdefault(item["child_frame_id"], parent) == parent
    _, message = topics["/tf"][-1]
    poses = {item["child_frame_id"]: item["transform"] for item in message["transforms"]}
    for name, track in run.robots.items():
        places: list[NDArray[np.float64]] = []
        headings: list[float] = []
        for frame in ("odom", "base_link"):
            pose = poses[f"{name}/{frame}"]
            places.append(np.array([pose["translation"]["x"], pose["translation"]["y"]]))
            headings.append(2 * math.atan2(pose["rotation"]["z"], pose["rotation"]["w"]))
        assert places[0] + rotation(headings[0]) @ places[1] == pytest.approx(track.pose[-1, :2], abs=1e-6)
        assert math.remainder(sum(headings) - track.pose[-1, 2], math.tau) == pytest.approx(0, abs=1e-5)
        _, odom = topics[f"/{name}/odom"][-1]
        assert odom["pose"]["pose"]["position"] == poses[f"{name}/base_link"]["translation"]
        assert np.hypot(*places[1]) > 0.01
        assert parents[f"{name}/left_wheel"] == parents[f"{name}/ps3"] == f"{name}/base_link"
    urdf = ElementTree.fromstring(topics["/robot_description"][0][1]["data"])
    joints = {
        joint.find("child").attrib["link"]: joint.find("parent").attrib["link"]
        for joint in urdf.iterfind("joint")
    }
    assert joints == parents
    wheels = topics["/khepera0/joint_states"][0][1]["name"]
    assert {*wheels} <= {joint.attrib["name"] for joint in urdf.iterfind("joint[@type='continuous']")}
    return parents


def test_the_frames_are_the_tree_of_the_description_with_the_robots_at_their_true_places(
    log: Path, topics: Topics
) -> None:
    parents = check_tree(topics, read_log(log))
    assert parents["khepera0/base_link"] == "khepera0/odom"
    assert parents["khepera0/odom"] == "map"
    assert parents["khepera1/gripper/left_finger"] == "khepera1/gripper/arm"


def test_a_log_of_version_1_0_becomes_a_bag(tmp_path: Path) -> None:
    """In such a log, all poses are in the frame world, and a robot's frame is that of its body."""
    write_bag(LOG_OF_1_0, tmp_path / "bag")
    check_rules(tmp_path / "bag" / "bag.mcap")
    check_tree(read(tmp_path / "bag"), read_log(LOG_OF_1_0))


def test_the_rate_of_sensors_is_an_option_that_odometry_ignores(log: Path, tmp_path: Path) -> None:
    message = good("export", log, "--ros2", tmp_path / "slow", "--rate", "2")
    topics = read(tmp_path / "slow")
    assert [time_ns for time_ns, _ in topics["/khepera0/ps0"]] == [500_000_000, 1_000_000_000]
    assert len(topics["/khepera0/odom"]) == 50
    n_messages = sum(map(len, topics.values()))
    assert f"slow: {len(topics)} topics, {n_messages} messages" in message.replace("\n", " ")


def test_batches_of_any_size_give_the_same_messages(
    log: Path, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "BATCH_BYTES", 1000)
    write_bag(log, tmp_path / "small")
    assert sorted(messages_of(tmp_path / "small")) == sorted(messages_of(bag))


def test_the_log_of_a_real_robot_gives_what_its_replies_allow(tmp_path: Path) -> None:
    lines = [
        b"N\n",
        b"n,0,0,500,0,0,0,0,1023\r\n",
        b"H\n",
        b"h,0,0\r\n",
        b"O\n",
        b"o,500,500,500,500,500,500,500,500\r\n",
    ]
    lines += [b"H\n", b"h,100,100\r\n", b"H\n", b"h,10x,100\r\n"]
    log = relayed(tmp_path / "relay.mcap", in_turn(*lines))
    write_bag(log, tmp_path / "bag")
    check_rules(tmp_path / "bag" / "bag.mcap")
    topics = read(tmp_path / "bag")
    (_, first), (_, second) = topics["/khepera0/odom"]
    assert first["pose"]["pose"]["position"]["x"] == 0
    assert second["pose"]["pose"]["position"]["x"] == pytest.approx(0.008, abs=1e-6)
    assert [item["child_frame_id"] for item in topics["/tf"][0][1]["transforms"]] == ["khepera0/base_link"]
    assert topics["/khepera0/ps7"][0][1]["range"] == -math.inf
    assert not {"/clock", "/robot_description", "/scene"} & topics.keys()
    assert len(topics["/tf_static"][0][1]["transforms"]) == 9


@pytest.mark.parametrize("playpen", ["arena3", "arena4-table"])
def test_other_robots_and_playpens_become_bags(playpen: str, tmp_path: Path) -> None:
    with open_twin(playpen, TwinOptions(log=str(tmp_path / "run.mcap"))) as twin:
        twin.advance_to(100_000_000)
        robots = [robot.name for robot in twin.world.robots]
    write_bag(tmp_path / "run.mcap", tmp_path / "bag")
    check_rules(tmp_path / "bag" / "bag.mcap")
    topics = read(tmp_path / "bag")
    assert all(len(topics[f"/{robot}/odom"]) == 5 for robot in robots)


def test_the_description_of_an_edited_scene_keeps_joints_and_sensors(log: Path, tmp_path: Path) -> None:
    branch = tmp_path / "branch.mcap"
    good("branch", log, "--at", 0.5, "--set", "block.1.x_mm=700", "-o", branch)
    write_bag(branch, tmp_path / "bag")
    first, second = (
        ElementTree.fromstring(m["data"]) for _, m in read(tmp_path / "bag")["/robot_description"]
    )
    assert [joint.attrib for joint in first.iter("joint")] == [joint.attrib for joint in second.iter("joint")]
    n_shapes = [len(urdf.findall("link/visual")) for urdf in (first, second)]
    assert n_shapes[0] == n_shapes[1] > 0
    assert second.find("link/collision") is None


def test_a_bag_is_no_log_and_a_log_without_an_end_is_no_bag(log: Path, bag: Path, tmp_path: Path) -> None:
    assert "no log of khep_twin" in complaint("export", bag / "bag.mcap", "--ros2", tmp_path / "new")
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:-1000])
    assert "no whole log" in complaint("export", torn, "--ros2", tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["torn.mcap"]


def test_only_a_bag_is_replaced_and_only_with_force(log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write_bag(log, folder)
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert "is there already; expected another name, or --force" in complaint("export", log, "--ros2", folder)
    good("export", log, "--ros2", folder, "--force")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == files
    (folder / "metadata.yaml").unlink()
    assert "is no bag; expected a new name" in complaint("export", log, "--ros2", folder, "--force")
    (folder / "metadata.yaml").touch()
    inside = folder / "run.mcap"
    inside.write_bytes(log.read_bytes())
    assert "has the log; expected another folder" in complaint("export", inside, "--ros2", folder, "--force")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rate", "0"], "--rate 0: expected a rate above 0 and up to 1000 Hz"),
        (["--rate", "nan"], "--rate nan: expected a rate above 0 and up to 1000 Hz"),
        (["-o", "table.csv"], "--ros2 with -o; expected a bag alone"),
        (["--robot", "khepera0"], "--ros2 with --robot; expected a bag alone"),
        (["more.mcap"], "2 logs; expected one for a bag"),
    ],
)
def test_options_of_other_exports_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    assert message in complaint("export", "run.mcap", "--ros2", tmp_path / "bag", *options)


def test_a_rate_without_a_bag_is_refused() -> None:
    assert "--rate 5: expected it with --ros2 alone" in complaint(
        "export", "run.mcap", "--rate", "5", "-o", "a.csv"
    )


def test_no_folder_remains_of_a_log_that_is_invalid_in_its_middle(log: Path, tmp_path: Path) -> None:
    def damage(topic: str, time_ns: int, data: bytes) -> bytes:
        return data[:-8] if (topic, time_ns) == ("/tf", 500_000_000) else data

    damaged = rewritten(log, tmp_path / "damaged.mcap", damage)
    assert "damaged.mcap: /tf at 0.5000 s" in complaint("export", damaged, "--ros2", tmp_path / "bag")
    assert [path.name for path in tmp_path.iterdir()] == ["damaged.mcap"]
    assert read_series(log).series
