"""Texts and bytes by which nodes of ROS 2 find each other over Zenoh, as rmw_zenoh forms them.

A topic's data have one key per type: `0/khepera0/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_...`. Each node,
and each of its endpoints, has a liveliness token, whose key describes it. Each message has an attachment:
number, time of sending, and the identifier (GID) of its sender.
"""

import re
import struct
from dataclasses import dataclass
from enum import StrEnum
from hashlib import sha256
from typing import Self

from khep_twin.errors import KhepTwinError
from khep_twin.log.qos import RELIABLE, VOLATILE, Qos

GRAPH = "@ros2_lv"
"""First part of the keys of liveliness tokens."""

_GID_LENGTH = 16  # [bytes]
_ATTACHMENT = struct.Struct(f"<qqB{_GID_LENGTH}s")
"""Sequence number, time of sending since 1970 [ns], length of the GID, GID."""

_NAME = re.compile(r"/([A-Za-z_][A-Za-z0-9_]*/)*[A-Za-z_][A-Za-z0-9_]*")
_DDS_TYPE = re.compile(r"(\w+)::(msg|srv)::dds_::(\w+)_")


class EntityKind(StrEnum):
    """Kind of an entity in the graph."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"


@dataclass(frozen=True, slots=True)
class NodeName:
    """Name of a node; its text is the full name.

    Attributes:
        namespace: Namespace, "/" or "/lab".
        name: Name in the namespace.
    """

    namespace: str
    name: str

    @classmethod
    def of(cls, full_name: str) -> Self:
        """Return the name of a node by its full name, with or without a first slash.

        Raises:
            KhepTwinError: ROS does not allow the name.
        """
        text = f"/{full_name.removeprefix('/')}"
        if not _NAME.fullmatch(text) or "__" in text:
            raise KhepTwinError(
                f"{full_name!r}: no name of a ROS node; "
                "expected letters, digits and single underscores, as in khepera0 or lab/khepera0"
            )
        namespace, _, name = text.rpartition("/")
        return cls(namespace or "/", name)

    def __str__(self) -> str:
        return f"{self.namespace.removesuffix('/')}/{self.name}"

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic or service: `~/odom` is the node's, `odom` its namespace's."""
        if topic.startswith("/"):
            return topic
        if topic.startswith("~/"):
            return f"{self}{topic[1:]}"
        return f"{self.namespace.removesuffix('/')}/{topic}"


@dataclass(frozen=True, slots=True)
class Entity:
    """Place of a node or an endpoint in the graph.

    Attributes:
        domain: Domain of ROS.
        session_id: Identifier of the Zenoh session, as Zenoh prints it.
        node_id: Number of the node in the session.
        id: Number of the entity in the session; for a node that of the node.
        kind: Kind of the entity.
        node: Name of the node.
    """

    domain: int
    session_id: str
    node_id: int
    id: int
    kind: EntityKind
    node: NodeName

    @property
    def token(self) -> str:
        """Key of the liveliness token of a node."""
        numbers = f"{self.domain}/{self.session_id}/{self.node_id}/{self.id}"
        return f"{GRAPH}/{numbers}/{self.kind}/%/{_mangle(self.node.namespace)}/{self.node.name}"

    def endpoint_token(self, name: str, type_name: str, type_hash: str, qos: Qos) -> str:
        """Return the key of an endpoint's liveliness token, by the full name of its topic or service."""
        return f"{self.token}/{_mangle(name)}/{dds_type(type_name)}/{type_hash}/{qos_text(qos)}"


def node_pattern(domain: int, node: NodeName) -> str:
    """Return a pattern for the tokens of all nodes of this name."""
    return f"{GRAPH}/{domain}/*/*/*/{EntityKind.NODE}/*/{_mangle(node.namespace)}/{node.name}"


def publisher_pattern(domain: int, topic: str) -> str:
    """Return a pattern for the tokens of all publishers of a topic, by its full name."""
    return f"{GRAPH}/{domain}/*/*/*/{EntityKind.PUBLISHER}/*/*/*/{_mangle(topic)}/**"


def dds_type(type_name: str) -> str:
    """Return the name in keys of a type like `std_msgs/msg/String`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic's or service's data, by its full name."""
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{type_hash}"


def topic_pattern(domain: int, name: str) -> str:
    """Return a pattern for the keys of a topic's data of all types."""
    return f"{domain}/{name.strip('/')}/*/*"


def type_of_key(key: str) -> str:
    """Return the type of the data with this key; that part of the key in quotes, if it is no type of ROS."""
    part = key.rsplit("/", 2)[-2]
    match = _DDS_TYPE.fullmatch(part)
    return "/".join(match.groups()) if match else repr(part)


def qos_text(qos: Qos) -> str:
    """Return a quality of service as tokens have it: a default of rmw_zenoh, except the depth, is empty."""
    reliability = "" if qos.reliability == RELIABLE else qos.reliability
    durability = "" if qos.durability == VOLATILE else qos.durability
    return f"{reliability}:{durability}:,{qos.depth}:,:,:,,"


def gid(token: str) -> bytes:
    """Return the identifier of an endpoint, by the key of its liveliness token."""
    return sha256(token.encode()).digest()[:_GID_LENGTH]


@dataclass(frozen=True, slots=True)
class Attachment:
    """Attachment of a message, request or reply.

    Attributes:
        number: Sequence number, from 1 for each sender.
        time_ns: System time of sending since 1970 [ns].
        gid: Identifier of the sender; in a reply that of the client.
    """

    number: int
    time_ns: int
    gid: bytes

    def to_bytes(self) -> bytes:
        """Return the attachment's 33 bytes."""
        return _ATTACHMENT.pack(self.number, self.time_ns, _GID_LENGTH, self.gid)

    @classmethod
    def parse(cls, data: bytes | None) -> Self | None:
        """Return the attachment in these bytes; None if they are none."""
        if data is None or len(data) != _ATTACHMENT.size:
            return None
        number, time_ns, length, sender = _ATTACHMENT.unpack(data)
        return cls(number, time_ns, sender) if number >= 0 and length == _GID_LENGTH else None


def _mangle(name: str) -> str:
    """Return a name as one part of a key."""
    return name.replace("/", "%")
