"""Output of a recorder: messages by topic, for a log file or for a live view."""

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError
from khep_twin.log import channels, foxglove_scene
from khep_twin.log.channels import LINES, SCENE, STRING, TRANSFORMS, Level, TextLine
from khep_twin.log.description import urdf
from khep_twin.log.entries import Entry
from khep_twin.log.frames import MovingBodies
from khep_twin.log.message_types import SCHEMAS


class Writer(Protocol):
    """Destination of encoded messages: a `BatchWriter`, or a live view."""

    def attach(self, name: str, text: str) -> None:
        """Add a text by name."""

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add a table of facts by name."""

    def channel(self, topic: str, schema: str, definition: str) -> int:
        """Return the ID of a topic's channel, which is created at its first use."""
        ...

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Add messages of different sizes at non-decreasing times."""

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Add messages of one size, one per row, at non-decreasing times (n,) [ns]."""

    def flush(self) -> None:
        """Write or send the added messages."""

    def finish(self) -> None:
        """Write or send the rest, at the end of the run."""


def split_rows(rows: NDArray[np.void]) -> list[bytes]:
    """Return messages of one size, one per row, as a list."""
    data, size = rows.tobytes(), rows.itemsize
    return [data[start : start + size] for start in range(0, len(data), size)]


class Output:
    """Messages of khep_twin, passed to a writer.

    Attributes:
        open: True while messages are accepted.
        failure: First error, None if there was none.
        on_exit: Function called if the process is terminated.
    """

    open: bool = True
    failure: LogError | None = None
    on_exit: Callable[[], None]

    def __init__(self, writer: Writer) -> None:
        self._writer = writer

    def describe(self, attachments: Mapping[str, str], facts: Mapping[str, object]) -> None:
        """Add the run's description: texts by name, and a table of facts."""
        with self.error_guard():
            for name, text in attachments.items():
                self._writer.attach(name, text)
            self._writer.describe("run", {key: str(value) for key, value in facts.items()})

    def add(self, topic: str, schema: str, time_ns: int, message: bytes) -> None:
        """Add one message."""
        with self.error_guard():
            self._writer.add_lines(self._channel(topic, schema), [time_ns], [message])

    def add_rows(
        self, topic: str, schema: str, times_ns: NDArray[np.int64], messages: NDArray[np.void]
    ) -> None:
        """Add messages of one size, one per row."""
        with self.error_guard():
            self._writer.add_rows(self._channel(topic, schema), times_ns, messages)

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add lines of a transcript."""
        with self.error_guard():
            self._writer.add_lines(self._channel(topic, LINES), times_ns, messages)

    def add_entries(self, entries: Iterable[Entry]) -> bool:
        """Add messages of another log; return False if it has a scene in protobuf, which is left out."""
        is_complete = True
        with self.error_guard():
            for (topic, schema, definition), group in groupby(entries, key=lambda entry: entry[:3]):
                if definition is None:
                    is_complete = False
                    continue
                messages = list(group)
                channel = self._writer.channel(topic, schema, definition)
                times_ns = [entry.time_ns for entry in messages]
                self._writer.add_lines(channel, times_ns, [entry.data for entry in messages])
        return is_complete

    def add_event(self, time_ns: int, name: str, text: str) -> None:
        """Add an event."""
        message = channels.line_message(TextLine(time_ns, Level.INFO, name, text))
        self.add("/events", LINES, time_ns, message)

    def add_scene(self, time_ns: int, model: mujoco.MjModel) -> None:
        """Add the shapes of a scene, and the frames of what is fixed to its moving bodies."""
        self.add("/robot_description", STRING, time_ns, channels.text_message(urdf(model)))
        self.add("/scene", SCENE, time_ns, foxglove_scene.scene_update(model))
        self.add("/tf_static", TRANSFORMS, time_ns, MovingBodies(model).static_message)

    def flush(self) -> None:
        """Write or send the added messages."""
        with self.error_guard():
            self._writer.flush()

    def finish(self) -> None:
        """Write or send the rest; no messages are accepted afterwards."""
        self._writer.finish()
        self.open = False

    @contextmanager
    def error_guard(self) -> Generator[None, None, None]:
        """Handle errors of the destination; this class expects none."""
        yield

    def _channel(self, topic: str, schema: str) -> int:
        return self._writer.channel(topic, schema, SCHEMAS[schema])
