"""Readings of a robot as arrays without units, a topic for each channel."""

from collections.abc import Mapping, Sequence

from khep_twin.log.cdr import encode
from khep_twin.ros.graph import Node, Publisher

FLOATS = "std_msgs/msg/Float64MultiArray"


class RawOutput:
    """Publishers of a robot's channels, below `raw` of its node; made at the first message of each."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[str, Publisher] = {}

    def begin(self) -> None:
        """Do nothing: raw readings have no time."""

    def publish(self, channels: Mapping[str, Sequence[int]]) -> None:
        """Publish the readings of one cycle by channel."""
        for channel, values in channels.items():
            if channel not in self._publishers:
                self._publishers[channel] = self._node.publisher(f"~/raw/{channel}", FLOATS)
            self._publishers[channel].put(encode(FLOATS, {"data": values}))

    def restart(self) -> None:
        """Do nothing: raw readings have no memory."""
