"""Keys, liveliness tokens and attachments: as rmw_zenoh's design document and zenoh-ros2-sdk have them."""

import pytest
from zenoh_ros2_sdk.attachment import Attachment as ForeignAttachment
from zenoh_ros2_sdk.qos import QosProfile

from khep_twin.errors import KhepTwinError
from khep_twin.log import qos
from khep_twin.log.qos import Qos
from khep_twin.ros import wire
from khep_twin.ros.wire import Attachment, Entity, EntityKind, NodeName

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_tokens_and_keys_are_those_of_the_design_document() -> None:
    listener = Entity(2, "aac3178e146ba6f1fc6e6a4085e77f21", 0, 0, EntityKind.NODE, NodeName.of("/listener"))
    assert listener.token == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    talker = Entity(
        2, "8b20917502ee955ac4476e0266340d5c", 0, 10, EntityKind.PUBLISHER, NodeName.of("/talker")
    )
    assert talker.endpoint_token("/chatter", STRING, HASH, Qos(7)) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/"
        f"%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
    )
    assert wire.data_key(0, "/chatter", STRING, HASH) == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"


def test_names_below_a_namespace_keep_their_slashes_in_keys_but_not_in_tokens() -> None:
    node = NodeName.of("lab/khepera0")
    assert (node.namespace, node.name, str(node)) == ("/lab", "khepera0", "/lab/khepera0")
    assert [node.resolve(topic) for topic in ("/tf", "~/odom", "map")] == [
        "/tf",
        "/lab/khepera0/odom",
        "/lab/map",
    ]
    token = Entity(0, "f", 1, 2, EntityKind.SERVICE, node).endpoint_token(
        "/lab/khepera0/step", "std_srvs/srv/Trigger", HASH, qos.DEFAULT
    )
    assert token == (
        f"@ros2_lv/0/f/1/2/SS/%/%lab/khepera0/%lab%khepera0%step/std_srvs::srv::dds_::Trigger_/{HASH}/::,10:,:,:,,"
    )
    assert wire.node_pattern(0, node) == "@ros2_lv/0/*/*/*/NN/*/%lab/khepera0"
    assert wire.data_key(0, "/lab/khepera0/odom", "nav_msgs/msg/Odometry", HASH) == (
        f"0/lab/khepera0/odom/nav_msgs::msg::dds_::Odometry_/{HASH}"
    )


@pytest.mark.parametrize("name", ["", "/", "a//b", "0robot", "a__b", "a*", "a/%", "é", "a/"])
def test_a_name_that_ros_refuses_is_refused(name: str) -> None:
    with pytest.raises(KhepTwinError, match="no name of a ROS node; expected letters"):
        NodeName.of(name)


def test_the_type_of_a_message_is_read_from_its_key() -> None:
    for type_name in (STRING, "std_srvs/srv/Trigger"):
        assert wire.type_of_key(wire.data_key(5, "/a/b", type_name, HASH)) == type_name
    assert wire.type_of_key("5/a/b/text\n/hash") == r"'text\n'"


@pytest.mark.parametrize(
    ("profile", "text"),
    [
        (qos.DEFAULT, "::,10:,:,:,,"),
        (qos.SENSOR, "2::,5:,:,:,,"),
        (qos.LATCHED, ":1:,1:,:,:,,"),
        (qos.CLOCK, "2::,1:,:,:,,"),
        (qos.TF, "::,100:,:,:,,"),
    ],
)
def test_another_library_reads_the_quality_of_service_of_a_token(profile: Qos, text: str) -> None:
    assert wire.qos_text(profile) == text
    read = QosProfile.decode(text)
    assert read.history_depth == profile.depth
    assert read.reliability.value == profile.reliability
    assert read.durability.value == profile.durability


def test_another_library_reads_and_writes_attachments() -> None:
    sender = wire.gid("a token")
    data = Attachment(3, 1_700_000_000_123_456_789, sender).to_bytes()
    assert data == ForeignAttachment(3, 1_700_000_000_123_456_789, sender).to_bytes()
    assert len(data) == 33
    assert Attachment.parse(data) == Attachment(3, 1_700_000_000_123_456_789, sender)
    for broken in (None, b"", data[:-1], data + b"\0", Attachment(-1, 0, sender).to_bytes()):
        assert Attachment.parse(broken) is None
