"""Live view of a run in Foxglove: its messages, as a log has them, on a WebSocket while it goes on.

The server is Foxglove's own (foxglove-sdk), which sends in its own threads and keeps the last messages for
a client that reads slowly; what a client does not take in time it misses, and the run waits for none.
Clients only listen: what they send has no effect.
"""

import logging
from collections.abc import Mapping, Sequence
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.errors import MissingExtraError, PortError
from khep_twin.log.channels import LINES, SCHEMAS
from khep_twin.log.foxglove_scene import SCHEMA
from khep_twin.log.output import messages_of
from khep_twin.log.recorder import LiveRecorder
from khep_twin.world import World

try:
    from foxglove import Channel, Context, Schema, start_server
    from foxglove.websocket import Capability, ChannelView, Client, ServerListener
except ImportError as error:
    raise MissingExtraError("foxglove-sdk", "foxglove") from error

FLUSH_NS = NS_PER_S // 25
"""Wall time after which a client has what was sampled, at the latest with the next sample [ns]."""

LAYOUT = files("khep_twin") / "assets" / "foxglove_layout.json"
"""Layout to import in Foxglove."""

_BACKLOG = 4096
"""Messages kept for a client that reads slowly."""

_STANDING = {"std_msgs/msg/String", SCHEMA}
"""Types of messages that are sent once; who subscribes later receives the last one."""


class FoxgloveServer:
    """WebSocket server for Foxglove; a `Writer` of messages, to all who have subscribed.

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
        # A client that is cut off, or that misses messages, is no news for who runs a twin.
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)
        self._context = Context()
        self._channels: list[Channel] = []
        self._ids: dict[tuple[str, str], int] = {}
        self._standing: dict[int, bytes] = {}
        self._has_begun, self._time_ns = False, 0
        try:
            self._server = start_server(
                name=name,
                host=host,
                port=port,
                capabilities=[Capability.Time],
                server_listener=_Latecomers(self),
                context=self._context,
                message_backlog_size=_BACKLOG,
            )
        except (RuntimeError, OverflowError) as error:
            reason = str(error).rpartition(": ")[2].partition(" (os error")[0]
            raise PortError(f"{host}:{port}: Foxglove cannot be served here: {reason}") from error
        shown = f"[{host}]" if ":" in host else host
        self.address = f"ws://{shown}:{self._server.port}"

    def begin(self, time_ns: int) -> None:
        """Begin another run; clients forget the one before."""
        if self._has_begun:
            self._server.clear_session()
        self._has_begun, self._time_ns = True, time_ns

    def attach(self, name: str, text: str) -> None:
        """Pass over an attachment, which only logs have."""

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Pass over facts, which only logs have."""

    def channel(self, topic: str, schema: str, definition: str | bytes) -> int:
        """Return the number of a topic's channel, made at its first use."""
        if (topic, schema) not in self._ids:
            ros = isinstance(definition, str)
            made = Channel(
                topic,
                schema=Schema(
                    name=schema,
                    encoding="ros2msg" if ros else "protobuf",
                    data=definition.encode("ascii") if ros else definition,
                ),
                message_encoding="cdr" if ros else "protobuf",
                context=self._context,
            )
            self._ids[topic, schema] = len(self._channels)
            self._channels.append(made)
        return self._ids[topic, schema]

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Send messages of different sizes; keep the last of a standing channel."""
        found, base = self._channels[channel], self._channels[channel].base
        if messages and found.schema_name() in _STANDING:
            self._standing[found.id()] = messages[-1]
        if base.has_sinks():
            for time_ns, message in zip(times_ns, messages, strict=True):
                base.log(message, time_ns)

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Send messages of one size, a row each."""
        if len(messages) and self._channels[channel].base.has_sinks():
            self.add_lines(channel, times_ns.tolist(), messages_of(messages))

    def at(self, time_ns: int) -> None:
        """Tell all clients the time of the run [ns]."""
        self._time_ns = time_ns
        self._server.broadcast_time(time_ns)

    def resend(self, channel: int) -> None:
        """Send the last message of a standing channel again, by the server's number of the channel."""
        if (message := self._standing.get(channel)) is not None:
            found = next(each for each in self._channels if each.id() == channel)
            found.base.log(message, self._time_ns)

    def flush(self) -> None:
        """Do nothing: each message is sent at once."""

    def finish(self) -> None:
        """Do nothing: another run may follow."""

    def close(self) -> None:
        """Close all connections and stop listening."""
        self._server.stop()


class FoxgloveRecorder(LiveRecorder):
    """Recorder of a run for Foxglove; in real time, a world ahead of the wall clock is slowed down."""

    def __init__(self, server: FoxgloveServer, world: World, *, real_time: bool) -> None:
        server.begin(world.time_ns)
        self._server = server
        super().__init__(server, world, {}, interval_ns=FLUSH_NS, real_time=real_time)
        for topic in ("/events", *(f"/{robot.name}/serial" for robot in world.robots)):
            # Before their first lines, so that no subscriber misses these.
            server.channel(topic, LINES, SCHEMAS[LINES])

    def flush(self) -> None:
        """Send everything so far, and the time."""
        super().flush()
        self._server.at(self._world.time_ns)


class _Latecomers(ServerListener):
    """Listener of the server, which lets clients that subscribe late have what was sent once."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._server = server

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the last message of a standing channel again."""
        self._server.resend(channel.id)
