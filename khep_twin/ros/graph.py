"""Nodes of ROS 2 on a Zenoh network: publishers, subscriptions and services.

The session is by default a client of the router that ROS's nodes use, and listens nowhere. Callbacks run in
threads of Zenoh. Publishing never waits: messages for a slow subscriber are dropped.
"""

# The stubs of eclipse-zenoh have no types of results.
# pyright: reportUnknownMemberType=false

import time
from collections.abc import Callable, Hashable, Sequence
from itertools import count
from threading import Lock
from typing import Any, Self

from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.log.cdr import encode
from khep_twin.log.decoding import DecodeError, decode
from khep_twin.log.message_types import Message, type_hash
from khep_twin.log.qos import DEFAULT, Qos
from khep_twin.ros import wire
from khep_twin.ros.session import SessionMode, domain_of_environment, open_session
from khep_twin.ros.wire import Attachment, Entity, EntityKind, NodeName

try:
    import zenoh
    from zenoh import ext
except ImportError as error:
    raise MissingExtraError("eclipse-zenoh", "ros") from error

_QUERY_TIMEOUT = 3.0
"""Longest wait for the tokens of the graph [s]."""

_HEARTBEAT = 0.5
"""Interval at which a latched publisher repeats its last number [s], as in rmw_zenoh."""


_NO_ATTACHMENT = "without the attachment of ROS; expected 33 bytes with its number, time and sender"


class Graph:
    """Session on the Zenoh network of a ROS graph; a context.

    The environment variables of rmw_zenoh apply: `ZENOH_CONFIG_OVERRIDE`, and without a router's address
    `ZENOH_SESSION_CONFIG_URI`, or `ZENOH_ROUTER_CONFIG_URI` for a router.

    Args:
        router: Address "host:port" of the router, or to listen at as the router; None for ROS's port, 7447.
        domain: Domain of ROS; None for that of `ROS_DOMAIN_ID`, or 0.
        mode: Part in the network.
        report: Function that prints a line for the user; called from any thread.

    Attributes:
        address: Address of the router.
        domain: Domain of ROS.
        session: Session of Zenoh.
        session_id: Identifier of the session in the network.

    Raises:
        PortError: No router replies, or the address cannot be used.
        KhepTwinError: A variable of the environment cannot be used.
    """

    def __init__(
        self,
        router: str | None = None,
        domain: int | None = None,
        *,
        mode: SessionMode = SessionMode.CLIENT,
        report: Callable[[str], None] = print,
    ) -> None:
        self.report = report
        self.domain = domain_of_environment() if domain is None else domain
        self._mode = mode
        self.session, self.address = open_session(mode, router)
        self.session_id = str(self.session.info.zid())
        self._numbers = count()
        self._router_ids = self._find_routers()
        self._causes = set[Hashable]()
        self._lock = Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network, with all nodes."""
        self.session.close()

    def next_number(self) -> int:
        """Return an unused number for an entity."""
        with self._lock:
            return next(self._numbers)

    def has_node(self, name: NodeName) -> bool:
        """Return whether the graph has a node of this name."""
        return self._has_token(wire.node_pattern(self.domain, name))

    def has_publisher(self, topic: str) -> bool:
        """Return whether a node of the graph publishes a topic, by its full name."""
        return self._has_token(wire.publisher_pattern(self.domain, topic))

    def watch(self) -> None:
        """Report a router that has gone or come back since the last call."""
        if self._mode is SessionMode.ROUTER or (routers := self._find_routers()) == self._router_ids:
            return
        self._router_ids = routers
        state = "is connected" if routers else "is gone; waiting for it, the robots stop without commands"
        self.report(f"{self.address}: the Zenoh router {state}")

    def report_once(self, cause: Hashable, text: str) -> None:
        """Report a line, unless one with this cause has been reported."""
        with self._lock:
            if cause in self._causes:
                return
            self._causes.add(cause)
        self.report(text)

    def _has_token(self, pattern: str) -> bool:
        return any(reply.ok for reply in self.session.liveliness().get(pattern, timeout=_QUERY_TIMEOUT))

    def _find_routers(self) -> set[str]:
        return set(map(str, self.session.info.routers_zid()))


class Node:
    """Node of ROS 2, with its publishers, subscriptions and services; a context.

    A node of the same name in the graph is reported; both then exist.

    Args:
        graph: Graph of the node.
        name: Full name, e.g. "khepera0" or "/lab/khepera0".

    Attributes:
        name: Name of the node.

    Raises:
        KhepTwinError: The name cannot be used.
    """

    def __init__(self, graph: Graph, name: str) -> None:
        self.name = NodeName.of(name)
        self._graph = graph
        session = graph.session
        if graph.has_node(self.name):
            graph.report(f"{self.name}: another node has this name; expected another --namespace")
        self._id = graph.next_number()
        token = self._entity(EntityKind.NODE, self._id).token
        self._entities: list[Any] = [session.liveliness().declare_token(token)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph: endpoints disappear before the node."""
        while self._entities:
            self._entities.pop().undeclare()

    def publisher(self, topic: str, type_name: str, qos: Qos = DEFAULT) -> "Publisher":
        """Return a publisher of a topic, of which "~/odom" is in the node's namespace."""
        name = self.name.resolve(topic)
        key = wire.data_key(self._graph.domain, name, type_name, type_hash(type_name))
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": zenoh.Reliability.RELIABLE if qos.is_reliable else zenoh.Reliability.BEST_EFFORT,
        }
        if qos.is_latched:
            detection = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT)
            publisher: Any = ext.declare_advanced_publisher(
                self._graph.session,
                key,
                cache=ext.CacheConfig(max_samples=qos.depth),
                publisher_detection=True,
                sample_miss_detection=detection if qos.is_reliable else None,
                **options,
            )
        else:
            publisher = self._graph.session.declare_publisher(key, **options)
        self._entities.append(publisher)
        return Publisher(publisher, self._declare(EntityKind.PUBLISHER, name, type_name, qos))

    def subscribe(
        self, topic: str, types: Sequence[str], callback: Callable[[str, Message], None], qos: Qos = DEFAULT
    ) -> None:
        """Call a function with the type and the content of each message of a topic, in a thread of Zenoh.

        Messages of another kind are reported once, as are those that it refuses by a `KhepTwinError`.
        """
        name = self.name.resolve(topic)
        graph = self._graph

        def receive(sample: zenoh.Sample) -> None:
            type_name = wire.type_of_key(str(sample.key_expr))
            if type_name not in types:
                text = f"{name}: a message of type {type_name}; expected {' or '.join(types)}"
                graph.report_once((name, type_name), text)
            elif _parse_attachment(sample) is None:
                graph.report_once((name, "attachment"), f"{name}: a message {_NO_ATTACHMENT}")
            else:
                try:
                    callback(type_name, decode(type_name, sample.payload.to_bytes()))
                except DecodeError as error:
                    graph.report_once((name, type_name, "bytes"), f"{name}: no {type_name}: {error}")
                except KhepTwinError as error:
                    graph.report_once((name, type_name, "refused"), f"{name}: {error}")

        pattern = wire.topic_pattern(graph.domain, name)
        self._entities.append(graph.session.declare_subscriber(pattern, receive))
        for type_name in types:
            self._declare(EntityKind.SUBSCRIPTION, name, type_name, qos)

    def serve(self, service: str, type_name: str, callback: Callable[[Message], Message]) -> None:
        """Serve a service: the function returns the response to a request, in a thread of Zenoh.

        Requests of another kind are reported once, as are those that it refuses by a `KhepTwinError`.
        """
        name = self.name.resolve(service)
        graph = self._graph
        key = wire.data_key(graph.domain, name, type_name, type_hash(type_name))

        def answer(query: zenoh.Query) -> None:
            with query:
                request = _parse_attachment(query)
                try:
                    if request is None:
                        raise KhepTwinError(f"a request {_NO_ATTACHMENT}")
                    payload = b"" if query.payload is None else query.payload.to_bytes()
                    response = callback(decode(f"{type_name}_Request", payload))
                except (KhepTwinError, DecodeError) as error:
                    graph.report_once((name, type(error)), f"{name}: {error}")
                    query.reply_err(str(error))
                    return
                attachment = Attachment(request.number, time.time_ns(), request.gid).to_bytes()
                query.reply(key, encode(f"{type_name}_Response", response), attachment=attachment)

        self._entities.append(graph.session.declare_queryable(key, answer, complete=True))
        self._declare(EntityKind.SERVICE, name, type_name, DEFAULT)

    def report_once(self, cause: Hashable, text: str) -> None:
        """Report a line that starts with the node's name, once per cause."""
        self._graph.report_once((self.name, cause), f"{self.name}: {text}")

    def _entity(self, kind: EntityKind, number: int) -> Entity:
        return Entity(self._graph.domain, self._graph.session_id, self._id, number, kind, self.name)

    def _declare(self, kind: EntityKind, name: str, type_name: str, qos: Qos) -> str:
        """Declare the liveliness token of an endpoint; return its key."""
        entity = self._entity(kind, self._graph.next_number())
        token = entity.endpoint_token(name, type_name, type_hash(type_name), qos)
        self._entities.append(self._graph.session.liveliness().declare_token(token))
        return token


class Publisher:
    """Publisher of a topic, for one thread at a time.

    Args:
        publisher: Publisher of Zenoh.
        token: Key of its liveliness token.
    """

    def __init__(self, publisher: Any, token: str) -> None:
        self._publisher = publisher
        self._gid = wire.gid(token)
        self._numbers = count(1)

    def send(self, message: bytes) -> None:
        """Send a message; it does not wait for subscribers."""
        attachment = Attachment(next(self._numbers), time.time_ns(), self._gid)
        self._publisher.put(message, attachment=attachment.to_bytes())


def _parse_attachment(item: "zenoh.Sample | zenoh.Query") -> Attachment | None:
    return Attachment.parse(None if item.attachment is None else item.attachment.to_bytes())
