"""Copies of logs for rerun: the shown channels in large chunks, with fewer samples if the log is long.

rerun uses about 10 kB per channel and chunk of a file, and `serve` writes a chunk every half second: a log of
a day took more than 23 GB of memory (measured).
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from khep_twin import __version__
from khep_twin.log.batch_writer import BatchWriter, Sink
from khep_twin.log.entries import Entry
from khep_twin.log.reader import Label
from khep_twin.log.shadow_channels import LINE_TOPICS
from khep_twin.observers import SAMPLE_NS

MAX_SAMPLES = 180_000
"""Maximum number of shown samples of a channel: an hour at 50 Hz."""

_N_LINES = 2
"""Lines of the transcript per interval of a thinned log: a command and its reply."""

_UNTHINNED = ("/events", *LINE_TOPICS)
"""Topics of which all messages are copied."""


def thinning_interval_ns(end_ns: int) -> int:
    """Return the interval of the shown samples of a log that ends at a time [ns]; 0 for all."""
    return sample_interval_ns(end_ns, MAX_SAMPLES)


def sample_interval_ns(end_ns: int, max_samples: int) -> int:
    """Return the interval of at most so many samples up to a time [ns]; 0 for all."""
    # A run of an hour ends slightly later.
    factor = math.ceil(end_ns / (max_samples * SAMPLE_NS) - 0.01)
    return factor * SAMPLE_NS if factor > 1 else 0


@dataclass(slots=True)
class _Channel:
    """Channel of the copy, with messages of the first `n_times` distinct times per interval; 0: of all."""

    channel_id: int
    n_times: int
    interval_index: int = -1
    time_ns: int = -1
    n_interval_times: int = 0

    def accepts(self, time_ns: int, interval_ns: int) -> bool:
        if time_ns // interval_ns != self.interval_index:
            self.interval_index, self.n_interval_times = time_ns // interval_ns, 1
        elif time_ns != self.time_ns:
            self.n_interval_times += 1
        self.time_ns = time_ns
        return not self.n_times or self.n_interval_times <= self.n_times


class LogCopy:
    """Copy of a log, written in batches.

    Args:
        sink: File of the copy.
        interval_ns: Interval of the copied samples [ns]; 0 for all. All events and alarms are copied.
        hidden: Patterns of topics to omit.
    """

    def __init__(self, sink: Sink, interval_ns: int, hidden: Iterable[str]) -> None:
        self._writer = BatchWriter(sink, "ros2", f"khep_twin {__version__}")
        self._interval_ns = interval_ns
        self._hidden = re.compile("|".join(hidden))
        self._channels: dict[str, _Channel | None] = {}

    def add(self, entries: Iterable[Entry]) -> None:
        """Copy the shown messages of a batch; none may be earlier than those of previous batches."""
        for topic, group in groupby(sorted(entries, key=attrgetter("topic", "time_ns")), attrgetter("topic")):
            messages = list(group)
            if topic not in self._channels:
                self._channels[topic] = self._channel(messages[0])
            channel = self._channels[topic]
            if channel is None:
                continue
            if self._interval_ns:
                messages = [entry for entry in messages if channel.accepts(entry.time_ns, self._interval_ns)]
            self._writer.add_lines(
                channel.channel_id, [entry.time_ns for entry in messages], [entry.data for entry in messages]
            )

    def finish(self, label: Label) -> None:
        """Complete the copy with the log's metadata and attachments."""
        for name, text in label.attachments.items():
            self._writer.attach(name, text)
        self._writer.describe("run", label.metadata)
        self._writer.finish()

    def _channel(self, first: Entry) -> _Channel | None:
        """Define the channel of a topic by its first message; None if it is not shown."""
        if first.definition is None or self._hidden.search(first.topic):
            return None
        n_times = 0 if first.topic in _UNTHINNED else (_N_LINES if first.schema.endswith("/Log") else 1)
        return _Channel(self._writer.channel(first.topic, first.schema, first.definition), n_times)
