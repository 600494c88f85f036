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
from khep_twin.log.decoding import shown
from khep_twin.log.shadow_channels import ALARMS, LINE_TOPICS

Floats = NDArray[np.float64]

TIMELINE = "message_log_time"
"""Name that rerun gives to the simulated time of a log's messages."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of one robot for its panel.

    Attributes:
        times_ns: Times of the samples (n,) [ns].
        proximity: Counts (n, 8).
        ambient: Counts (n, 8).
        speed: Speeds left, right and more (n, 2 and more) [pulses/10 ms].
        more: Channels of a Khepera IV, "ultrasonic" [cm] (n, 5) and "leds" [0 to 63] (n, 9); none of others.
    """

    times_ns: NDArray[np.int64]
    proximity: Floats
    ambient: Floats
    speed: Floats
    more: Mapping[str, Floats] = field(default_factory=dict[str, Floats])

    def thinned(self, every: int) -> "Samples":
        """Return every `every`-th sample."""
        some = slice(None, None, every)
        more = {name: values[some] for name, values in self.more.items()}
        return Samples(self.times_ns[some], self.proximity[some], self.ambient[some], self.speed[some], more)


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses at rising times (n,) [ns]: x, y, z [m], quaternions x, y, z, w by body (n, 7)."""

    times_ns: NDArray[np.int64]
    bodies: Mapping[str, Floats]

    def rows_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.intp] | None:
        """Return the rows at these times; None if a time has none."""
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
        reckoned: Position [m] and quaternion x, y, z, w by commands alone (n, 7).
        expected: Expected proximity (n, 8) [counts].
        measured: Measured proximity (n, 8) [counts].
        residuals: Deviations (n, 19).
        particles_ns: Times of the particles (m,) [ns].
        particles: x, y [m] and heading [rad] of each (m, 300).
    """

    times_ns: NDArray[np.int64]
    poses: Floats
    reckoned: Floats
    expected: Floats
    measured: Floats
    residuals: Floats
    particles_ns: NDArray[np.int64]
    particles: Floats


_POSE = ("Transform3D:child_frame", "Transform3D:translation", "Transform3D:quaternion")
_STAMPED = ("InstancePoses3D:translations", "InstancePoses3D:quaternions")
_UNSURE = "geometry_msgs.msg.PoseWithCovarianceStamped:message"
_PIXELS = ("Image:buffer", "DepthImage:buffer")
"""Pixels of grey images, which rerun takes for distances, too."""
MORE = ("ultrasonic", "leds")
"""Channels of a Khepera IV that are drawn in the arena."""
_SAMPLED = tuple(f"/{name}" for name in ("proximity", "ambient", "speed", "vision", *MORE))
_SHADOW = ("pose", "reckoned", "expected", "measured", "residuals")


class Collector:
    """Collector of samples, poses and events from a log while rerun reads it; reading twice takes longer."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}
        self._poses: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}
        self._texts: dict[str, list[tuple[int, str]]] = {each: [] for each in ("/events", *LINE_TOPICS)}

    def passing(self, log: Path, source: Path) -> Iterator[Chunk]:
        """Pass on the chunks of a log, the copy of a source, and note their content.

        Raises:
            LogError: rerun does not understand its messages.
        """
        try:
            for chunk in McapReader(log, timeline_type="duration_ns").stream():
                if not chunk.is_static:
                    self._note(chunk)
                yield chunk
        except RuntimeError as error:  # such as a schema that rerun cannot parse
            raise LogError(
                f"{source}: rerun cannot show it: {shown(error)}; expected a log of khep_twin"
            ) from error

    def samples(self, robot: str) -> Samples | None:
        """Return the samples of a robot; None if there are none, or not for each time."""
        # A real robot answers one by one.
        found = self._together(f"/{robot}/{topic}" for topic in ("proximity", "ambient", "speed"))
        if found is None:
            return None
        names = MORE if f"/{robot}/ultrasonic" in self._rows else ()
        own = {name: _joined(parts) for name in names if (parts := self._rows.get(f"/{robot}/{name}"))}
        more = {name: values for name, (own_ns, values) in own.items() if np.array_equal(own_ns, found[0])}
        return Samples(*found, more=more)

    def images(self, robot: str) -> tuple[NDArray[np.int64], Floats] | None:
        """Return times (n,) [ns] and line images (n, pixels) of a robot that sees; None if there are none."""
        parts = self._rows.get(f"/{robot}/vision")
        return _joined(parts) if parts else None

    def poses(self) -> Poses | None:
        """Return the poses of all bodies; None if there are none."""
        found = {name: _joined(parts) for name, parts in self._poses.items()}
        if not found:
            return None
        times_ns = max((times_ns for times_ns, _ in found.values()), key=len)
        whole = {name: rows for name, (_, rows) in found.items() if len(rows) == len(times_ns)}
        return Poses(times_ns, whole)

    def lamps(self) -> tuple[NDArray[np.int64], Floats | None]:
        """Return times (n,) [ns] and powers (n, lamps) [W]; None if they never change."""
        parts = self._rows.get("/lamps")
        return _joined(parts) if parts else (np.zeros(0, np.int64), None)

    def shadow(self) -> ShadowSamples | None:
        """Return the updates of a shadow; None if there are none, or not for each time."""
        found = self._together(f"/shadow/{topic}" for topic in _SHADOW)
        if found is None:
            return None
        times_ns, poses, reckoned, expected, measured, residuals = found
        seldom = self._rows.get("/shadow/particles")
        particles = _joined(seldom) if seldom else (np.zeros(0, np.int64), np.zeros((0, 0)))
        return ShadowSamples(times_ns, poses, reckoned, expected, measured, residuals, *particles)

    def events(self) -> tuple[NDArray[np.int64], list[str]]:
        """Return times [ns] and texts of the events, and of a shadow's alarms."""
        found = sorted(self._texts["/events"] + self._texts[ALARMS], key=lambda event: event[0])
        return np.array([time_ns for time_ns, _ in found], np.int64), [text for _, text in found]

    def texts(self, topic: str) -> list[tuple[int, str]]:
        """Return times [ns] and texts of a shadow's channel of lines, without the names that rerun adds."""
        found = [(time_ns, re.sub(r"^\[\w+\] ", "", text)) for time_ns, text in self._texts[topic]]
        return sorted(found, key=lambda line: line[0])

    def _together(self, topics: Iterable[str]) -> tuple[NDArray[np.int64], *tuple[Floats, ...]] | None:
        """Return times [ns] and the values of each topic; None if there are none, or not for each time."""
        parts = [self._rows.get(topic, []) for topic in topics]
        if not all(parts):
            return None
        (times_ns, first), *others = map(_joined, parts)
        if not all(np.array_equal(times_ns, own_ns) for own_ns, _ in others):
            return None
        return times_ns, first, *(values for _, values in others)

    def _note(self, chunk: Chunk) -> None:
        path = chunk.entity_path
        known = path in ("/tf", "/lamps", "/events") or path.startswith("/shadow/")
        if not known and not path.endswith(_SAMPLED):
            return
        batch: Any = chunk.to_record_batch()
        names = batch.schema.names

        def column(name: str) -> Any:
            return batch.column(batch.schema.get_field_index(name))

        def poses(names: Sequence[str]) -> Floats:
            values = (column(name).flatten().flatten() for name in names)
            place, turn = (each.to_numpy(zero_copy_only=False) for each in values)
            return np.column_stack((place.reshape(-1, 3), turn.reshape(-1, 4))).astype(np.float64)

        at = times_of(batch)
        if "Scalars:scalars" in names:
            scalars: Floats = column("Scalars:scalars").flatten().to_numpy(zero_copy_only=False)
            self._rows.setdefault(path, []).append((at, scalars.reshape(len(at), -1)))
        elif found := [name for name in _PIXELS if name in names]:
            pixels = column(found[0]).flatten().flatten().to_numpy(zero_copy_only=False)
            self._rows.setdefault(path, []).append((at, pixels.reshape(len(at), -1)))
        elif path in self._texts and "TextLog:text" in names:
            self._texts[path] += zip(at.tolist(), column("TextLog:text").flatten().to_pylist(), strict=True)
        elif _UNSURE in names:
            self._rows.setdefault(path, []).append((at, _unsure(column(_UNSURE).flatten())))
        elif path == "/shadow/reckoned" and set(_STAMPED) <= set(names):
            self._rows.setdefault(path, []).append((at, poses(_STAMPED)))
        elif path == "/tf" and set(_POSE) <= set(names):
            frames = np.array(column(_POSE[0]).flatten().to_pylist())
            rows = poses(_POSE[1:])
            for name in dict.fromkeys(frames.tolist()):
                own = frames == name
                self._poses.setdefault(name, []).append((at[own], rows[own]))


def _unsure(messages: Any) -> Floats:
    """Return position, quaternion and covariance (n, 43) of poses, as rerun reflects them."""
    found = messages.field("pose")
    pose = found.field("pose")
    point, turn = pose.field("position"), pose.field("orientation")
    columns = [point.field(name) for name in "xyz"] + [turn.field(name) for name in "xyzw"]
    covariance = found.field("covariance").flatten().to_numpy(zero_copy_only=False)
    values = [each.to_numpy(zero_copy_only=False) for each in columns]
    return np.column_stack([*values, covariance.reshape(len(values[0]), -1)]).astype(np.float64)


def times_of(batch: Any) -> NDArray[np.int64]:
    """Return the simulated times of a record batch's rows (n,) [ns]."""
    column = batch.column(batch.schema.get_field_index(TIMELINE))
    return column.to_numpy(zero_copy_only=False).astype(np.int64)


def time_column(times_ns: NDArray[np.int64]) -> rr.TimeColumn:
    """Return the simulated times [ns] of new chunks."""
    return rr.TimeColumn(TIMELINE, duration=times_ns.astype("timedelta64[ns]"))


def _joined(parts: list[tuple[NDArray[np.int64], Floats]]) -> tuple[NDArray[np.int64], Floats]:
    times_ns, values = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return times_ns, values
