"""Reading of logs: recorded data as arrays, without ROS, rerun or the simulator.

Each function raises a `LogError` for a log that does not exist, or is not whole.
"""

import hashlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from khep_twin.drawing.paths import DrawnPath
from khep_twin.errors import LogError, PlaypenError
from khep_twin.files.atomic import open_regular
from khep_twin.files.paths import StrPath
from khep_twin.invocation import command
from khep_twin.log.channels import FLOATS, IMAGE, TextLine
from khep_twin.log.columns import KNOWN4, named
from khep_twin.log.content import Content
from khep_twin.log.decoding import DecodeError, readable
from khep_twin.log.entries import Entry, Label, label_of, run_facts
from khep_twin.log.messages import WIDTHS, Messages, TimeSeries, check_time, is_for_repeat
from khep_twin.playpen import Playpen, parse
from khep_twin.playpen.checks import require_kheperas

_MORE = [kind for kind in KNOWN4 if kind not in WIDTHS]

PIECE = 32 << 20
"""Most bytes of messages that `read_pieces` reads at a time, besides a chunk."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """Recorded data of one robot.

    Attributes:
        times_ns: Times of the samples (n,) [ns].
        pose: Positions x, y [m] and headings [rad] (n, 3).
        proximity: Counts in the order of N (n, 8); of a Khepera IV (n, 12).
        ambient: Counts in the order of O (n, 8); of a Khepera IV (n, 12).
        speed: Speeds left, right, setpoint left, setpoint right (n, 4) [pulses/10 ms].
        duty: Duties left, right (n, 2) [-255 to 255]; of a Khepera IV [-2940 to 2940].
        registers: Whole state of the board (n, n_registers).
        serial: Transcript, in order of time.
        more: Further channels of a Khepera IV by name (n, columns), e.g. "ultrasonic"; none of others.
    """

    times_ns: NDArray[np.int64]
    pose: NDArray[np.float64]
    proximity: NDArray[np.int64]
    ambient: NDArray[np.int64]
    speed: NDArray[np.int64]
    duty: NDArray[np.int64]
    registers: NDArray[np.int64]
    serial: list[TextLine]
    more: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """A whole log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py or
            controller/*.json.
        robots: Tracks of the robots, by name.
        events: Events, in order of time.
        source: Path of the log.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: Mapping[str, RobotTrack]
    events: list[TextLine]
    source: Path

    @property
    def playpen(self) -> Playpen:
        """Playpen of the run.

        Raises:
            LogError: The log has none, or one that cannot be used.
        """
        from khep_twin.log.attached import playpen_of  # which loads MuJoCo

        return playpen_of(self.attachments, self.source)

    @property
    def paths(self) -> tuple[DrawnPath, ...]:
        """Paths of the robots, as `khep_twin.draw` takes them; none of a robot whose poses are not known."""
        return tuple(
            DrawnPath(name, track.times_ns / 1e9, 1000 * track.pose[:, :2])
            for name, track in self.robots.items()
            if len(track.pose)
        )

    def table(self) -> dict[str, NDArray[np.generic]]:
        """Return the samples of all robots as columns (n,) by name, as `pandas.DataFrame` takes them.

        They are "time_s", "robot", and those of `khep-twin export` for pose, proximity, ambient, speed and
        duty, of a Khepera IV also its further channels; NaN where a robot has no such column. Rows are in
        order of time, and then of the robots.
        """
        tracks = [*self.robots.values()]
        times_ns = np.concatenate([track.times_ns for track in tracks])
        order = np.argsort(times_ns, kind="stable")
        names = np.repeat([*self.robots], [len(track.times_ns) for track in tracks])
        table: dict[str, NDArray[np.generic]] = {"time_s": times_ns[order] / 1e9, "robot": names[order]}
        mixed = len({bool(track.more) for track in tracks}) > 1
        found: dict[str, dict[int, NDArray[np.generic]]] = {}
        for index, track in enumerate(tracks):
            own = {kind: getattr(track, kind) for kind in ("pose", "proximity", "ambient", "speed", "duty")}
            for kind, values in (own | dict(track.more)).items():
                _, columns = named(kind, values.shape[1], khepera4=bool(track.more), mixed=mixed)
                for (column, _), each in zip(columns, values.T, strict=True):
                    found.setdefault(column, {})[index] = each
        gaps = [np.full(len(track.times_ns), np.nan) for track in tracks]
        for column, own in found.items():
            parts = [own.get(index, gap) for index, gap in enumerate(gaps)]
            table[column] = np.concatenate(parts)[order]
        return table


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


def read_log(path: StrPath) -> LoggedRun:
    """Read a log as arrays."""
    path = Path(path)
    with _opened(path) as content:
        label = _label(path, content)
        messages = Messages(path, content.messages())
    times_ns, poses = messages.poses(label.robots)
    robots = {
        name: RobotTrack(
            times_ns,
            pose,
            *(messages.samples(name, kind) for kind in WIDTHS),
            serial=messages.lines(f"/{name}/serial"),
            more={kind: messages.samples(name, kind) for kind in _MORE if messages.is_khepera4(name)},
        )
        for name, pose in zip(label.robots, poses, strict=True)
    }
    return LoggedRun(label.metadata, label.attachments, robots, messages.lines("/events"), path)


def require_kheperas_in(label: Label, source: object, what: str) -> None:
    """Raise a `LogError` where a robot of a log is no Khepera or Khepera II, which `what` is only for."""
    text = label.attachments.get("playpen.toml", "")
    if "khepera4" in text:
        try:
            require_kheperas(parse(text, "playpen.toml", recorded=True), what)
        except PlaypenError as error:
            raise LogError(f"{source}: {error}") from None


def read_label(path: StrPath) -> Label:
    """Read metadata and attachments of a log; fast for any length of the run."""
    path = Path(path)
    with _opened(path) as content:
        return _label(path, content)


def read_end_ns(path: Path) -> int:
    """Return the time of a log's last message [ns]; fast for any length of the run."""
    with _opened(path) as content:
        return content.end_ns()


def hash_of(path: Path) -> str:
    """Return the SHA-256 of a log's file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with readable(path), open_regular(path) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_arrays(path: StrPath) -> tuple[Label, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """Read a log's label and its floats and images by topic: times (n,) [ns] and values (n, length)."""
    path = Path(path)
    with _opened(path) as content:
        label = _label(path, content)
        messages = Messages(path, (each for each in content.messages() if each.schema in (FLOATS, IMAGE)))
    series = messages.series()
    return label, {topic: (each.times_ns, each.values.astype(np.float64)) for topic, each in series.items()}


def read_series(path: StrPath) -> Recording:
    """Read a log with each channel at its own times."""
    path = Path(path)
    with _opened(path) as content:
        return _recording(path, _label(path, content), content.messages())


def read_heads(path: Path) -> Recording:
    """Return a log with the first message of each channel; fast for any length of the run."""
    with _opened(path) as content:
        return _recording(path, _label(path, content), content.first_messages())


def read_pieces(path: Path, progress: Callable[[float], None] | None = None) -> Iterator[Recording]:
    """Yield a log in pieces small enough for the memory, in order of time.

    `progress` takes the share that has been read, 0 to 1.
    """
    return (recording for recording, _ in read_with_messages(path, progress))


def read_with_messages(
    path: Path, progress: Callable[[float], None] | None = None
) -> Iterator[tuple[Recording, list[Entry]]]:
    """Yield pieces as `read_pieces` does, with their messages."""
    with _opened(path) as content:
        label = _label(path, content)
        for share, messages in content.pieces(PIECE):
            yield _recording(path, label, messages), messages
            if progress is not None:
                progress(share)


def _recording(path: Path, label: Label, found: Iterable[Entry]) -> Recording:
    messages = Messages(path, (each for each in found if not is_for_repeat(each.topic)))
    series = messages.series()
    times_ns, poses = messages.poses(label.robots)
    if len(times_ns):
        series |= {
            f"/{name}/pose": TimeSeries(times_ns, pose)
            for name, pose in zip(label.robots, poses, strict=True)
        }
    return Recording(label, series, messages.all_lines(label.robots))


def read_raw(
    path: Path, wanted: Callable[[str], bool]
) -> tuple[Label, dict[str, list[tuple[int, bytes]]], bool]:
    """Read a log's label, and times [ns] and bytes of its messages by topic, in the order of the file.

    Args:
        path: Path of a finished log.
        wanted: Function that returns whether to read a topic.

    Returns:
        Label, messages, and whether the log was recovered, so that its end may be missing.
    """
    found: dict[str, list[tuple[int, bytes]]] = {}
    with _opened(path) as content:
        label = _label(path, content)
        recovered = any(record.name == "recovered" for record in content.metadata())
        for topic, _, _, time_ns, data in content.messages():
            if wanted(topic):
                check_time(path, topic, time_ns)
                found.setdefault(topic, []).append((time_ns, data))
    return label, found, recovered


def read_since(path: Path, topic: str, time_ns: int) -> Generator[list[Entry]]:
    """Yield the last message of a topic up to a time [ns], then those after it, chunk by chunk.

    Without such a message, yield none, and then all messages. With an index, what lies before is not read.
    """
    with _opened(path) as content:
        yield from content.since(topic, time_ns)


def read_until(path: Path, last: Entry) -> Generator[list[Entry]]:
    """Yield the messages of each chunk in the order of the file, up to a message, inclusive."""
    with _opened(path) as content:
        for _, entries in content.chunks():
            piece: list[Entry] = []
            for entry in entries:
                piece.append(entry)
                if entry == last:
                    yield piece
                    return
            yield piece


@contextmanager
def _opened(path: Path) -> Generator[Content, None, None]:
    """Open a log; turn errors of its file and its content into one line."""
    with readable(path), open_regular(path) as file:
        try:
            yield Content(file)
        except DecodeError as error:
            # What begins as a log was torn or damaged, and can be rescued.
            file.seek(0)
            is_torn = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
            rescue = f"; to rescue what is left: {command('recover', path)}"
            make = f"; to make a log: {command('run', '--log', 'run.mcap')}"
            raise LogError(f"{path}: no whole log: {error}", rescue if is_torn else make) from None


def _label(path: Path, content: Content) -> Label:
    metadata = run_facts(content.metadata())
    if "robots" not in metadata:
        missing = "it has no metadata record run that names the robots"
        raise LogError(f"{path}: an MCAP file, but no log of khep_twin: {missing}")
    attachments: dict[str, str] = {}
    for each in content.attachments():
        try:
            # `recover` has kept what it could of damaged attachments.
            damaged = each.name.startswith("damaged/")
            attachments[each.name] = each.data.decode("utf-8", "replace" if damaged else "strict")
        except UnicodeDecodeError as error:
            invalid = DecodeError(f"byte {each.data[error.start]:#04x} at {error.start}", "UTF-8")
            raise invalid.at(path, each.name) from None
    return label_of(path, metadata, attachments)
