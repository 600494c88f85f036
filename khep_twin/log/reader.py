"""Reading a log back: what was recorded as arrays, without ROS, rerun or the simulator."""

import struct
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from numpy.typing import NDArray
from zstandard import ZstdError

from khep_twin.errors import LogError
from khep_twin.files import open_regular
from khep_twin.log.channels import (
    FLOATS,
    INTEGERS,
    Line,
    read_array,
    read_arrays_of,
    read_line,
    read_transforms,
)

_DAMAGE = (
    McapError,
    ZstdError,
    struct.error,
    OSError,
    EOFError,
    LookupError,
    ValueError,
    OverflowError,
    MemoryError,
)
"""What the mcap reader raises, depending on where a file is damaged."""


@dataclass(frozen=True, slots=True)
class Track:
    """What was recorded of one robot.

    Attributes:
        times_ns: of the samples (n,) [ns].
        pose: x, y [m] and heading [rad] (n, 3).
        proximity: counts in the order of N (n, 8).
        ambient: counts in the order of O (n, 8).
        speed: left, right, setpoint left, setpoint right (n, 4) [pulses/10 ms].
        duty: left, right (n, 2) [-255 to 255].
        registers: the board's whole state (n, n_registers).
        serial: the transcript, in order of time.
    """

    times_ns: NDArray[np.int64]
    pose: NDArray[np.float64]
    proximity: NDArray[np.int64]
    ambient: NDArray[np.int64]
    speed: NDArray[np.int64]
    duty: NDArray[np.int64]
    registers: NDArray[np.int64]
    serial: list[Line]


@dataclass(frozen=True, slots=True)
class Label:
    """What a log says of itself.

    Attributes:
        metadata: seed, versions, settings.
        attachments: playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py.
        robots: names.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Run:
    """A whole log.

    Attributes:
        metadata: seed, versions, settings.
        attachments: playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py.
        robots: the tracks, by name.
        events: notes, in order of time.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: Mapping[str, Track]
    events: list[Line]


@dataclass(frozen=True, slots=True)
class Series:
    """One channel of numbers.

    Attributes:
        times_ns: of the messages (n,) [ns].
        values: as they were written (n, length).
    """

    times_ns: NDArray[np.int64]
    values: NDArray[np.int64] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole log with each channel at its own times, as logs of real robots have them.

    Attributes:
        label: what the log says of itself.
        series: channels of samples by topic; "/khepera0/pose" is x, y [m] and heading [rad] out of /tf.
        lines: channels of text by topic, in order of time.
    """

    label: Label
    series: Mapping[str, Series]
    lines: Mapping[str, list[Line]]


def read(path: Path) -> Run:
    """A log as arrays.

    Raises:
        LogError: there is none, or it is not whole.
    """
    with _opened(path) as reader:
        label = _label(path, reader)
        columns = _Columns()
        for _, channel, message in reader.iter_messages():
            columns.add(channel.topic, message.log_time, message.data)
        robots = {name: columns.track(name) for name in label.robots}
    return Run(label.metadata, label.attachments, robots, columns.lines["/events"])


def read_label(path: Path) -> Label:
    """What a log says of itself; quick however long the run was.

    Raises:
        LogError: there is none, or it is not whole.
    """
    with _opened(path) as reader:
        return _label(path, reader)


def read_end_ns(path: Path) -> int:
    """The time of a log's last message [ns]; quick however long the run was.

    Raises:
        LogError: there is none, or it is not whole.
    """
    with _opened(path) as reader:
        summary = reader.get_summary()
        statistics = None if summary is None else summary.statistics
        if statistics is None:
            raise ValueError("no statistics")
        return statistics.message_end_time


def read_arrays(path: Path) -> tuple[Label, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """What a log says of itself, and its arrays of floats by topic: times (n,) [ns] and values (n, length).

    Raises:
        LogError: there is none, or it is not whole.
    """
    times: dict[str, list[int]] = {}
    rows: dict[str, list[tuple[float, ...]]] = {}
    with _opened(path) as reader:
        label = _label(path, reader)
        for schema, channel, message in reader.iter_messages():
            if schema is not None and schema.name == FLOATS:
                times.setdefault(channel.topic, []).append(message.log_time)
                rows.setdefault(channel.topic, []).append(read_array(message.data, "d"))
        # In here, since rows of several lengths are damage, too.
        return label, {
            topic: (np.array(times[topic], np.int64), np.array(values, np.float64))
            for topic, values in rows.items()
        }


def read_series(path: Path) -> Recording:
    """A log with each channel at its own times.

    Raises:
        LogError: there is none, or it is not whole.
    """
    times: dict[tuple[str, str], list[int]] = {}
    messages: dict[tuple[str, str], list[bytes]] = {}
    columns = _Columns()
    with _opened(path) as reader:
        label = _label(path, reader)
        # In the file's order, in which each channel is in order of time anyway: to sort all takes long.
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            kind = _KINDS.get("" if schema is None else schema.name)
            if channel.topic.rpartition("/")[2] in _FOR_REPEAT:
                continue
            if kind is None:
                columns.add(channel.topic, message.log_time, message.data)
            else:
                times.setdefault((channel.topic, kind), []).append(message.log_time)
                messages.setdefault((channel.topic, kind), []).append(message.data)
        # In here, since rows of several lengths are damage, too.
        series = {
            topic: _in_order(np.array(times[topic, kind], np.int64), read_arrays_of(found, kind))
            for (topic, kind), found in messages.items()
        }
        for name in label.robots:
            track = columns.track(name)
            if len(track.pose):
                series[f"/{name}/pose"] = _in_order(track.times_ns, track.pose)
    lines = {topic: sorted(found, key=lambda line: line.time_ns) for topic, found in columns.lines.items()}
    return Recording(label, series, lines)


def _in_order(times_ns: NDArray[np.int64], values: NDArray[np.int64] | NDArray[np.float64]) -> Series:
    if len(times_ns) != len(values):
        raise ValueError(f"{len(values)} rows at {len(times_ns)} times")
    order = np.argsort(times_ns, kind="stable")
    return Series(times_ns[order], values[order])


_KINDS = {FLOATS: "d", INTEGERS: "q"}
"""How the numbers of a message type are packed."""

_FOR_REPEAT = ("wire", "state")
"""Channels that hold no samples but what `khep-twin repeat` needs, in rows of any length."""


def read_raw(
    path: Path, wanted: Callable[[str], bool]
) -> tuple[Label, dict[str, list[tuple[int, bytes]]], bool]:
    """What a log says of itself, times [ns] and bytes of its messages by topic, in the order of the file.

    Args:
        path: of a finished log.
        wanted: whether a topic is.

    Returns:
        Label, messages, and whether the log was recovered, so that its end may be missing.

    Raises:
        LogError: there is none, or it is not whole.
    """
    found: dict[str, list[tuple[int, bytes]]] = {}
    with _opened(path) as reader:
        label = _label(path, reader)
        recovered = any(record.name == "recovered" for record in reader.iter_metadata())
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if wanted(channel.topic):
                found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return label, found, recovered


@contextmanager
def _opened(path: Path) -> Generator[McapReader, None, None]:
    """Opens a log; what goes wrong with its file and its content becomes one line."""
    try:
        file = open_regular(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    with file:
        try:
            yield make_reader(file, validate_crcs=True)
        except _DAMAGE as error:
            what = f"no whole log ({type(error).__name__})"
            raise LogError(f"{path}: {what}; right is a finished .mcap file") from error


def _label(path: Path, reader: McapReader) -> Label:
    metadata = {
        key: text
        for record in reader.iter_metadata()
        if record.name == "run"
        for key, text in record.metadata.items()
    }
    if "robots" not in metadata:
        raise LogError(f"{path}: an MCAP file, but no log of khep_twin")
    attachments = {each.name: each.data.decode("utf-8") for each in reader.iter_attachments()}
    return Label(metadata, attachments, tuple(metadata["robots"].split(",")))


class _Lines(dict[str, list[Line]]):
    def __missing__(self, topic: str) -> list[Line]:
        return self.setdefault(topic, [])


@dataclass
class _Columns:
    """Messages sorted by topic, as they are read."""

    times_ns: list[int] = field(default_factory=list[int])
    poses: dict[str, list[tuple[float, ...]]] = field(default_factory=dict[str, list[tuple[float, ...]]])
    arrays: dict[str, list[tuple[float, ...]]] = field(default_factory=dict[str, list[tuple[float, ...]]])
    lines: _Lines = field(default_factory=_Lines)

    def add(self, topic: str, time_ns: int, message: bytes) -> None:
        kind = topic.rpartition("/")[2]
        if topic == "/tf":
            self.times_ns.append(time_ns)
            for name, pose in read_transforms(message).items():
                self.poses.setdefault(name, []).append(pose)
        elif kind in ("serial", "events"):
            self.lines[topic].append(read_line(message))
        elif kind in ("proximity", "ambient", "speed", "duty", "registers"):
            self.arrays.setdefault(topic, []).append(read_array(message, "q" if kind == "registers" else "d"))

    def track(self, name: str) -> Track:
        poses = np.array(self.poses.get(f"{name}/base", []), np.float64).reshape(-1, 7)
        x, y, z, w = poses[:, 3:].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return Track(
            np.array(self.times_ns, np.int64),
            np.column_stack([poses[:, :2], heading]),
            self._integers(name, "proximity", 8),
            self._integers(name, "ambient", 8),
            self._integers(name, "speed", 4),
            self._integers(name, "duty", 2),
            self._integers(name, "registers", -1),
            self.lines[f"/{name}/serial"],
        )

    def _integers(self, name: str, kind: str, width: int) -> NDArray[np.int64]:
        rows = self.arrays.get(f"/{name}/{kind}", [])
        return np.array(rows, np.int64).reshape(len(rows), width if rows or width > 0 else 0)
