"""Live view of a run in Foxglove: the messages of its log, sent on a WebSocket during the run.

The server is that of foxglove-sdk. It sends in separate threads and buffers the last messages for a client
that reads slowly; later ones are dropped for that client, and the run never waits. Clients only receive:
messages from them have no effect.
"""

import logging
from collections.abc import Mapping, Sequence
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.errors import MissingExtraError, PortError
from khep_twin.log.channels import LINES
from khep_twin.log.message_types import SCHEMAS
from khep_twin.log.output import split_rows
from khep_twin.log.qos import qos_of
from khep_twin.log.recorder import LiveRecorder
from khep_twin.world import World

try:
    from foxglove import Channel, Context, Schema, start_server
    from foxglove.websocket import Capability, ChannelView, Client, ServerListener
except ImportError as error:
    raise MissingExtraError("foxglove-sdk", "foxglove") from error

FLUSH_INTERVAL_WALL_NS = NS_PER_S // 25
"""Wall time between two flushes to the clients, each at the next sample [ns]."""

LAYOUT = files("khep_twin") / "assets" / "foxglove_layout.json"
"""Layout to import in Foxglove."""

_BACKLOG = 4096
"""Number of messages buffered for a client that reads slowly."""


class FoxgloveServer:
    """WebSocket server for Foxglove; a `Writer` that sends messages to all subscribers.

    Args:
        host: Name or address to listen at.
        port: Port number; 0 for any free one.
        name: Name that Foxglove shows.

    Attributes:
        address: URL that Foxglove connects to.

    Raises:
        PortError: The address cannot be listened at.
    """

    def __init__(self, host: str, port: int, name: str) -> None:
        # The user of a twin needs no message about a client that disconnects or loses messages.
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)
        self._context = Context()
        self._channels: list[Channel] = []
        self._ids: dict[tuple[str, str], int] = {}
        self._latched: dict[int, bytes] = {}
        self._has_session = False
        self._time_ns = 0
        try:
            self._server = start_server(
                name=name,
                host=host,
                port=port,
                capabilities=[Capability.Time],
                server_listener=_SubscriptionListener(self),
                context=self._context,
                message_backlog_size=_BACKLOG,
            )
        except (RuntimeError, OverflowError) as error:
            reason = str(error).rpartition(": ")[2].partition(" (os error")[0]
            raise PortError(f"{host}:{port}: Foxglove cannot be served here: {reason}") from error
        url_host = f"[{host}]" if ":" in host else host
        self.address = f"ws://{url_host}:{self._server.port}"

    def start_run(self, time_ns: int) -> None:
        """Start another run; clients discard the previous one."""
        if self._has_session:
            self._server.clear_session()
        self._has_session = True
        self._time_ns = time_ns

    def attach(self, name: str, text: str) -> None:
        """Ignore an attachment, which only logs contain."""

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Ignore metadata, which only logs contain."""

    def channel(self, topic: str, schema: str, definition: str) -> int:
        """Return the ID of a topic's channel, which is created at its first use."""
        if (topic, schema) not in self._ids:
            new_channel = Channel(
                topic,
                schema=Schema(name=schema, encoding="ros2msg", data=definition.encode("ascii")),
                message_encoding="cdr",
                context=self._context,
            )
            self._ids[topic, schema] = len(self._channels)
            self._channels.append(new_channel)
        return self._ids[topic, schema]

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Send messages of different sizes; store the last of a latched channel."""
        target = self._channels[channel]
        if messages and qos_of(target.topic()).is_latched:
            self._latched[target.id()] = messages[-1]
        if target.base.has_sinks():
            for time_ns, message in zip(times_ns, messages, strict=True):
                target.base.log(message, time_ns)

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Send messages of one size, one per row."""
        if len(messages) and self._channels[channel].base.has_sinks():
            self.add_lines(channel, times_ns.tolist(), split_rows(messages))

    def set_time(self, time_ns: int) -> None:
        """Send the time of the run to all clients [ns]."""
        self._time_ns = time_ns
        self._server.broadcast_time(time_ns)

    def resend(self, channel_id: int) -> None:
        """Send the last message of a latched channel again, by the server's channel ID."""
        if (message := self._latched.get(channel_id)) is not None:
            target = next(candidate for candidate in self._channels if candidate.id() == channel_id)
            target.base.log(message, self._time_ns)

    def flush(self) -> None:
        """Do nothing: each message is sent immediately."""

    def finish(self) -> None:
        """Do nothing: another run may follow."""

    def close(self) -> None:
        """Close all connections and stop listening."""
        self._server.stop()


class FoxgloveRecorder(LiveRecorder):
    """Recorder of a run for Foxglove; `real_time` slows down a world ahead of the wall clock."""

    def __init__(self, server: FoxgloveServer, world: World, *, real_time: bool) -> None:
        server.start_run(world.time_ns)
        self._server = server
        interval_ns = FLUSH_INTERVAL_WALL_NS
        super().__init__(server, world, {}, flush_interval_wall_ns=interval_ns, real_time=real_time)
        for topic in ("/events", *(f"/{robot.name}/serial" for robot in world.robots)):
            # Created before their first lines, so that no subscriber misses these.
            server.channel(topic, LINES, SCHEMAS[LINES])

    def flush(self) -> None:
        """Send the pending messages, and the time."""
        super().flush()
        self._server.set_time(self._world.time_ns)


class _SubscriptionListener(ServerListener):
    """Listener that sends latched messages to new subscribers."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._server = server

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the last message of a latched channel again."""
        self._server.resend(channel.id)
