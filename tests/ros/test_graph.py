"""Nodes on a Zenoh network, of which zenoh-ros2-sdk in another process is the other side."""

import queue
import threading
from pathlib import Path

import pytest
from ros_network import DOMAIN, LIMIT, ForeignNode, Lines, assert_soon, free_port

from khep_twin.errors import KhepTwinError, PortError, ProtocolError
from khep_twin.log.cdr import encode
from khep_twin.log.message_types import type_hash
from khep_twin.log.qos import LATCHED
from khep_twin.ros import wire
from khep_twin.ros.graph import Graph, Message, Node
from khep_twin.ros.session import SessionMode
from khep_twin.ros.wire import Attachment

STRING, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/Trigger"
TWISTS = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def text_of(message: str) -> bytes:
    return encode(STRING, {"data": message})


def test_another_library_lists_nodes_topics_and_their_types(graph: Graph, foreign: ForeignNode) -> None:
    with Node(graph, "/lab/khepera0") as node:
        node.publisher("~/odom", "nav_msgs/msg/Odometry")
        node.subscribe("~/cmd_vel", TWISTS, lambda *_: None)
        node.serve("~/step", TRIGGER, lambda _: {})
        assert_soon(foreign.services, {"/lab/khepera0/step": [TRIGGER]})
        assert foreign.topics() == {
            "/lab/khepera0/odom": ["nav_msgs/msg/Odometry"],
            "/lab/khepera0/cmd_vel": [*TWISTS],
        }
        nodes = [token for token in foreign.tokens() if "/NN/" in token]
        assert nodes == [f"@ros2_lv/7/{graph.session_id}/0/0/NN/%/%lab/khepera0"]
    assert_soon(foreign.tokens, [])


def test_another_library_hears_a_topic(graph: Graph, foreign: ForeignNode) -> None:
    with Node(graph, "talker") as node:
        publisher = node.publisher("~/chatter", STRING)
        foreign.subscribe(topic="/talker/chatter", type=STRING)
        heard = foreign.begin_to_hear("/talker/chatter")
        while (message := heard()) is None:
            publisher.send(text_of("hello"))
        assert "data='hello'" in message


def test_a_late_subscriber_of_another_library_receives_a_latched_message(
    graph: Graph, foreign: ForeignNode
) -> None:
    with Node(graph, "talker") as node:
        node.publisher("/description", STRING, LATCHED).send(text_of("a robot"))
        assert_soon(foreign.topics, {"/description": [STRING]})
        foreign.subscribe(topic="/description", type=STRING, latched=True)
        assert "data='a robot'" in foreign.hear(topic="/description")


def test_both_forms_of_a_command_from_another_library_arrive_at_one_subscription(
    graph: Graph, foreign: ForeignNode, lines: Lines
) -> None:
    received: queue.Queue[tuple[str, Message]] = queue.Queue()
    with Node(graph, "khepera0") as node:
        node.subscribe("~/cmd_vel", TWISTS, lambda *message: received.put(message))
        twist = {"linear": {"x": 0.25}, "angular": {"z": -1.0}}
        for type_name, message in zip(TWISTS, (twist, {"twist": twist}), strict=True):
            foreign.publish(topic="/khepera0/cmd_vel", type=type_name, message=message)
            while (arrived := received.get(timeout=LIMIT))[0] != type_name:
                pass
            foreign.stop()
            assert encode(type_name, arrived[1]) == encode(type_name, message)
    assert lines.all() == []


def test_another_library_calls_a_service(graph: Graph, foreign: ForeignNode) -> None:
    with Node(graph, "khepera0") as node:
        node.serve("~/step", TRIGGER, lambda _: {"success": True, "message": "one step"})
        assert_soon(foreign.services, {"/khepera0/step": [TRIGGER]})
        request = {"structure_needs_at_least_one_member": 0}
        response = foreign.call(service="/khepera0/step", type=TRIGGER, request=request)
    assert "success=True, message='one step'" in response


def test_a_message_of_another_kind_is_reported_once_and_ignored(
    graph: Graph, foreign: ForeignNode, lines: Lines
) -> None:
    def refuse(type_name: str, message: Message) -> None:
        raise ProtocolError(f"x = {message['linear']['x']} m/s; expected more")

    with Node(graph, "khepera0") as node:
        node.subscribe("~/cmd_vel", TWISTS, refuse)
        foreign.publish(topic="/khepera0/cmd_vel", type=STRING, message={"data": "forward"})
        assert (
            lines.next() == f"/khepera0/cmd_vel: a message of type {STRING}; expected {' or '.join(TWISTS)}"
        )
        key = wire.data_key(DOMAIN, "/khepera0/cmd_vel", TWISTS[0], type_hash(TWISTS[0]))
        foreign.put(key=key, data="00")
        assert lines.next() == (
            "/khepera0/cmd_vel: a message without the attachment of ROS; expected 33 bytes with its number, "
            "time and sender"
        )
        foreign.put(key=key, data="00")
        foreign.publish(topic="/khepera0/cmd_vel", type=TWISTS[0], message={"linear": {"x": 0.25}})
        assert lines.next() == "/khepera0/cmd_vel: x = 0.25 m/s; expected more"
        foreign.stop()
        data = Attachment(1, 0, bytes(16)).to_bytes().hex()
        foreign.put(key=key, data="00", attachment=data)
        assert (
            lines.next()
            == f"/khepera0/cmd_vel: no {TWISTS[0]}: header 00; expected 00010000, CDR in little-endian"
        )

        foreign.stop()
    assert lines.all() == []


def test_two_nodes_of_one_name_are_reported(router: Graph, graph: Graph, lines: Lines) -> None:
    with Node(router, "lab/khepera0"), Node(graph, "khepera0"):
        assert lines.all() == []
        with Node(graph, "lab/khepera0"):
            assert lines.all() == ["/lab/khepera0: another node has this name; expected another --namespace"]


def test_a_node_returns_with_a_router_that_comes_back(lines: Lines) -> None:
    address = f"127.0.0.1:{free_port()}"
    first_router = Graph(address, DOMAIN, mode=SessionMode.ROUTER)
    with Graph(address, DOMAIN, report=lines.put) as graph, Node(graph, "khepera0") as node:
        publisher = node.publisher("~/chatter", STRING)
        first_router.close()
        watch_until(graph, lines, "is gone; waiting for it, the robots stop without commands")
        publisher.send(text_of("nobody"))
        with Graph(address, DOMAIN, mode=SessionMode.ROUTER) as second_router:
            watch_until(graph, lines, "is connected")
            received = threading.Event()
            with Node(second_router, "listener") as listener:
                listener.subscribe("/khepera0/chatter", [STRING], lambda *_: received.set())
                while not received.wait(0.01):
                    publisher.send(text_of("hello"))
            assert second_router.has_node(node.name)
    assert lines.all() == []


def watch_until(graph: Graph, lines: Lines, state: str) -> None:
    pause = threading.Event()
    while lines.empty():
        graph.watch()
        pause.wait(0.01)
    assert lines.next() == f"{graph.address}: the Zenoh router {state}"


def test_a_missing_router_is_named_with_what_to_start() -> None:
    address = f"127.0.0.1:{free_port()}"
    with pytest.raises(PortError) as caught:
        Graph(address)
    assert str(caught.value) == (
        f"{address}: no Zenoh router; "
        "expected one, started by 'ros2 run rmw_zenoh_cpp rmw_zenohd' or --be-router"
    )


def test_a_second_router_at_an_address_is_refused(router: Graph) -> None:
    with pytest.raises(PortError, match=f"{router.address}: in use; expected a free address"):
        Graph(router.address, mode=SessionMode.ROUTER)


@pytest.mark.parametrize("address", ["localhost", "localhost:", ":7447", "localhost:99999", "localhost:x"])
def test_an_address_without_a_port_is_refused(address: str) -> None:
    with pytest.raises(PortError, match="no address of a router; expected HOST:PORT"):
        Graph(address)


def test_the_domain_is_that_of_ros(router: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    with Graph(router.address) as graph:
        assert graph.domain == 42
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(KhepTwinError, match="ROS_DOMAIN_ID=233: expected an integer from 0 to 232"):
        Graph(router.address)


def test_the_settings_of_rmw_zenoh_apply(
    router: Graph, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "session.json5"
    path.write_text('{mode: "client", connect: {endpoints: ["tcp/127.0.0.1:1"]}}')
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(path))
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", f'connect/endpoints=["tcp/{router.address}"]; mode="client"')
    with Graph() as graph:
        assert graph.session.info.routers_zid()
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", "no/path=1")
    with pytest.raises(
        KhepTwinError, match=r"ZENOH_CONFIG_OVERRIDE: no/path=1: .*; expected path/of/key=value"
    ):
        Graph()
    path.write_text("{")
    with pytest.raises(KhepTwinError, match=r"session\.json5: .*; expected a configuration of Zenoh"):
        Graph()
