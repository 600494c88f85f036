"""Copies of logs for rerun: their shown parts, with fewer samples if they are long, in large chunks.

rerun takes some 10 kB for each channel in each chunk of a file, and `serve` begins a chunk every half second:
a log of a day took more than 23 GB of memory (measured).
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

SAMPLES = 180_000
"""Most shown samples of a channel: an hour at 50 a second."""

_SAMPLE_NS = 20_000_000
"""Interval of a run's samples in its log [ns]."""

_LINES = 2
"""Lines of the transcript that are kept per interval of a thinned log: a command and its reply."""


_WHOLE = ("/events", *LINE_TOPICS)
"""Topics of which each message is kept."""


def interval_ns(end_ns: int) -> int:
    """Return the interval of the shown samples of a log that ends at a time [ns]; 0 for all."""
    # A run of an hour ends some moments later.
    every = math.ceil(end_ns / (SAMPLES * _SAMPLE_NS) - 0.01)
    return every * _SAMPLE_NS if every > 1 else 0


@dataclass(slots=True)
class _Channel:
    """Channel of the copy; of each interval the first `n_times` distinct times are kept, of 0 all."""

    number: int
    n_times: int
    slot: int = -1
    time_ns: int = -1
    rank: int = 0

    def keeps(self, time_ns: int, interval_ns: int) -> bool:
        if time_ns // interval_ns != self.slot:
            self.slot, self.rank = time_ns // interval_ns, 1
        elif time_ns != self.time_ns:
            self.rank += 1
        self.time_ns = time_ns
        return not self.n_times or self.rank <= self.n_times


class Copy:
    """Copy of a log in the making.

    Args:
        sink: File of the copy.
        interval_ns: Interval of the samples that are kept [ns]; 0 for all. Events and alarms are all kept.
        hidden: Patterns of topics that are left out.
    """

    def __init__(self, sink: Sink, interval_ns: int, hidden: Iterable[str]) -> None:
        self._writer = BatchWriter(sink, "ros2", f"khep_twin {__version__}")
        self._interval_ns, self._hidden = interval_ns, re.compile("|".join(hidden))
        self._channels: dict[str, _Channel | None] = {}

    def add(self, entries: Iterable[Entry]) -> None:
        """Copy the shown parts of a piece of the log: messages that are no earlier than those before."""
        for topic, found in groupby(sorted(entries, key=attrgetter("topic", "time_ns")), attrgetter("topic")):
            messages = list(found)
            if topic not in self._channels:
                self._channels[topic] = self._channel(messages[0])
            channel = self._channels[topic]
            if channel is None:
                continue
            if self._interval_ns:
                messages = [each for each in messages if channel.keeps(each.time_ns, self._interval_ns)]
            self._writer.add_lines(
                channel.number, [each.time_ns for each in messages], [each.data for each in messages]
            )

    def finish(self, label: Label) -> None:
        """Complete the copy with the log's metadata and attachments."""
        for name, text in label.attachments.items():
            self._writer.attach(name, text)
        self._writer.describe("run", label.metadata)
        self._writer.finish()

    def _channel(self, first: Entry) -> _Channel | None:
        """Define the channel of a message; None if it is not shown."""
        if first.definition is None or self._hidden.search(first.topic):
            return None
        n_times = 0 if first.topic in _WHOLE else _LINES if first.schema.endswith("/Log") else 1
        return _Channel(self._writer.channel(first.topic, first.schema, first.definition), n_times)
