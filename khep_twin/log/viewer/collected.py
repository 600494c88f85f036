"""Data for views, collected from a log while rerun reads it."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk, McapReader

from khep_twin.errors import LogError
from khep_twin.log.decoding import body_of, printable
from khep_twin.log.shadow_channels import ALARMS, LINE_TOPICS

Floats = NDArray[np.float64]

TIMELINE = "message_log_time"
"""Name in rerun of the simulated time of a log's messages."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of one robot for its panel.

    Attributes:
        times_ns: Times of the samples (n,) [ns].
        proximity: Counts (n, n_sensors).
        ambient: Counts (n, n_sensors).
        speed: Speeds left, right and further values (n, 2 or more) [pulses/10 ms].
        extra_channels: Channels for the arena: "ultrasonic" [cm] and "leds", as far as the robot has them.
    """

    times_ns: NDArray[np.int64]
    proximity: Floats
    ambient: Floats
    speed: Floats
    extra_channels: Mapping[str, Floats] = field(default_factory=dict[str, Floats])

    def thin(self, step: int) -> "Samples":
        """Return every `step`-th sample."""
        rows = slice(None, None, step)
        extra = {name: values[rows] for name, values in self.extra_channels.items()}
        return Samples(self.times_ns[rows], self.proximity[rows], self.ambient[rows], self.speed[rows], extra)


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses at increasing times (n,) [ns]: x, y, z [m] and quaternion x, y, z, w by body (n, 7)."""

    times_ns: NDArray[np.int64]
    bodies: Mapping[str, Floats]

    def rows_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.intp] | None:
        """Return the rows at these times; None if one is missing."""
        rows = np.searchsorted(self.times_ns, times_ns)
        if len(rows) and (rows[-1] >= len(self.times_ns) or (self.times_ns[rows] != times_ns).any()):
            return None
        return rows


@dataclass(frozen=True, slots=True)
class ShadowSamples:
    """Updates of a shadow.

    Attributes:
        times_ns: Times of the updates (n,) [ns].
        poses: Position [m], quaternion x, y, z, w, and covariance of the estimate (n, 43).
        reckoned: Position [m] and quaternion x, y, z, w by dead reckoning (n, 7).
        expected: Expected proximity (n, n_sensors) [counts].
        measured: Measured proximity (n, n_sensors) [counts].
        residuals: Deviations (n, 2 n_sensors + 3).
        particles_ns: Times of the particles (m,) [ns].
        particles: x, y [m] and heading [rad] of 100 particles (m, 300).
    """

    times_ns: NDArray[np.int64]
    poses: Floats
    reckoned: Floats
    expected: Floats
    measured: Floats
    residuals: Floats
    particles_ns: NDArray[np.int64]
    particles: Floats


_POSE_COLUMNS = ("Transform3D:child_frame", "Transform3D:translation", "Transform3D:quaternion")
_STAMPED_POSE_COLUMNS = ("InstancePoses3D:translations", "InstancePoses3D:quaternions")
_ESTIMATE_COLUMN = "geometry_msgs.msg.PoseWithCovarianceStamped:message"
_PIXEL_COLUMNS = ("Image:buffer", "DepthImage:buffer")
"""Pixels of grey images, which rerun may classify as depth images."""
EXTRA_CHANNELS = ("ultrasonic", "leds")
"""Further channels that are drawn in the arena."""
_SAMPLED_SUFFIXES = tuple(f"/{name}" for name in ("proximity", "ambient", "speed", "vision", *EXTRA_CHANNELS))
_SHADOW_CHANNELS = ("pose", "reckoned", "expected", "measured", "residuals")


class Collector:
    """Collector of samples, poses and events from a log while rerun reads it, to read the log only once.

    Attributes:
        has_old_frames: True if its robots' frames have the names of a log of version 1.0.
    """

    def __init__(self) -> None:
        self.has_old_frames = False
        self._values: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}
        self._poses: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}
        self._texts: dict[str, list[tuple[int, str]]] = {topic: [] for topic in ("/events", *LINE_TOPICS)}

    def collect(self, part: Path, source: Path) -> Iterator[Chunk]:
        """Yield the chunks of `part`, an MCAP file with messages of `source`, and collect their content.

        Raises:
            LogError: rerun cannot parse its messages.
        """
        try:
            for chunk in McapReader(part, timeline_type="duration_ns").stream():
                if not chunk.is_static:
                    self._add(chunk)
                yield chunk
        except RuntimeError as error:  # e.g. a schema that rerun cannot parse
            raise LogError(
                f"{source}: rerun cannot show it: {printable(error)}; expected a log of khep_twin"
            ) from error

    def samples(self, robot: str) -> Samples | None:
        """Return the samples of a robot; None without samples, or if the channels have different times."""
        # A real robot replies to one command at a time.
        columns = self._join_topics(f"/{robot}/{topic}" for topic in ("proximity", "ambient", "speed"))
        if columns is None:
            return None
        values = {name: self._values.get(f"/{robot}/{name}") for name in EXTRA_CHANNELS}
        joined = [(name, *_concat(rows)) for name, rows in values.items() if rows]
        extra = {name: rows for name, times_ns, rows in joined if np.array_equal(times_ns, columns[0])}
        return Samples(*columns, extra_channels=extra)

    def images(self, robot: str) -> tuple[NDArray[np.int64], Floats] | None:
        """Return times (n,) [ns] and line images (n, pixels) of a robot; None if there are none."""
        parts = self._values.get(f"/{robot}/vision")
        return _concat(parts) if parts else None

    def poses(self) -> Poses | None:
        """Return the poses of all bodies; None if there are none."""
        joined = {name: _concat(parts) for name, parts in self._poses.items()}
        if not joined:
            return None
        times_ns = max((times_ns for times_ns, _ in joined.values()), key=len)
        complete = {name: rows for name, (_, rows) in joined.items() if len(rows) == len(times_ns)}
        return Poses(times_ns, complete)

    def lamps(self) -> tuple[NDArray[np.int64], Floats | None]:
        """Return times (n,) [ns] and powers (n, lamps) [W]; None if they never change."""
        parts = self._values.get("/lamps")
        return _concat(parts) if parts else (np.zeros(0, np.int64), None)

    def shadow(self) -> ShadowSamples | None:
        """Return the updates of a shadow; None without updates, or if the channels have different times."""
        columns = self._join_topics(f"/shadow/{topic}" for topic in _SHADOW_CHANNELS)
        if columns is None:
            return None
        times_ns, poses, reckoned, expected, measured, residuals = columns
        particle_parts = self._values.get("/shadow/particles")
        particles = _concat(particle_parts) if particle_parts else (np.zeros(0, np.int64), np.zeros((0, 0)))
        return ShadowSamples(times_ns, poses, reckoned, expected, measured, residuals, *particles)

    def events(self) -> tuple[NDArray[np.int64], list[str]]:
        """Return times [ns] and texts of the events, and of a shadow's alarms."""
        events = sorted(self._texts["/events"] + self._texts[ALARMS], key=lambda event: event[0])
        return np.array([time_ns for time_ns, _ in events], np.int64), [text for _, text in events]

    def texts(self, topic: str) -> list[tuple[int, str]]:
        """Return times [ns] and texts of a shadow's text channel, without the names that rerun adds."""
        lines = [(time_ns, re.sub(r"^\[\w+\] ", "", text)) for time_ns, text in self._texts[topic]]
        return sorted(lines, key=lambda line: line[0])

    def _join_topics(self, topics: Iterable[str]) -> tuple[NDArray[np.int64], *tuple[Floats, ...]] | None:
        """Return times [ns] and the values of each topic; None if a topic is missing or has other times."""
        parts = [self._values.get(topic, []) for topic in topics]
        if not all(parts):
            return None
        (times_ns, first_values), *rest = map(_concat, parts)
        if not all(np.array_equal(times_ns, topic_ns) for topic_ns, _ in rest):
            return None
        return times_ns, first_values, *(values for _, values in rest)

    def _add(self, chunk: Chunk) -> None:
        """Collect the values, texts or poses of a chunk."""
        path = chunk.entity_path
        is_relevant = path in ("/tf", "/lamps", "/events") or path.startswith("/shadow/")
        if not is_relevant and not path.endswith(_SAMPLED_SUFFIXES):
            return
        batch: Any = chunk.to_record_batch()
        names = batch.schema.names

        def column(name: str) -> Any:
            return batch.column(batch.schema.get_field_index(name))

        def poses(names: Sequence[str]) -> Floats:
            values = (column(name).flatten().flatten() for name in names)
            positions, rotations = (array.to_numpy(zero_copy_only=False) for array in values)
            return np.column_stack((positions.reshape(-1, 3), rotations.reshape(-1, 4))).astype(np.float64)

        times_ns = times_of(batch)
        if "Scalars:scalars" in names:
            scalars: Floats = column("Scalars:scalars").flatten().to_numpy(zero_copy_only=False)
            self._values.setdefault(path, []).append((times_ns, scalars.reshape(len(times_ns), -1)))
        elif pixel_names := [name for name in _PIXEL_COLUMNS if name in names]:
            pixels = column(pixel_names[0]).flatten().flatten().to_numpy(zero_copy_only=False)
            self._values.setdefault(path, []).append((times_ns, pixels.reshape(len(times_ns), -1)))
        elif path in self._texts and "TextLog:text" in names:
            texts = column("TextLog:text").flatten().to_pylist()
            self._texts[path] += zip(times_ns.tolist(), texts, strict=True)
        elif _ESTIMATE_COLUMN in names:
            estimates = _poses_with_covariance(column(_ESTIMATE_COLUMN).flatten())
            self._values.setdefault(path, []).append((times_ns, estimates))
        elif path == "/shadow/reckoned" and set(_STAMPED_POSE_COLUMNS) <= set(names):
            self._values.setdefault(path, []).append((times_ns, poses(_STAMPED_POSE_COLUMNS)))
        elif path == "/tf" and set(_POSE_COLUMNS) <= set(names):
            frames = np.array(column(_POSE_COLUMNS[0]).flatten().to_pylist())
            rows = poses(_POSE_COLUMNS[1:])
            for name in dict.fromkeys(frames.tolist()):
                is_frame = frames == name
                self.has_old_frames |= name.endswith("/base")
                body = body_of(name)
                self._poses.setdefault(body, []).append((times_ns[is_frame], rows[is_frame]))


def _poses_with_covariance(messages: Any) -> Floats:
    """Return position, quaternion and covariance (n, 43) of poses in rerun's reflected form."""
    stamped = messages.field("pose")
    pose = stamped.field("pose")
    point, rotation = pose.field("position"), pose.field("orientation")
    columns = [point.field(name) for name in "xyz"] + [rotation.field(name) for name in "xyzw"]
    covariance = stamped.field("covariance").flatten().to_numpy(zero_copy_only=False)
    values = [column.to_numpy(zero_copy_only=False) for column in columns]
    return np.column_stack([*values, covariance.reshape(len(values[0]), -1)]).astype(np.float64)


def times_of(batch: Any) -> NDArray[np.int64]:
    """Return the simulated times of a record batch's rows (n,) [ns]."""
    column = batch.column(batch.schema.get_field_index(TIMELINE))
    return column.to_numpy(zero_copy_only=False).astype(np.int64)


def time_column(times_ns: NDArray[np.int64]) -> rr.TimeColumn:
    """Return the simulated times [ns] of new chunks."""
    return rr.TimeColumn(TIMELINE, duration=times_ns.astype("timedelta64[ns]"))


def _concat(parts: list[tuple[NDArray[np.int64], Floats]]) -> tuple[NDArray[np.int64], Floats]:
    times_ns, values = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return times_ns, values
