"""A node of ROS 2 by zenoh-ros2-sdk: a program that does what lines of JSON on its standard input ask for.

    python foreign_node.py PORT DOMAIN

Each line names a function of `Commands` as "do", and its arguments; one line with the result follows.
"""

import json
import queue
import sys
import threading
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_service_names_and_types, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession

LIMIT = 30.0
"""Longest wait for a message [s]."""

NEAR = 0.065
"""Distance from a robot's centre at which it turns away [m]."""


class Commands:
    """Commands of the other process."""

    def __init__(self, port: int, domain: int) -> None:
        self._place: dict[str, Any] = {"router_ip": "127.0.0.1", "router_port": port, "domain_id": domain}
        self._session = ZenohSession.get_instance("127.0.0.1", port)
        self._session.store = get_typestore(Stores.ROS2_JAZZY)
        for name in self._session.store.fielddefs:
            self._session._registered_types[name] = name
        self._heard: dict[str, queue.Queue[Any]] = {}
        self._subscribers: list[Any] = []
        self._publishers: dict[tuple[str, str], Any] = {}
        self._clients: dict[tuple[str, str], Any] = {}
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def tokens(self) -> list[str]:
        """Return the keys of all liveliness tokens of the domain."""
        replies = self._session.liveliness.get(f"@ros2_lv/{self._place['domain_id']}/**", timeout=LIMIT)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def topics(self) -> dict[str, list[str]]:
        """Return the types of all topics."""
        return dict(get_topic_names_and_types(timeout=LIMIT, **self._place))

    def services(self) -> dict[str, list[str]]:
        """Return the types of all services."""
        return dict(get_service_names_and_types(timeout=LIMIT, **self._place))

    def subscribe(self, topic: str, type: str, latched: bool = False) -> None:
        """Start to hear a topic."""
        messages = self._heard[topic] = queue.Queue()
        qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if latched else None
        type_hash = self._session.store.hash_rihs01(type)
        subscriber = ROS2Subscriber(
            topic, type, messages.put, msg_definition="", type_hash=type_hash, qos=qos, **self._place
        )
        self._subscribers.append(subscriber)

    def hear(self, topic: str) -> Any:
        """Return the next message of a topic, as its text."""
        return repr(self._heard[topic].get(timeout=LIMIT))

    def publish(self, topic: str, type: str, message: dict[str, Any]) -> None:
        """Publish a message each 10 ms until `stop`."""
        if (topic, type) not in self._publishers:
            type_hash = self._session.store.hash_rihs01(type)
            self._publishers[topic, type] = ROS2Publisher(
                topic, type, msg_definition="", type_hash=type_hash, **self._place
            )
        publisher = self._publishers[topic, type]
        fields = self._make(type, message).__dict__
        self.stop()
        self._stop = threading.Event()

        def repeat(stop: threading.Event) -> None:
            while not stop.wait(0.01):
                publisher.publish(**fields)

        self._thread = threading.Thread(target=repeat, args=(self._stop,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Publish no more."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def forget(self) -> None:
        """Close all endpoints."""
        self.stop()
        for endpoint in (*self._publishers.values(), *self._subscribers, *self._clients.values()):
            endpoint.close()
        self._publishers.clear()
        self._clients.clear()
        self._subscribers.clear()

    def avoid(self, robot: str, seconds: float, steps: bool = False) -> int:
        """Drive a robot by its scan alone for a time of its stamps [s]; return the number of scans.

        With `steps`, time passes by the robot's service `step` alone.
        """
        scans, type_hash = queue.Queue[Any](), self._session.store.hash_rihs01
        scan, twist = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/Twist"
        definition = {"msg_definition": "", **self._place}
        subscriber = ROS2Subscriber(
            f"/{robot}/scan", scan, scans.put, type_hash=type_hash(scan), **definition
        )
        publisher = ROS2Publisher(f"/{robot}/cmd_vel", twist, type_hash=type_hash(twist), **definition)

        def send(forward: float, turn: float) -> None:
            velocity = self._make(twist, {"linear": {"x": forward}, "angular": {"z": turn}})
            publisher.publish(**velocity.__dict__)

        n_scans, start_s, time_s, turn = 0, None, 0.0, 0.0
        while start_s is None or time_s - start_s < seconds:
            if steps:
                self.call(
                    f"/{robot}/step", "std_srvs/srv/Trigger", {"structure_needs_at_least_one_member": 0}
                )
            message = scans.get(timeout=LIMIT)
            while not scans.empty():
                message = scans.get()
            n_scans += 1
            stamp = message.header.stamp
            time_s = stamp.sec + stamp.nanosec / 1e9
            start_s = time_s if start_s is None else start_s
            angles = message.angle_min + message.angle_increment * np.arange(len(message.ranges))
            left, right = (
                message.ranges[(sign * angles > -0.1) & (sign * angles < 1.3)].min() for sign in (1, -1)
            )
            if min(left, right) > NEAR:
                forward, turn = 0.06, 0.0
            else:
                forward, turn = -0.03, turn or (1.5 if left > right else -1.5)
            send(forward, turn)
        send(0.0, 0.0)
        subscriber.close()
        publisher.close()
        return n_scans

    def put(self, key: str, data: str, attachment: str | None = None) -> None:
        """Send bytes, in hexadecimal digits, with this key."""
        extra = {} if attachment is None else {"attachment": bytes.fromhex(attachment)}
        self._session.session.put(key, bytes.fromhex(data), **extra)

    def call(self, service: str, type: str, request: dict[str, Any]) -> str | None:
        """Return the response of a service, as its text."""
        if (service, type) not in self._clients:
            request_lines, response_lines = _DEFINITIONS[type]
            self._clients[service, type] = ROS2ServiceClient(
                service,
                type,
                request_definition=request_lines,
                response_definition=response_lines,
                timeout=LIMIT,
                **self._place,
            )
        response = self._clients[service, type].call(**request)
        return None if response is None else repr(response)

    def _make(self, type: str, fields: dict[str, Any]) -> Any:
        """Return a message of a type with some of its fields; numbers of the others are 0."""
        store = self._session.store
        values: dict[str, Any] = {}
        for name, (node, rest) in store.fielddefs[type][1]:
            if node == Nodetype.NAME:
                values[name] = self._make(rest, fields.get(name, {}))
            elif node == Nodetype.BASE:
                values[name] = fields.get(name, "" if rest[0] == "string" else 0)
            else:
                values[name] = np.zeros(rest[1])
        return store.types[type](**values)


_OUTCOME = "bool success\nstring message\n"
_DEFINITIONS = {
    "std_srvs/srv/Trigger": ("uint8 structure_needs_at_least_one_member\n", _OUTCOME),
    "std_srvs/srv/SetBool": ("bool data\n", _OUTCOME),
}


def main() -> None:
    """Answer all lines."""
    commands = Commands(int(sys.argv[1]), int(sys.argv[2]))
    print(json.dumps({"result": None}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = {"result": getattr(commands, request.pop("do"))(**request)}
        except Exception as error:
            answer = {"error": repr(error)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
