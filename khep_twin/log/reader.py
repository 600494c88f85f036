"""Reading of logs: recorded data as arrays, without ROS, rerun or the simulator."""

import re
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular
from khep_twin.files.toml_files import NAME_WISH
from khep_twin.log.channels import FLOATS, INTEGERS, TextLine
from khep_twin.log.content import Content, Entry
from khep_twin.log.decoding import (
    LATEST_NS,
    Misfit,
    read_array,
    read_arrays_of,
    read_line,
    read_transforms,
    shown,
)
from khep_twin.log.wire import read_acts, read_states

PIECE = 32 << 20
"""Most bytes of messages that `read_pieces` reads at a time, besides a chunk."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """Recorded data of one robot.

    Attributes:
        times_ns: Times of the samples (n,) [ns].
        pose: Positions x, y [m] and headings [rad] (n, 3).
        proximity: Counts in the order of N (n, 8).
        ambient: Counts in the order of O (n, 8).
        speed: Speeds left, right, setpoint left, setpoint right (n, 4) [pulses/10 ms].
        duty: Duties left, right (n, 2) [-255 to 255].
        registers: Whole state of the board (n, n_registers).
        serial: Transcript, in order of time.
    """

    times_ns: NDArray[np.int64]
    pose: NDArray[np.float64]
    proximity: NDArray[np.int64]
    ambient: NDArray[np.int64]
    speed: NDArray[np.int64]
    duty: NDArray[np.int64]
    registers: NDArray[np.int64]
    serial: list[TextLine]


@dataclass(frozen=True, slots=True)
class Label:
    """Metadata and attachments of a log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py.
        robots: Names of the robots.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """A whole log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py.
        robots: Tracks of the robots, by name.
        events: Events, in order of time.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: Mapping[str, RobotTrack]
    events: list[TextLine]


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """One channel of numbers.

    Attributes:
        times_ns: Times of the messages (n,) [ns].
        values: Values as written (n, length).
    """

    times_ns: NDArray[np.int64]
    values: NDArray[np.int64] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole log with each channel at its own times, as in logs of real robots.

    Attributes:
        label: Metadata and attachments of the log.
        series: Channels of samples by topic; "/khepera0/pose" is x, y [m] and heading [rad] from /tf.
        lines: Channels of text by topic, in order of time.
    """

    label: Label
    series: Mapping[str, TimeSeries]
    lines: Mapping[str, list[TextLine]]


def read(path: Path) -> LoggedRun:
    """Read a log as arrays.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    with _opened(path) as content:
        label = _label(path, content)
        columns = _Columns(path, label.robots)
        for topic, _, time_ns, data in content.messages():
            columns.add(topic, time_ns, data)
        robots = {name: columns.track(name) for name in label.robots}
    return LoggedRun(label.metadata, label.attachments, robots, columns.lines["/events"])


def read_label(path: Path) -> Label:
    """Read metadata and attachments of a log; fast for any length of the run.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    with _opened(path) as content:
        return _label(path, content)


def read_end_ns(path: Path) -> int:
    """Return the time of a log's last message [ns]; fast for any length of the run.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    with _opened(path) as content:
        return content.end_ns()


def read_arrays(path: Path) -> tuple[Label, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """Read a log's label and its arrays of floats by topic: times (n,) [ns] and values (n, length).

    Raises:
        LogError: It does not exist, or is not whole.
    """
    messages = _Messages(path)
    with _opened(path) as content:
        label = _label(path, content)
        for topic, schema, time_ns, data in content.messages():
            if schema == FLOATS:
                messages.add(topic, "d", time_ns, data)
    return label, {
        topic: (times_ns, values.astype(np.float64)) for topic, times_ns, values in messages.arrays()
    }


def read_series(path: Path) -> Recording:
    """Read a log with each channel at its own times.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    with _opened(path) as content:
        # In the file's order, in which each channel is in order of time anyway: sorting all takes long.
        return _recording(path, _label(path, content), content.messages(in_order=False))


def read_heads(path: Path) -> Recording:
    """Return a log with the first message of each channel; fast for any length of the run.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    with _opened(path) as content:
        return _recording(path, _label(path, content), content.first_messages())


def read_pieces(path: Path, progress: Callable[[float], None] | None = None) -> Iterator[Recording]:
    """Yield a log in pieces small enough for the memory, in order of time.

    Args:
        path: Path of a finished log.
        progress: Function that takes the share that has been read, 0 to 1.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    return (recording for recording, _, _ in read_with_messages(path, progress))


def read_with_messages(
    path: Path, progress: Callable[[float], None] | None = None
) -> Iterator[tuple[Recording, list[Entry], Callable[[str], str | bytes | None]]]:
    """Yield pieces as `read_pieces` does, with their messages and a function for the definition of a type."""
    with _opened(path) as content:
        label = _label(path, content)
        for share, messages in content.pieces(PIECE):
            yield _recording(path, label, messages), messages, content.definition
            if progress is not None:
                progress(share)


def _recording(path: Path, label: Label, found: Iterable[Entry]) -> Recording:
    messages, columns = _Messages(path), _Columns(path, label.robots)
    for topic, schema, time_ns, data in found:
        kind = _KINDS.get(schema)
        if topic.rpartition("/")[2] in _FOR_REPEAT:
            continue
        if kind is None:
            columns.add(topic, time_ns, data)
        else:
            messages.add(topic, kind, time_ns, data)
    series = {topic: _in_order(times_ns, values) for topic, times_ns, values in messages.arrays()}
    for name in label.robots:
        if len(pose := columns.pose(name)):
            series[f"/{name}/pose"] = _in_order(np.array(columns.times_ns, np.int64), pose)
    lines = {topic: sorted(found, key=lambda line: line.time_ns) for topic, found in columns.lines.items()}
    return Recording(label, series, lines)


def _in_order(times_ns: NDArray[np.int64], values: NDArray[np.int64] | NDArray[np.float64]) -> TimeSeries:
    order = np.argsort(times_ns, kind="stable")
    return TimeSeries(times_ns[order], values[order])


_KINDS = {FLOATS: "d", INTEGERS: "q"}
"""Format of the numbers of a message type."""

_FOR_REPEAT = ("wire", "state")
"""Channels without samples, for `khep-twin repeat`, in rows of any length."""


def read_raw(
    path: Path, wanted: Callable[[str], bool]
) -> tuple[Label, dict[str, list[tuple[int, bytes]]], bool]:
    """Read a log's label, and times [ns] and bytes of its messages by topic, in the order of the file.

    Args:
        path: Path of a finished log.
        wanted: Function that returns whether to read a topic.

    Returns:
        Label, messages, and whether the log was recovered, so that its end may be missing.

    Raises:
        LogError: It does not exist, or is not whole.
    """
    found: dict[str, list[tuple[int, bytes]]] = {}
    with _opened(path) as content:
        label = _label(path, content)
        recovered = any(record.name == "recovered" for record in content.metadata())
        for topic, _, time_ns, data in content.messages(in_order=False):
            if wanted(topic):
                _check_time(path, topic, time_ns)
                found.setdefault(topic, []).append((time_ns, data))
    return label, found, recovered


@contextmanager
def _opened(path: Path) -> Generator[Content, None, None]:
    """Open a log; turn errors of its file and its content into one line."""
    try:
        file = open_regular(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    with file:
        try:
            yield Content(file)
        except Misfit as misfit:
            raise LogError(f"{path}: no whole log: {misfit}") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from error


def _label(path: Path, content: Content) -> Label:
    metadata = {
        key: text
        for record in content.metadata()
        if record.name == "run"
        for key, text in record.metadata.items()
    }
    if "robots" not in metadata:
        raise LogError(f"{path}: an MCAP file, but no log of khep_twin")
    attachments: dict[str, str] = {}
    for each in content.attachments():
        try:
            # `recover` has kept what it could of damaged attachments.
            damaged = each.name.startswith("damaged/")
            attachments[each.name] = each.data.decode("utf-8", "replace" if damaged else "strict")
        except UnicodeDecodeError as error:
            misfit = Misfit(f"byte {each.data[error.start]:#04x} at {error.start}", "UTF-8")
            raise misfit.at(path, each.name) from None
    try:
        return Label(metadata, attachments, robot_names(metadata["robots"]))
    except Misfit as misfit:
        raise misfit.at(path, "metadata") from None


def robot_names(text: str) -> tuple[str, ...]:
    """Return the names of a log's robots from its metadata.

    Raises:
        Misfit: They are no valid names.
    """
    if not _NAMES.fullmatch(text):
        raise Misfit(f"robots = {shown(text)}", f"names with commas between, each {NAME_WISH}")
    names = tuple(text.split(","))
    if len(set(names)) < len(names):
        raise Misfit(f"robots = {shown(text)}", "each name once")
    return names


_NAMES = re.compile(r"[A-Za-z0-9_-]{1,64}(,[A-Za-z0-9_-]{1,64}){0,999}")


class Sieve:
    """Filter of messages that the reader accepts, for writing a log from untrusted data.

    Args:
        robots: Names of the robots.
    """

    def __init__(self, robots: Sequence[str]) -> None:
        self._bases = {f"{robot}/base" for robot in robots}
        self._columns = _Columns(Path(), robots)
        self._lengths: dict[tuple[str, str], int] = {}

    def takes(self, topic: str, schema: str, time_ns: int, message: bytes) -> bool:
        """Return whether the reader accepts a message after those passed before."""
        try:
            return self._fits(topic, schema, time_ns, message)
        except (Misfit, LogError):
            return False

    def _fits(self, topic: str, schema: str, time_ns: int, message: bytes) -> bool:
        name = topic.rpartition("/")[2]
        if name == "wire":
            for _ in read_acts(message):
                pass
        if name == "state":
            read_states(message)
        kind = _KINDS.get(schema)
        length = None if kind is None else len(read_array(message, kind))
        columns = self._columns
        for kept in (columns.times_ns, columns.poses, columns.lines):
            kept.clear()
        columns.add(topic, time_ns, message)
        # One row defines the length of the others.
        del columns.arrays.get(topic, [])[1:]
        if topic == "/tf" and not self._bases <= columns.poses.keys():
            return False
        free = name in _FOR_REPEAT and kind == "q"
        return length is None or free or length == self._lengths.setdefault((topic, schema), length)


def _check_time(path: Path, topic: str, time_ns: int) -> None:
    if time_ns > LATEST_NS:
        raise Misfit(f"time = {time_ns} ns", f"at most {LATEST_NS} ns").at(path, topic)


class _Lines(dict[str, list[TextLine]]):
    def __missing__(self, topic: str) -> list[TextLine]:
        return self.setdefault(topic, [])


class _Messages:
    """Messages of numbers by topic, to be decoded many at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: dict[tuple[str, str], tuple[list[int], list[bytes]]] = {}

    def add(self, topic: str, kind: str, time_ns: int, message: bytes) -> None:
        _check_time(self._path, topic, time_ns)
        times_ns, messages = self._found.setdefault((topic, kind), ([], []))
        times_ns.append(time_ns)
        messages.append(message)

    def arrays(
        self,
    ) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.int64] | NDArray[np.float64]]]:
        for (topic, kind), (times_ns, messages) in self._found.items():
            try:
                values = read_arrays_of(messages, kind)
            except Misfit as misfit:
                raise misfit.at(self._path, topic, times_ns[misfit.row]) from None
            yield topic, np.array(times_ns, np.int64), values


@dataclass
class _Columns:
    """Messages sorted by topic while they are read."""

    path: Path
    robots: Sequence[str]
    times_ns: list[int] = field(default_factory=list[int])
    poses: dict[str, list[tuple[float, ...]]] = field(default_factory=dict[str, list[tuple[float, ...]]])
    arrays: dict[str, list[tuple[float, ...]]] = field(default_factory=dict[str, list[tuple[float, ...]]])
    lines: _Lines = field(default_factory=_Lines)

    def add(self, topic: str, time_ns: int, message: bytes) -> None:
        _check_time(self.path, topic, time_ns)
        try:
            self._add(topic, time_ns, message)
        except Misfit as misfit:
            raise misfit.at(self.path, topic, time_ns) from None

    def _add(self, topic: str, time_ns: int, message: bytes) -> None:
        _, name, kind = f"//{topic}".rsplit("/", 2)
        if topic == "/tf":
            self.times_ns.append(time_ns)
            for frame, pose in read_transforms(message).items():
                self.poses.setdefault(frame, []).append(pose)
        elif topic == "/events" or (kind == "serial" and name in self.robots):
            self.lines[topic].append(read_line(message))
        elif kind in _WIDTHS and name in self.robots:
            row = read_array(message, "q" if kind == "registers" else "d")
            rows = self.arrays.setdefault(topic, [])
            width = _WIDTHS[kind] or len(rows[0] if rows else row)
            if len(row) != width:
                raise Misfit(f"{len(row)} values", f"{width} of {kind}")
            if kind != "registers" and not all(-_LARGEST <= value <= _LARGEST for value in row):
                raise Misfit(f"values {shown(row)}", f"numbers from -{_LARGEST} to {_LARGEST}")
            rows.append(row)

    def pose(self, name: str) -> NDArray[np.float64]:
        """Return x, y [m] and heading [rad] of a robot at `times_ns` (n, 3)."""
        rows = self.poses.get(f"{name}/base", [])
        if len(rows) != len(self.times_ns):
            found = f"{name}/base in {len(rows)} of {len(self.times_ns)} messages"
            raise Misfit(found, "it in each").at(self.path, "/tf")
        poses = np.array(rows, np.float64).reshape(-1, 7)
        x, y, z, w = poses[:, 3:].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.column_stack([poses[:, :2], heading])

    def track(self, name: str) -> RobotTrack:
        return RobotTrack(
            np.array(self.times_ns, np.int64),
            self.pose(name),
            self._integers(name, "proximity"),
            self._integers(name, "ambient"),
            self._integers(name, "speed"),
            self._integers(name, "duty"),
            self._integers(name, "registers"),
            self.lines[f"/{name}/serial"],
        )

    def _integers(self, name: str, kind: str) -> NDArray[np.int64]:
        rows = self.arrays.get(f"/{name}/{kind}", [])
        return np.array(rows, np.int64).reshape(len(rows), len(rows[0]) if rows else _WIDTHS[kind])


_WIDTHS = {"proximity": 8, "ambient": 8, "speed": 4, "duty": 2, "registers": 0}
"""Numbers of a message by channel; 0 for as many as in the first one."""

_LARGEST = 2**62
"""Largest number that is accepted as an integer."""
