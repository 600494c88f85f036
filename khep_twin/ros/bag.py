"""Export of a log as a bag of rosbag2: a folder with a file of MCAP and its metadata.yaml.

It has the log's messages except those that only a repetition needs (`log.messages.REPEAT_CHANNELS`), standard
messages of each robot (`ros.standard`), /clock, one tree of frames (`ros.transforms`) and a description with
joints. Odometry, joints and images have the log's rate. Other standard messages repeat raw channels, and have
a lower rate.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from khep_twin import __version__
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import resolve
from khep_twin.files.folders import atomic_folder
from khep_twin.log.attached import calibration_of, compile_shapes
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.cdr import Frame, encode
from khep_twin.log.channels import SCENE, STRING, TRANSFORMS, TextLine, text_message
from khep_twin.log.decoding import DecodeError, decode
from khep_twin.log.entries import Entry, Label
from khep_twin.log.foxglove_scene import scene_update
from khep_twin.log.frames import MovingBodies
from khep_twin.log.message_types import SCHEMAS, MessageFields, type_hash
from khep_twin.log.messages import TimeSeries, is_repeat_channel
from khep_twin.log.qos import qos_of
from khep_twin.log.reader import Recording, read_label, read_message_batches
from khep_twin.log.robot_models import models_of
from khep_twin.log.shadow_channels import is_shadow
from khep_twin.robots.model import RobotModel
from khep_twin.ros.robot_description import redraw, robot_description
from khep_twin.ros.standard import CLOCK, StandardMessages, StandardRows, transform_fields
from khep_twin.ros.transforms import Reckoned, odometry_trees
from khep_twin.sensing import calibration as calibrations

RATE_HZ = 10.0
"""Usual rate of distances, light, motion sensors and battery."""

METADATA = "metadata.yaml"

_VERSION = 8
"""Version of the metadata, the last with quality of service as text, which Humble and Iron need."""

_WINDOW_NS = 2 * NS_PER_S
"""Time in a chunk, within which players sort the messages."""

_FULL_RATE = ("registers", "position", "vision")
_LOWER_RATE = ("proximity", "ambient", "ultrasonic", "accelerometer", "gyroscope", "battery")

Times = NDArray[np.int64]
Part = tuple[str, str, str, Times, NDArray[np.void] | list[bytes]]
"""Messages of a topic: topic, type, definition, times [ns], and rows of bytes or messages of any size."""


def write_bag(
    log: Path,
    folder: Path,
    rate_hz: float = RATE_HZ,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> tuple[int, int]:
    """Write a log as a bag; return the numbers of its topics and messages.

    Args:
        log: Path of a finished log.
        folder: Folder of the bag, made with all its files or not at all.
        rate_hz: Largest rate of the standard messages that repeat raw channels [Hz].
        force: Whether an existing bag is replaced.
        progress: Function that takes the finished share, 0 to 1.

    Raises:
        KhepTwinError: The log is invalid, or the folder cannot be written, or is something else than a bag.
    """
    check_new_bag(folder, log, force)
    bag = _Bag(log, read_label(log), rate_hz)
    name = f"{folder.absolute().name}.mcap"
    try:
        with atomic_folder(folder, force) as part:
            with (part / name).open("wb") as file:
                writer = BatchWriter(file, "ros2", f"khep_twin {__version__}")
                bag.write(writer, progress)
            (part / METADATA).write_text(bag.metadata(name), encoding="utf-8")
    except OSError as error:
        raise LogError(f"{folder}: cannot be written: {error.strerror}") from error
    return len(bag.topics), sum(count for _, count in bag.topics.values())


def check_new_bag(folder: Path, log: Path, force: bool) -> None:
    """Refuse a folder that exists, except with `force` another bag than that of the log."""
    if not folder.exists() and not folder.is_symlink():
        return
    if not force:
        raise LogError(f"{folder}: is there already; expected another name, or --force to replace it")
    if not (folder / METADATA).is_file():
        raise LogError(f"{folder}: is no bag; expected a new name, or that of a bag to replace")
    if resolve(folder) in resolve(log).parents:
        raise LogError(f"{folder}: has the log; expected another folder")


class _Bag:
    """Messages of a log as a bag, in order of time.

    Attributes:
        topics: Type and number of messages of each topic.
    """

    def __init__(self, log: Path, label: Label, rate_hz: float) -> None:
        self._log, self._label = log, label
        self._period_ns = NS_PER_S / rate_hz
        self.topics: dict[str, tuple[str, int]] = {}
        self._range_ns: tuple[int, int] | None = None
        self._robots: dict[str, StandardMessages] = {}
        self._models: dict[str, RobotModel] = {}
        self._odometry: dict[str, Reckoned] = {}
        self._last_ticks: dict[tuple[str, ...], int] = {}
        has_scene = "scene.xml" in label.attachments
        self._scene = compile_shapes(label.attachments, label.robots, log) if has_scene else None
        self._urdf = ""
        self._is_real = not has_scene or is_shadow(label)
        self._clock = Frame(CLOCK, {}, ["clock"])

    def write(self, writer: BatchWriter, progress: Callable[[float], None] | None) -> None:
        """Write all messages."""
        for name, text in self._label.attachments.items():
            writer.attach(name, text)
        # Another name than that of a log's facts: the file has other frames, and is no log any more.
        writer.describe("exported_run", self._label.metadata)
        is_first = True
        for recording, entries in read_message_batches(self._log, progress):
            if is_first:
                self._start(entries)
                self._write(writer, self._description())
            is_first = False
            try:
                self._write(writer, [*self._copies(entries), *self._derived(recording, entries)])
            except DecodeError as error:
                raise error.to_log_error(self._log, "/tf") from None
        writer.finish()

    def metadata(self, file_name: str) -> str:
        """Return the content of metadata.yaml, as JSON, which is a part of YAML."""
        start_ns, end_ns = self._range_ns or (0, 0)
        times = {
            "duration": {"nanoseconds": end_ns - start_ns},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": sum(count for _, count in self.topics.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": qos_of(topic).rosbag2_text(),
                    "type_description_hash": type_hash(type_name) if type_name in SCHEMAS else "",
                },
                "message_count": count,
            }
            for topic, (type_name, count) in self.topics.items()
        ]
        information = {
            "version": _VERSION,
            "storage_identifier": "mcap",
            **times,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file_name],
            "files": [{"path": file_name, **times}],
            "custom_data": None,
            "ros_distro": "",
        }
        return json.dumps({"rosbag2_bagfile_information": information}, indent=2) + "\n"

    def _start(self, entries: Iterable[Entry]) -> None:
        """Prepare the standard messages of each robot, by the log's first messages."""
        attachments, robots = self._label.attachments, self._label.robots
        self._models = models_of(attachments, robots, {entry.topic for entry in entries})
        for robot, model in self._models.items():
            measured = calibration_of(attachments, robot, self._log)
            usual = measured or calibrations.read_for(model.calibration, model)
            self._robots[robot] = StandardMessages(model, usual, robot)

    def _description(self) -> Iterator[Part]:
        """Yield the messages at the start: frames of the bodies fixed on robots, and the scene."""
        static = b"" if self._scene is None else MovingBodies(self._scene).static_message
        yield _one("/tf_static", TRANSFORMS, 0, self._static_message(static))
        if self._scene is not None:
            sensors = [frame for robot in self._robots.values() for frame in robot.static_transforms()]
            self._urdf = robot_description(self._scene, sensors)
            yield _one("/robot_description", STRING, 0, text_message(self._urdf))
            yield _one("/scene", SCENE, 0, scene_update(self._scene))

    def _static_message(self, message: bytes) -> bytes:
        """Return a message of /tf_static with the frames of sensors: late subscribers receive one only."""
        transforms: list[MessageFields] = decode(TRANSFORMS, message)["transforms"] if message else []
        for transform in transforms:
            transform["header"]["stamp"] = 0
        for robot in self._robots.values():
            transforms += map(transform_fields, robot.static_transforms())
        return encode(TRANSFORMS, {"transforms": transforms})

    def _copies(self, entries: Iterable[Entry]) -> Iterator[Part]:
        """Yield messages as they are; those of later scenes get the frames and joints of the first."""
        images = {f"/{robot}/vision" for robot in self._label.robots}
        groups: dict[tuple[str, str, str], list[Entry]] = {}
        for entry in entries:
            is_start = entry.time_ns == 0 and entry.topic in ("/robot_description", "/scene", "/tf_static")
            is_replaced = (
                entry.topic == "/tf" or entry.topic in images or (is_start and self._scene is not None)
            )
            if entry.definition is None or is_replaced or is_repeat_channel(entry.topic):
                continue
            groups.setdefault((entry.topic, entry.schema, entry.definition), []).append(entry)
        for (topic, schema, definition), messages in groups.items():
            messages.sort(key=lambda entry: entry.time_ns)
            data = [entry.data for entry in messages]
            if topic == "/tf_static":
                data = [self._static_message(message) for message in data]
            elif topic == "/robot_description" and self._urdf:
                data = [self._later_description(message) for message in data]
            yield topic, schema, SCHEMAS.get(schema, definition), _times(messages), data

    def _later_description(self, message: bytes) -> bytes:
        """Return a description of a changed scene, with the joints and sensors of the first."""
        try:
            return text_message(redraw(self._urdf, decode(STRING, message)["data"]))
        except ElementTree.ParseError as error:
            raise LogError(f"{self._log}: /robot_description: no URDF: {error}") from error

    def _derived(self, recording: Recording, entries: Iterable[Entry]) -> Iterator[Part]:
        """Yield standard messages, frames and clock."""
        transforms = [entry for entry in entries if entry.topic == "/tf" and entry.time_ns > 0]
        transforms.sort(key=lambda entry: entry.time_ns)
        for robot, standard in self._robots.items():
            prefix = f"/{robot}/"
            channels = {
                topic.removeprefix(prefix): series
                for topic, series in recording.series.items()
                if topic.startswith(prefix)
            }
            if "registers" not in channels and "position" not in channels:
                channels |= self._replied_counts(robot, recording.lines.get(f"{prefix}serial", []))
            for rows in self._standard(standard, channels):
                if rows.topic == "/tf" and transforms:
                    self._odometry[robot] = Reckoned(rows.times_ns, rows.messages["transforms.0.transform"])
                elif len(rows.times_ns):
                    yield rows.topic, rows.type_name, SCHEMAS[rows.type_name], rows.times_ns, rows.messages
        times_ns, messages = _times(transforms), [entry.data for entry in transforms]
        for group_ns, rows in odometry_trees(times_ns, messages, self._odometry):
            yield "/tf", TRANSFORMS, SCHEMAS[TRANSFORMS], group_ns, rows
        if len(times_ns) and not self._is_real:
            yield "/clock", CLOCK, SCHEMAS[CLOCK], times_ns, self._clock.messages({"clock": times_ns})

    def _standard(
        self, standard: StandardMessages, channels: Mapping[str, TimeSeries]
    ) -> Iterator[StandardRows]:
        """Yield the standard messages of a robot's channels, those of the lower rate by their times."""
        for name in _FULL_RATE:
            if name in channels and not (name == "registers" and "position" in channels):
                yield from standard.messages(channels[name].times_ns, {name: channels[name].values})
        groups: dict[bytes, list[str]] = {}
        for name in _LOWER_RATE:
            if name in channels:
                groups.setdefault(channels[name].times_ns.tobytes(), []).append(name)
        for names in groups.values():
            times_ns = channels[names[0]].times_ns
            ticks = times_ns // int(self._period_ns)
            last_tick = self._last_ticks.get(tuple(names), -1)
            is_kept = np.diff(ticks, prepend=last_tick) > 0
            self._last_ticks[tuple(names)] = int(ticks[-1])
            values = {name: channels[name].values[is_kept] for name in names}
            yield from standard.messages(times_ns[is_kept], values)

    def _replied_counts(self, robot: str, lines: list[TextLine]) -> dict[str, TimeSeries]:
        """Return the wheels' counts in the replies of a real robot, if there are any."""
        dialect = self._models[robot].dialect
        if (read := dialect.reads.get("position")) is None:
            return {}
        counts: list[tuple[int, list[int]]] = []
        for line in lines:
            if line.name == "host" or not dialect.framing.answers(read.request, line.text):
                continue
            try:
                values = dialect.framing.values(line.text)
            except ValueError:  # noise on the line
                continue
            if len(values) == read.n_values:
                counts.append((line.time_ns, [values[index] for index in read.values]))
        if not counts:
            return {}
        times_ns, rows = zip(*counts, strict=True)
        return {"position": TimeSeries(np.array(times_ns, np.int64), np.array(rows, np.int64))}

    def _write(self, writer: BatchWriter, parts: Iterable[Part]) -> None:
        """Write messages in chunks of one window of time."""
        windows: dict[int, list[Part]] = {}
        for topic, type_name, definition, times_ns, messages in parts:
            if not len(times_ns):
                continue
            count = self.topics.get(topic, ("", 0))[1] + len(times_ns)
            self.topics[topic] = type_name, count
            first_ns, last_ns = int(times_ns[0]), int(times_ns[-1])
            start_ns, end_ns = self._range_ns or (first_ns, last_ns)
            self._range_ns = min(start_ns, first_ns), max(end_ns, last_ns)
            numbers, starts = np.unique(times_ns // _WINDOW_NS, return_index=True)
            for number, start, end in zip(
                numbers.tolist(), starts.tolist(), [*starts[1:].tolist(), len(times_ns)], strict=True
            ):
                part = topic, type_name, definition, times_ns[start:end], messages[start:end]
                windows.setdefault(number, []).append(part)
        for _, window in sorted(windows.items()):
            for topic, type_name, definition, times_ns, messages in window:
                channel = writer.channel(topic, type_name, definition)
                if isinstance(messages, list):
                    writer.add_lines(channel, times_ns.tolist(), messages)
                else:
                    writer.add_rows(channel, times_ns, messages)
            writer.flush()


def _one(topic: str, type_name: str, time_ns: int, message: bytes) -> Part:
    return topic, type_name, SCHEMAS[type_name], np.array([time_ns]), [message]


def _times(entries: Iterable[Entry]) -> Times:
    return np.array([entry.time_ns for entry in entries], np.int64)
