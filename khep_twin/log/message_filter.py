"""Filter of messages that the reader accepts, for writing a log from untrusted data."""

from collections.abc import Sequence

from khep_twin.log.channels import INTEGERS
from khep_twin.log.decoding import LATEST_NS, DecodeError, read_line, read_transforms
from khep_twin.log.host_events import read_events
from khep_twin.log.messages import FOR_REPEAT, READERS, WIDTHS, line_topics, read_samples
from khep_twin.log.state_hashes import read_states


class MessageFilter:
    """Filter of messages that the reader accepts.

    Args:
        robots: Names of the robots.
    """

    def __init__(self, robots: Sequence[str]) -> None:
        self._bases = {f"{robot}/base" for robot in robots}
        self._line_topics = line_topics(robots)
        self._sampled = {f"/{robot}/{name}" for robot in robots for name in WIDTHS}
        self._widths: dict[tuple[str, str], int] = {}

    def accepts(self, topic: str, schema: str, time_ns: int, message: bytes) -> bool:
        """Return whether the reader accepts a message after those passed before."""
        try:
            return time_ns <= LATEST_NS and self._fits(topic, schema, message)
        except DecodeError:
            return False

    def _fits(self, topic: str, schema: str, message: bytes) -> bool:
        name = topic.rpartition("/")[2]
        if name == "host_events":
            for _ in read_events(message):
                pass
        if name == "state":
            read_states(message)
        if topic in self._line_topics:
            read_line(message)
        if topic == "/tf" and not self._bases <= read_transforms(message).keys():
            return False
        widths: dict[str, int] = {}
        if topic in self._sampled:
            widths[name] = read_samples([message], name).shape[1]
        if schema in READERS and not (name in FOR_REPEAT and schema == INTEGERS):
            widths[schema] = READERS[schema]([message]).shape[1]
        # The first message of a channel defines the width of the others.
        return all(self._widths.setdefault((topic, of), width) == width for of, width in widths.items())
