"""Content of a log for its page: what is drawn, and the samples that the eye needs.

Samples are thinned as for rerun, but those at events and at the starts of contacts are all kept, so that they
show the exact values. A log without poses, of a real robot, has curves and its transcript only.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import gc
import shlex
from collections import ChainMap
from collections.abc import Iterable, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import installed_turrets
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.log.attached import calibration_of, compile_shapes, playpen_of
from khep_twin.log.channels import LINES, TRANSFORMS, TextLine
from khep_twin.log.decoding import DecodeError, body_of
from khep_twin.log.description import led_positions
from khep_twin.log.entries import Entry, Label
from khep_twin.log.mcap_recovery import Progress
from khep_twin.log.messages import NUMERIC_DECODERS, Messages
from khep_twin.log.reader import read_end_ns, read_entry_batches, read_first_messages
from khep_twin.log.robot_models import models_of
from khep_twin.log.shadow_channels import ALARMS, REGION_SIGMAS, STATE, STATE_COLOURS, is_shadow
from khep_twin.log.shadow_track import read_shadow
from khep_twin.log.transforms import read_frames, relative, world_poses
from khep_twin.log.viewer.thinning import sample_interval_ns
from khep_twin.observers import SAMPLE_NS
from khep_twin.playpen import Playpen
from khep_twin.robots.model import RobotModel, robot_name
from khep_twin.sensing import colours
from khep_twin.web import drafts
from khep_twin.web.messages import EXTRA_CHANNELS
from khep_twin.web.packing import Series, pack, thin
from khep_twin.web.robot_shape import robot_shape
from khep_twin.web.run_scene import describe_replay
from khep_twin.web.scene import start_parts

_MAX_SAMPLES = 400_000
"""Maximum number of samples of a page, over all robots."""

_MAX_LINES = 80_000
"""Maximum number of lines of the transcripts of a page; of more, one exchange per interval is shown."""

_ROW_NS = 100_000_000
"""Interval of the line images, as shown in a strip [ns]."""

_CHANNELS = ("proximity", "ambient", "speed", "leds", "vision", *EXTRA_CHANNELS)
_POSE_SCALE, _TURN_SCALE = 10_000, 32_767
"""Units of packed poses: 0.1 mm, and those of a quaternion in 16 bits."""

_UNSET = ("None", "()")

Floats = NDArray[np.float64]


class RunContent:
    """Content of one log, read in batches.

    Args:
        path: Path of a finished log.
        name: Name on the page.
        progress: Function that takes the fraction read.

    Raises:
        LogError: The log cannot be read, or has nothing to show.
    """

    def __init__(self, path: Path, name: str, progress: Progress = None) -> None:
        first = read_first_messages(path)
        self._path = path
        self._label = label = first.label
        self._end_ns = read_end_ns(path)
        self._is_shadow = is_shadow(label)
        self._models = models_of(label.attachments, label.robots, first.series)
        has_poses = any(f"/{robot}/pose" in first.series for robot in label.robots)
        self._playpen: Playpen | None = None
        self._scene: dict[str, Any] | None = None
        if has_poses:
            self._playpen = playpen_of(label.attachments, path)
            self._model = compile_shapes(label.attachments, label.robots, path)
        self._rows: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}
        self._lines: list[tuple[str, TextLine]] = []
        self._texts: dict[str, list[str]] = {robot: [] for robot in label.robots}
        self._touching: dict[str, list[tuple[NDArray[np.int64], NDArray[np.bool_]]]] = {}
        duration_ns = self._end_ns * len(label.robots)
        self._interval_ns = sample_interval_ns(duration_ns, _MAX_SAMPLES)
        # A robot that is polled as fast as the line allows has a hundred lines per second.
        line_ns = 2 * duration_ns // _MAX_LINES
        self._line_ns = line_ns if line_ns > SAMPLE_NS else 0
        # Searches for unreachable objects among millions of messages would take a fifth of the time.
        is_collecting = gc.isenabled()
        gc.disable()
        try:
            for _, entries in read_entry_batches(path, progress, self._shows):
                self._add(entries)
        finally:
            if is_collecting:
                gc.enable()
        if self._is_shadow:
            self._add_shadow()
        if not self._rows and not any(self._texts.values()):
            raise LogError(f"{path}: no poses, readings or lines; expected a log with one of them")
        self._name = name

    def pack(self) -> bytes:
        """Return the content in packed form."""
        label = self._label
        series = {topic: self._series(topic, parts) for topic, parts in self._rows.items()}
        playpen = self._playpen
        header = {
            "name": self._name,
            "end": self._end_ns / NS_PER_S,
            "draft": None if playpen is None else drafts.draft_of(playpen),
            "scene": self._scene,
            "robots": [self._robot(name, model) for name, model in self._models.items()],
            "surfaces": drafts.surfaces(),
            "turrets": self._turrets(),
            "colours": {
                "sensors": dict(
                    ChainMap(*(colours.sensor_colours(model.body) for model in self._models.values()))
                ),
                "wheels": colours.WHEELS,
            },
            "events": [
                [line.time_ns / NS_PER_S, line.name, line.text, topic, line.level]
                for topic, line in sorted(self._lines, key=lambda row: row[1].time_ns)
            ],
            "contacts": self._contacts(),
            "texts": self._texts,
            "states": {str(state): colour for state, colour in STATE_COLOURS.items()},
            "interval": self._interval_ns / NS_PER_S,
            "lineInterval": self._line_ns / NS_PER_S,
            "origin": origin(label, self._path),
            "sources": {
                name: text for name, text in label.attachments.items() if name.startswith("controller/")
            },
        }
        return pack(header, series)

    def _shows(self, topic: str) -> bool:
        """Return whether a topic is read."""
        channel = topic.rpartition("/")[2]
        return channel in (*_CHANNELS, "serial") or topic in ("/tf", "/lamps", "/events", ALARMS, STATE)

    def _add(self, entries: Iterable[Entry]) -> None:
        """Add a batch of messages."""
        by_topic: dict[str, list[Entry]] = {}
        for entry in entries:
            by_topic.setdefault(entry.topic, []).append(entry)
        for group in by_topic.values():
            group.sort(key=attrgetter("time_ns"))
        lines = {
            topic: Messages(self._path, by_topic[topic]).lines(topic)
            for topic in ("/events", ALARMS, STATE)
            if topic in by_topic
        }
        self._lines += [(topic, line) for topic, group in lines.items() for line in group]
        events_ns = [line.time_ns for group in lines.values() for line in group]
        contacts_ns = self._add_poses(by_topic.get("/tf", []), events_ns)
        for robot in self._label.robots:
            marks_ns = [*events_ns, *contacts_ns.get(robot, ())]
            for channel in _CHANNELS:
                interval_ns = max(self._interval_ns, _ROW_NS) if channel == "vision" else self._interval_ns
                self._add_series(f"/{robot}/{channel}", by_topic, interval_ns, marks_ns)
            self._add_transcript(robot, by_topic.get(f"/{robot}/serial", []))
        self._add_series("/lamps", by_topic, self._interval_ns, events_ns)

    def _add_series(
        self, topic: str, by_topic: Mapping[str, list[Entry]], interval_ns: int, marks_ns: list[int]
    ) -> None:
        entries = [entry for entry in by_topic.get(topic, []) if entry.schema in NUMERIC_DECODERS]
        if not entries:
            return
        rows = thin(np.array([entry.time_ns for entry in entries]), interval_ns, marks_ns)
        for series in Messages(self._path, [entries[row] for row in rows.tolist()]).series().values():
            self._add_rows(topic, series.times_ns, series.values.astype(np.float64))

    def _add_rows(self, topic: str, times_ns: NDArray[np.int64], values: Floats) -> None:
        parts = self._rows.setdefault(topic, [])
        if parts and parts[0][1].shape[1] != values.shape[1]:
            error = DecodeError(f"{values.shape[1]} values", f"{parts[0][1].shape[1]}, as before")
            raise error.to_log_error(self._path, topic, int(times_ns[0]))
        is_finite = np.isfinite(values).all(axis=1)
        parts.append((times_ns[is_finite], values[is_finite]))

    def _add_transcript(self, robot: str, entries: list[Entry]) -> None:
        """Add lines of a transcript; of a long log, a command and its reply per interval."""
        topic = f"/{robot}/serial"
        entries = [entry for entry in entries if entry.schema == LINES]
        if self._line_ns and entries:
            rows = thin(np.array([entry.time_ns for entry in entries]), self._line_ns, ())
            entries = [entries[row] for row in np.unique([rows, np.minimum(rows + 1, len(entries) - 1)])]
        lines = Messages(self._path, entries).lines(topic)
        if lines:
            times_ns = np.array([line.time_ns for line in lines])
            is_reply = np.array([[float(line.name != "host")] for line in lines])
            self._add_rows(topic, times_ns, is_reply)
            self._texts[robot] += [line.text for line in lines]

    def _add_poses(self, entries: list[Entry], events_ns: list[int]) -> dict[str, list[int]]:
        """Add the poses of a batch; return the starts of the robots' contacts [ns]."""
        entries = [entry for entry in entries if entry.schema == TRANSFORMS]
        if self._playpen is None or not entries:
            return {}
        times_ns = np.array([entry.time_ns for entry in entries], np.int64)
        messages = [entry.data for entry in entries]
        try:
            if self._scene is None:
                bodies = {body_of(frame) for _, frame in read_frames(messages[0])}
                self._scene = describe_replay(self._model, bodies)
            names = self._scene["bodies"]
            poses = world_poses(messages, names)
        except DecodeError as error:
            raise error.to_log_error(self._path, "/tf", int(times_ns[error.row])) from None
        contacts_ns: dict[str, list[int]] = {}
        for robot, model in self._models.items():
            base = poses.get(f"{robot}/base")
            if base is None:
                raise LogError(f"{self._path}: /tf: no pose of {robot}; expected it in each message")
            if not self._is_shadow:
                clearance = statistics.clearance(base[:, :2], self._playpen) - model.body.radius
                is_touching = clearance < statistics.CONTACT_DISTANCE
                self._touching.setdefault(robot, []).append((times_ns, is_touching))
                starts = np.flatnonzero(np.diff(is_touching.astype(int), prepend=0) > 0)
                contacts_ns[robot] = times_ns[starts].tolist()
        marks_ns = {*events_ns, *(mark for marks in contacts_ns.values() for mark in marks)}
        rows = thin(times_ns, self._interval_ns, sorted(marks_ns))
        missing = [name for name in names if name not in poses]
        if missing:
            raise LogError(f"{self._path}: /tf: no pose of {missing[0]}; expected it, as at the start")
        body_poses = {name: poses[name][rows] for name in names}
        for name, parent in zip(names, self._scene["parents"], strict=True):
            if parent is not None:
                body_poses[name] = relative(body_poses[name], poses[names[parent]][rows])
        units = np.array([_POSE_SCALE] * 3 + [_TURN_SCALE] * 4)
        columns = [pose[:, [0, 1, 2, 6, 3, 4, 5]] * units for pose in body_poses.values()]
        self._add_rows("bodies", times_ns[rows], np.hstack(columns))
        return contacts_ns

    def _add_shadow(self) -> None:
        """Add a shadow's region, and the replies as the robot's readings."""
        track, robot = read_shadow(self._path), self._label.robots[0]
        rows = thin(track.times_ns, self._interval_ns, ())
        times_ns, values = track.times_ns[rows], track.covariance[rows, :2, :2]
        if len(rows):
            variances, axes = np.linalg.eigh(values)
            halves = 1e3 * REGION_SIGMAS * np.sqrt(np.maximum(variances, 0))
            angles = np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
            position = 1e3 * track.pose[rows, :2]
            self._add_rows("region", times_ns, np.column_stack([position, halves[:, ::-1], angles]))
            self._add_rows(f"/{robot}/proximity", times_ns, track.measured[rows])

    def _series(self, topic: str, parts: list[tuple[NDArray[np.int64], Floats]]) -> Series:
        times_ns, values = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        is_whole = topic == "bodies" or bool((values == np.rint(values)).all())
        return Series(times_ns, values, 1 if is_whole else 1000)

    def _robot(self, name: str, model: RobotModel) -> dict[str, object]:
        """Return a robot as the messages of the designer describe it."""
        calibration = calibration_of(self._label.attachments, name, self._path)
        headings = None if calibration is None else calibration.heading_deg
        robot: dict[str, object] = {
            "name": name,
            **robot_shape(model, model.calibration, headings),
            "sensor_height_mm": 1e3 * model.body.sensor_height,
        }
        if self._playpen is None or self._scene is None:
            return robot
        entries = {robot_name(index): entry for index, entry in enumerate(self._playpen.robots)}
        leds = (1e3 * led_positions(self._model, name)[:, :2]).round(2).tolist()
        return {**robot, "leds_mm": leds, "turrets": entries[name].turrets if name in entries else ()}

    def _turrets(self) -> dict[str, object]:
        names = (
            {turret for robot in self._playpen.robots for turret in robot.turrets} if self._playpen else ()
        )
        return {name: {"parts": start_parts(name)} for name in sorted(names) if name in installed_turrets()}

    def _contacts(self) -> list[list[object]]:
        """Return robot, start and end [s] of each contact with walls and fixed objects, in order of time."""
        contacts: list[tuple[float, float, str]] = []
        for robot, parts in self._touching.items():
            times_ns, is_touching = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            gap_s = statistics.SAME_CONTACT_S
            intervals = statistics.find_intervals(times_ns / NS_PER_S, is_touching, gap_s)
            contacts += [(start, end, robot) for start, end in intervals.times_s.tolist()]
        return [[robot, start, end] for start, end, robot in sorted(contacts)]


def origin(label: Label, path: Path) -> dict[str, str]:
    """Return what made a log: playpen, controller, seed and versions, and the command that repeats it."""
    facts = {key.replace("_", " "): text for key, text in label.metadata.items() if text not in _UNSET}
    if not {"relay", "shadow", "line"} & label.metadata.keys():
        facts["repeat it"] = f"khep-twin repeat {shlex.quote(path.name)}"
    return facts
