"""Messages of a log by topic: collected while a file is read, decoded when they are asked for."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import FLOATS, IMAGE, INTEGERS, TextLine
from khep_twin.log.columns import is_khepera4
from khep_twin.log.decoding import (
    LATEST_NS,
    DecodeError,
    read_array,
    read_arrays_of,
    read_each,
    read_images_of,
    read_line,
    read_transforms,
    shown,
)
from khep_twin.log.entries import Entry
from khep_twin.log.shadow_channels import LINE_TOPICS

READERS: dict[str, Callable[[list[bytes]], NDArray[np.int64] | NDArray[np.float64]]] = {
    FLOATS: partial(read_arrays_of, kind="d"),
    INTEGERS: partial(read_arrays_of, kind="q"),
    IMAGE: read_images_of,
}
"""Decoders of the message types that hold numbers, to one row for each message."""

FOR_REPEAT = ("host_events", "state", "snapshot")
"""Channels without samples, for `khep-twin repeat` and `branch`, in rows of any length."""

WIDTHS = {"proximity": (8, 12), "ambient": (8, 12), "speed": (4,), "duty": (2,), "registers": (0,)}
"""Numbers of a message by sampled channel of a robot, of each model; 0 for as many as in the first one."""

_LARGEST = 2**62
"""Largest number that is accepted as an integer."""

_Values = NDArray[np.int64] | NDArray[np.float64]
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """One channel of numbers: times of its messages (n,) [ns], values as written (n, length)."""

    times_ns: NDArray[np.int64]
    values: _Values


class Messages:
    """Messages of a log by topic.

    Args:
        path: Path of the log in messages of errors.
        found: Messages as they are in the file; each channel is put in order of time.

    Raises:
        LogError: Here and in each method: a message is invalid.
    """

    def __init__(self, path: Path, found: Iterable[Entry]) -> None:
        self._path = path
        self._found: dict[str, dict[str, tuple[list[int], list[bytes]]]] = {}
        for topic, schema, _, time_ns, data in found:
            check_time(path, topic, time_ns)
            times_ns, messages = self._found.setdefault(topic, {}).setdefault(schema, ([], []))
            times_ns.append(time_ns)
            messages.append(data)

    def series(self) -> dict[str, TimeSeries]:
        """Return all channels of numbers by topic."""
        return {
            topic: TimeSeries(*self._decoded(topic, READERS[schema], schema))
            for topic, found in self._found.items()
            for schema in found
            if schema in READERS
        }

    def samples(self, robot: str, name: str) -> NDArray[np.int64]:
        """Return the values of a robot's sampled channel as integers (n, width)."""
        _, values = self._decoded(f"/{robot}/{name}", partial(read_samples, name=name))
        return values.astype(np.int64)

    def is_khepera4(self, robot: str) -> bool:
        """Return whether a robot is a Khepera IV."""
        return is_khepera4(robot, self._found)

    def lines(self, topic: str) -> list[TextLine]:
        """Return the lines of a transcript or the events."""
        _, lines = self._decoded(topic, partial(read_each, read_line))
        return sorted(lines, key=lambda line: line.time_ns)

    def all_lines(self, robots: Sequence[str]) -> dict[str, list[TextLine]]:
        """Return all channels of lines by topic."""
        topics = line_topics(robots)
        return {topic: self.lines(topic) for topic in self._found if topic in topics}

    def poses(self, robots: Sequence[str]) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
        """Return the times of the poses (n,) [ns], and x, y [m] and heading [rad] of each robot (n, 3)."""
        times_ns, frames = self._decoded("/tf", partial(read_each, read_transforms))
        poses: list[NDArray[np.float64]] = []
        for base in (f"{name}/base" for name in robots):
            rows = [bodies[base] for bodies in frames if base in bodies]
            if len(rows) != len(frames):
                found = f"{base} in {len(rows)} of {len(frames)} messages"
                raise DecodeError(found, "it in each").at(self._path, "/tf")
            values = np.array(rows, np.float64).reshape(-1, 7)
            x, y, z, w = values[:, 3:].T
            heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            poses.append(np.column_stack([values[:, :2], heading]))
        return times_ns, poses

    def _decoded(
        self, topic: str, read: Callable[[list[bytes]], _T], schema: str | None = None
    ) -> tuple[NDArray[np.int64], _T]:
        """Return the times [ns] and the content of a topic's messages, of one type or of all."""
        by_schema = self._found.get(topic, {})
        found = list(by_schema.values()) if schema is None else [by_schema[schema]]
        times_ns = np.array([time_ns for times_ns, _ in found for time_ns in times_ns], np.int64)
        messages = [message for _, messages in found for message in messages]
        order = np.argsort(times_ns, kind="stable")
        try:
            return times_ns[order], read([messages[row] for row in order.tolist()])
        except DecodeError as error:
            raise error.at(self._path, topic, int(times_ns[order][error.row])) from None


def check_time(path: Path, topic: str, time_ns: int) -> None:
    """Raise a `LogError` if a message is later than any run."""
    if time_ns > LATEST_NS:
        raise DecodeError(f"time = {time_ns} ns", f"at most {LATEST_NS} ns").at(path, topic)


def is_for_repeat(topic: str) -> bool:
    """Return whether a channel is one without samples, such as /state, but not /shadow/state."""
    return topic.rpartition("/")[2] in FOR_REPEAT and topic not in LINE_TOPICS


def line_topics(robots: Iterable[str]) -> set[str]:
    """Return the topics of the events, the transcripts and a shadow's lines."""
    return {"/events", *LINE_TOPICS, *(f"/{robot}/serial" for robot in robots)}


def read_samples(messages: Sequence[bytes], name: str) -> _Values:
    """Return the values of messages of a robot's sampled channel (n, width)."""
    width, *others = WIDTHS.get(name, (0,))
    if not messages:
        return np.zeros((0, width))
    if name == "registers":
        return read_arrays_of(messages, "q", width, f" of {name}")
    if others and len(read_array(messages[0], "d")) in others:
        width = others[0]
    values = read_arrays_of(messages, "d", width, f" of {name}")
    small = ((values >= -_LARGEST) & (values <= _LARGEST)).all(axis=1)
    if not small.all():
        row = int(np.argmin(small))
        found = f"values {shown(tuple(values[row].tolist()))}"
        raise DecodeError(found, f"numbers from -{_LARGEST} to {_LARGEST}").in_row(row)
    return values
