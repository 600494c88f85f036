"""Reading of logs: recorded data as arrays, without ROS, rerun or the simulator.

A log's label is its metadata and attachments. Functions raise a `LogError` for a missing or incomplete log.
"""

import hashlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from khep_twin.drawing.paths import DrawnPath
from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular
from khep_twin.files.paths import StrPath
from khep_twin.log.channels import FLOATS, IMAGE, TextLine
from khep_twin.log.columns import name_columns
from khep_twin.log.content import Content
from khep_twin.log.decoding import DecodeError, read_errors
from khep_twin.log.entries import Entry, Label, make_label, run_metadata
from khep_twin.log.messages import Messages, TimeSeries, check_time, is_repeat_channel
from khep_twin.log.robot_models import SAMPLED_CHANNELS, further_channels, models_of
from khep_twin.playpen import Playpen
from khep_twin.process.invocation import command
from khep_twin.renamed import renamed_attribute
from khep_twin.robots.model import Feature, RobotModel
from khep_twin.robots.registry import default_model, model_refusal

if TYPE_CHECKING:
    import khep_twin

BATCH_BYTES = 32 << 20
"""Messages that `read_batches` reads at a time, besides a chunk [bytes]."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """Recorded data of one robot.

    Attributes:
        times_ns: Times of the samples (n,) [ns].
        pose: Positions x, y [m] and headings [rad] (n, 3).
        proximity: Counts of the sensors in the order of the channel (n, n_sensors).
        ambient: Counts in the same order (n, n_sensors).
        speed: Speeds left, right, setpoint left, setpoint right (n, 4) [pulses/10 ms].
        duty: Duties left, right (n, 2) [-255 to 255]; of a Khepera IV [-2940 to 2940].
        registers: Complete state of the board (n, n_registers).
        serial: Transcript, in order of time.
        extra_channels: Further channels of its model by name (n, columns), e.g. "ultrasonic"; or none.
        model: Its model.
    """

    times_ns: NDArray[np.int64]
    pose: NDArray[np.float64]
    proximity: NDArray[np.int64]
    ambient: NDArray[np.int64]
    speed: NDArray[np.int64]
    duty: NDArray[np.int64]
    registers: NDArray[np.int64]
    serial: list[TextLine]
    extra_channels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])
    model: RobotModel = field(default_factory=default_model)
    more = renamed_attribute("more", "extra_channels")


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """A complete log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts by name, as in `Label`.
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
        """Paths of the robots for `khep_twin.draw`, without robots of unknown poses."""
        return tuple(
            DrawnPath(name, track.times_ns / 1e9, 1000 * track.pose[:, :2])
            for name, track in self.robots.items()
            if len(track.pose)
        )

    def html(self) -> "khep_twin.RunPage":
        """Return the page that plays the run in any browser; a notebook shows it below its cell.

        Raises:
            LogError: The log cannot be read, or has nothing to show.
        """
        import khep_twin  # by its public names, as the page is above logs in the order of packages

        return khep_twin.RunPage([self.source])

    def table(self) -> dict[str, NDArray[np.generic]]:
        """Return the samples of all robots as columns (n,) by name, for `pandas.DataFrame`.

        The columns are "time_s", "robot", and those of `khep-twin export` for pose, proximity, ambient, speed
        and duty, and the further channels of its model; NaN where a robot lacks a column. Rows are sorted
        by time, then by robot.
        """
        tracks = [*self.robots.values()]
        times_ns = np.concatenate([track.times_ns for track in tracks])
        order = np.argsort(times_ns, kind="stable")
        names = np.repeat([*self.robots], [len(track.times_ns) for track in tracks])
        table: dict[str, NDArray[np.generic]] = {"time_s": times_ns[order] / 1e9, "robot": names[order]}
        families = {track.model.family for track in tracks}
        values_by_column: dict[str, dict[int, NDArray[np.generic]]] = {}
        for index, track in enumerate(tracks):
            kinds = ("pose", "proximity", "ambient", "speed", "duty")
            channels = {kind: getattr(track, kind) for kind in kinds} | dict(track.extra_channels)
            for kind, values in channels.items():
                _, columns = name_columns(kind, values.shape[1], track.model, families)
                for (column, _), column_values in zip(columns, values.T, strict=True):
                    values_by_column.setdefault(column, {})[index] = column_values
        gaps = [np.full(len(track.times_ns), np.nan) for track in tracks]
        for column, values_by_track in values_by_column.items():
            parts = [values_by_track.get(index, gap) for index, gap in enumerate(gaps)]
            table[column] = np.concatenate(parts)[order]
        return table


@dataclass(frozen=True, slots=True)
class Recording:
    """A complete log with separate times for each channel, as in logs of real robots.

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
    with _open_log(path) as content:
        label = _read_label(path, content)
        messages = Messages(path, content.messages())
    times_ns, poses = messages.poses(label.robots)
    models = models_of(label.attachments, label.robots, messages.topics)
    robots = {
        name: RobotTrack(
            times_ns,
            pose,
            *(messages.samples(name, kind) for kind in SAMPLED_CHANNELS),
            serial=messages.lines(f"/{name}/serial"),
            extra_channels={kind: messages.samples(name, kind) for kind in further_channels(models[name])},
            model=models[name],
        )
        for name, pose in zip(label.robots, poses, strict=True)
    }
    return LoggedRun(label.metadata, label.attachments, robots, messages.lines("/events"), path)


def require_feature_in(label: Label, source: object, feature: Feature) -> None:
    """Raise a `LogError` if the model of a robot of a log does not support a use."""
    models = models_of(label.attachments, label.robots)
    for number, model in enumerate(models.values(), 1):
        if feature not in model.features:
            raise LogError(f"{source}: robot {number}: {model_refusal(model.name, feature)}")


def read_label(path: StrPath) -> Label:
    """Read metadata and attachments of a log; fast for any length of the run."""
    path = Path(path)
    with _open_log(path) as content:
        return _read_label(path, content)


def read_end_ns(path: Path) -> int:
    """Return the time of a log's last message [ns]; fast for any length of the run."""
    with _open_log(path) as content:
        return content.end_ns()


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a log's file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with read_errors(path), open_regular(path) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_arrays(path: StrPath) -> tuple[Label, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """Read a log's label, and by topic its floats and images: times (n,) [ns] and values (n, length)."""
    path = Path(path)
    with _open_log(path) as content:
        label = _read_label(path, content)
        messages = Messages(path, (entry for entry in content.messages() if entry.schema in (FLOATS, IMAGE)))
    series = messages.series()
    return label, {name: (item.times_ns, item.values.astype(np.float64)) for name, item in series.items()}


def read_series(path: StrPath) -> Recording:
    """Read a log with separate times for each channel."""
    path = Path(path)
    with _open_log(path) as content:
        return _make_recording(path, _read_label(path, content), content.messages())


def read_first_messages(path: Path) -> Recording:
    """Read the first message of each channel of a log; fast for any length of the run."""
    with _open_log(path) as content:
        return _make_recording(path, _read_label(path, content), content.first_messages())


def read_batches(path: Path, progress: Callable[[float], None] | None = None) -> Iterator[Recording]:
    """Yield a log in batches that fit in memory, in order of time; `progress` takes the fraction read."""
    return (recording for recording, _ in read_message_batches(path, progress))


def read_message_batches(
    path: Path, progress: Callable[[float], None] | None = None
) -> Iterator[tuple[Recording, list[Entry]]]:
    """Yield batches as `read_batches` does, with their messages."""
    for label, messages in read_entry_batches(path, progress):
        yield _make_recording(path, label, messages), messages


def read_entry_batches(
    path: Path,
    progress: Callable[[float], None] | None = None,
    topic_filter: Callable[[str], bool] | None = None,
) -> Iterator[tuple[Label, list[Entry]]]:
    """Yield batches as `read_batches` does, as messages that are not decoded, of all topics or of some."""
    with _open_log(path, topic_filter) as content:
        label = _read_label(path, content)
        for fraction, messages in content.batches(BATCH_BYTES):
            yield label, messages
            if progress is not None:
                progress(fraction)


def _make_recording(path: Path, label: Label, entries: Iterable[Entry]) -> Recording:
    messages = Messages(path, (entry for entry in entries if not is_repeat_channel(entry.topic)))
    series = messages.series()
    times_ns, poses = messages.poses(label.robots)
    if len(times_ns):
        series |= {
            f"/{name}/pose": TimeSeries(times_ns, pose)
            for name, pose in zip(label.robots, poses, strict=True)
        }
    return Recording(label, series, messages.all_lines(label.robots))


def read_raw(
    path: Path, topic_filter: Callable[[str], bool]
) -> tuple[Label, dict[str, list[tuple[int, bytes]]], bool]:
    """Read a log's label, and times [ns] and bytes of its messages by topic, in the order of the file.

    Args:
        path: Path of a finished log.
        topic_filter: Function that returns whether to read a topic.

    Returns:
        Label, messages, and whether the log was recovered, so that its end may be missing.
    """
    messages: dict[str, list[tuple[int, bytes]]] = {}
    with _open_log(path) as content:
        label = _read_label(path, content)
        is_recovered = any(record.name == "recovered" for record in content.metadata())
        for topic, _, _, time_ns, data in content.messages():
            if topic_filter(topic):
                check_time(path, topic, time_ns)
                messages.setdefault(topic, []).append((time_ns, data))
    return label, messages, is_recovered


def read_since(path: Path, topic: str, time_ns: int) -> Generator[list[Entry]]:
    """Yield messages as `Content.messages_since` does; with an index, earlier chunks are not read."""
    with _open_log(path) as content:
        yield from content.messages_since(topic, time_ns)


def read_until(path: Path, last_entry: Entry) -> Generator[list[Entry]]:
    """Yield the messages of each chunk in the order of the file, up to and including `last_entry`."""
    with _open_log(path) as content:
        for _, entries in content.chunks():
            messages: list[Entry] = []
            for entry in entries:
                messages.append(entry)
                if entry == last_entry:
                    yield messages
                    return
            yield messages


@contextmanager
def _open_log(
    path: Path, topic_filter: Callable[[str], bool] | None = None
) -> Generator[Content, None, None]:
    """Open a log; convert errors of its file and its content to a `LogError` of one line."""
    with read_errors(path), open_regular(path) as file:
        try:
            yield Content(file, topic_filter)
        except DecodeError as error:
            # A file that starts like a log is truncated or damaged, and can be recovered.
            file.seek(0)
            is_log = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
            recover_hint = f"; to rescue what is left: {command('recover', path)}"
            create_hint = f"; to make a log: {command('run', '--log', 'run.mcap')}"
            hint = recover_hint if is_log else create_hint
            raise LogError(f"{path}: no whole log: {error}", hint) from None


def _read_label(path: Path, content: Content) -> Label:
    metadata = run_metadata(content.metadata())
    if "robots" not in metadata:
        missing = "it has no metadata record run that names the robots"
        raise LogError(f"{path}: an MCAP file, but no log of khep_twin: {missing}")
    attachments: dict[str, str] = {}
    for attachment in content.attachments():
        try:
            # `recover` saves the readable part of damaged attachments.
            is_damaged = attachment.name.startswith("damaged/")
            text = attachment.data.decode("utf-8", "replace" if is_damaged else "strict")
            attachments[attachment.name] = text
        except UnicodeDecodeError as error:
            invalid = DecodeError(f"byte {attachment.data[error.start]:#04x} at {error.start}", "UTF-8")
            raise invalid.to_log_error(path, attachment.name) from None
    return make_label(path, metadata, attachments)
