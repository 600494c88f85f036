"""A client of Foxglove's WebSocket protocol, `foxglove.sdk.v1`, by websockets alone."""

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from websockets.sync.client import ClientConnection, connect

_MESSAGE, _TIME = 1, 2
_HEAD = struct.Struct("<BIQ")


class Sent(NamedTuple):
    """A message of a channel, and its time [ns]."""

    topic: str
    time_ns: int
    data: bytes


class FoxgloveClient:
    """A connection that has heard what the server is, and subscribes by topic."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.info: dict[str, Any] = json.loads(connection.recv(10))
        self.channels: dict[str, dict[str, Any]] = {}
        self.time_ns = -1
        self._topics: dict[int, str] = {}

    def subscribe(self, *topics: str) -> None:
        """Wait until the topics are advertised, and subscribe to them."""
        while not set(topics) <= set(self.channels):
            self._take(self.connection.recv(10))
        subscriptions = []
        for topic in topics:
            number = len(self._topics) + 1
            self._topics[number] = topic
            subscriptions.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def receive_until(self, topic: str, time_ns: int = 0) -> list[Sent]:
        """Return all messages up to the first of a topic at a time or later."""
        messages: list[Sent] = []
        while not (messages and messages[-1].topic == topic and messages[-1].time_ns >= time_ns):
            messages += self._take(self.connection.recv(30))
        return messages

    def until_time(self, time_ns: int) -> None:
        """Wait for a time of the run; it is sent beside the messages, in no fixed order with them."""
        while self.time_ns < time_ns:
            self._take(self.connection.recv(30))

    def _take(self, data: str | bytes) -> list[Sent]:
        if isinstance(data, str):
            notice = json.loads(data)
            if notice["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in notice["channels"]}
            return []
        if data[0] == _TIME:
            self.time_ns = struct.unpack_from("<Q", data, 1)[0]
            return []
        assert data[0] == _MESSAGE
        _, number, time_ns = _HEAD.unpack_from(data)
        return [Sent(self._topics[number], time_ns, data[_HEAD.size :])]


@contextmanager
def client(address: str) -> Iterator[FoxgloveClient]:
    """Connect to a server, as Foxglove does."""
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=2**24, close_timeout=1) as connection:
        yield FoxgloveClient(connection)
