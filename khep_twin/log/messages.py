"""Messages of a log by topic: collected while a file is read, decoded on request."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import FLOATS, IMAGE, INTEGERS, TextLine
from khep_twin.log.decoding import (
    LATEST_NS,
    DecodeError,
    printable,
    read_all,
    read_array,
    read_line,
    read_transforms,
    stack_arrays,
    stack_images,
)
from khep_twin.log.entries import Entry
from khep_twin.log.robot_models import channel_widths
from khep_twin.log.shadow_channels import LINE_TOPICS

NUMERIC_DECODERS: dict[str, Callable[[list[bytes]], NDArray[np.int64] | NDArray[np.float64]]] = {
    FLOATS: partial(stack_arrays, code="d"),
    INTEGERS: partial(stack_arrays, code="q"),
    IMAGE: stack_images,
}
"""Decoders of the numeric message types, to one row for each message."""

REPEAT_CHANNELS = ("host_events", "state", "snapshot")
"""Channels that only `khep-twin repeat` and `branch` read; their messages have any length."""

_MAX_INTEGER = 2**62  # largest number accepted as an integer

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
        entries: Messages in the order of the file; the channels are sorted by time.

    Raises:
        LogError: Here and in each method: a message is invalid.
    """

    def __init__(self, path: Path, entries: Iterable[Entry]) -> None:
        self._path = path
        self._by_topic: dict[str, dict[str, tuple[list[int], list[bytes]]]] = {}
        for topic, schema, _, time_ns, data in entries:
            check_time(path, topic, time_ns)
            times_ns, messages = self._by_topic.setdefault(topic, {}).setdefault(schema, ([], []))
            times_ns.append(time_ns)
            messages.append(data)

    def series(self) -> dict[str, TimeSeries]:
        """Return all channels of numbers by topic."""
        return {
            topic: TimeSeries(*self._decode(topic, NUMERIC_DECODERS[schema], schema))
            for topic, schemas in self._by_topic.items()
            for schema in schemas
            if schema in NUMERIC_DECODERS
        }

    def samples(self, robot: str, name: str) -> NDArray[np.int64]:
        """Return the values of a robot's sampled channel as integers (n, width)."""
        _, values = self._decode(f"/{robot}/{name}", partial(read_samples, name=name))
        return values.astype(np.int64)

    @property
    def topics(self) -> Collection[str]:
        """Topics of the messages."""
        return self._by_topic.keys()

    def lines(self, topic: str) -> list[TextLine]:
        """Return the lines of a transcript or the events."""
        _, lines = self._decode(topic, partial(read_all, read_line))
        return sorted(lines, key=lambda line: line.time_ns)

    def all_lines(self, robots: Sequence[str]) -> dict[str, list[TextLine]]:
        """Return all channels of lines by topic."""
        topics = line_topics(robots)
        return {topic: self.lines(topic) for topic in self._by_topic if topic in topics}

    def poses(self, robots: Sequence[str]) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
        """Return the times of the poses (n,) [ns], and x, y [m] and heading [rad] of each robot (n, 3)."""
        times_ns, frame_poses = self._decode("/tf", partial(read_all, read_transforms))
        poses: list[NDArray[np.float64]] = []
        for base in (f"{name}/base" for name in robots):
            base_poses = [bodies[base] for bodies in frame_poses if base in bodies]
            if len(base_poses) != len(frame_poses):
                actual = f"{base} in {len(base_poses)} of {len(frame_poses)} messages"
                raise DecodeError(actual, "it in each").to_log_error(self._path, "/tf")
            values = np.array(base_poses, np.float64).reshape(-1, 7)
            x, y, z, w = values[:, 3:].T
            heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            poses.append(np.column_stack([values[:, :2], heading]))
        return times_ns, poses

    def _decode(
        self, topic: str, read: Callable[[list[bytes]], _T], schema: str | None = None
    ) -> tuple[NDArray[np.int64], _T]:
        """Return times [ns] and content of a topic's messages in order of time, of one type or of all."""
        by_schema = self._by_topic.get(topic, {})
        channels = list(by_schema.values()) if schema is None else [by_schema[schema]]
        times_ns = np.array([time_ns for times_ns, _ in channels for time_ns in times_ns], np.int64)
        messages = [message for _, messages in channels for message in messages]
        time_order = np.argsort(times_ns, kind="stable")
        try:
            return times_ns[time_order], read([messages[row] for row in time_order.tolist()])
        except DecodeError as error:
            raise error.to_log_error(self._path, topic, int(times_ns[time_order][error.row])) from None


def check_time(path: Path, topic: str, time_ns: int) -> None:
    """Raise a `LogError` if a message is later than `LATEST_NS`."""
    if time_ns > LATEST_NS:
        raise DecodeError(f"time = {time_ns} ns", f"at most {LATEST_NS} ns").to_log_error(path, topic)


def is_repeat_channel(topic: str) -> bool:
    """Return whether a topic is one of `REPEAT_CHANNELS`, e.g. /state, but not /shadow/state."""
    return topic.rpartition("/")[2] in REPEAT_CHANNELS and topic not in LINE_TOPICS


def line_topics(robots: Iterable[str]) -> set[str]:
    """Return the topics of the events, the transcripts and a shadow's lines."""
    return {"/events", *LINE_TOPICS, *(f"/{robot}/serial" for robot in robots)}


def read_samples(messages: Sequence[bytes], name: str) -> _Values:
    """Return the values of messages of a robot's sampled channel (n, width)."""
    width, *other_widths = channel_widths(name)
    if not messages:
        return np.zeros((0, width))
    if name == "registers":
        return stack_arrays(messages, "q", width, f" of {name}")
    if (first_width := len(read_array(messages[0], "d"))) in other_widths:
        width = first_width
    values = stack_arrays(messages, "d", width, f" of {name}")
    in_range = ((values >= -_MAX_INTEGER) & (values <= _MAX_INTEGER)).all(axis=1)
    if not in_range.all():
        row = int(np.argmin(in_range))
        actual = f"values {printable(tuple(values[row].tolist()))}"
        raise DecodeError(actual, f"numbers from -{_MAX_INTEGER} to {_MAX_INTEGER}").in_row(row)
    return values
