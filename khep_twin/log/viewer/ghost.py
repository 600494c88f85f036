"""Additions to the views of a shadow's log: region, particles, dead reckoning, rays, curves, the truth.

The robot itself is drawn at the estimate, which the log has as /tf. A ray ends where a facing white wall
would give the reading, by the log's calibration: one ray for the expected reading, one for the measured.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.errors import LogError
from khep_twin.log.attached import calibration_of, playpen_of
from khep_twin.log.channels import PLANAR
from khep_twin.log.decoding import DecodeError
from khep_twin.log.entries import Label
from khep_twin.log.reader import hash_of, read_series
from khep_twin.log.shadow_channels import (
    LIGHT,
    PARTICLES,
    PROXIMITY,
    REGION,
    STATE,
    STATE_COLOURS,
    SUSPECTED,
    TIMING,
    WHEELS,
    PoseState,
    Suspicion,
    is_shadow,
    state_of,
    suspected_of,
)
from khep_twin.log.shadow_track import planar
from khep_twin.log.viewer.arena import REACH, in_frame, line_chunks, path_chunks, trail
from khep_twin.log.viewer.collected import Collector, Floats, time_column

RESIDUALS = {
    "residual_proximity": PROXIMITY,
    "residual_light": LIGHT,
    "residual_wheels": WHEELS,
    "residual_timing": slice(TIMING, TIMING + 1),
}
"""Entities of the residuals of the replies that have them, timing in ms, and their columns."""

PICTURES = 10_000
"""Most pictures of a run's ghosts; a longer run has fewer than one per reply."""

FAULTS = "suspected"
"""Part of the entities' paths of the suspected faults."""

RECKONED, TRUTH = "reckoned", "truth"
"""Names of what is drawn beside the estimate."""

COLOURS = {
    "estimate": STATE_COLOURS[PoseState.FOLLOWED],
    RECKONED: (70, 70, 70),
    TRUTH: (30, 140, 70),
    "expected": (0, 150, 160),
    "measured": (228, 30, 20),
}
_ABOVE = 0.036
"""Height of what is drawn over the robot [m]."""

_T = TypeVar("_T")

_RAY_HEIGHT = 0.012
_TURNS = np.linspace(0, math.tau, 33)
_CIRCLE = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])


class Ghost:
    """Additions for one shadow's log, which may come in pieces; a log with the truth is sought next to it."""

    def __init__(self, label: Label, source: Path) -> None:
        self._robot, self._source = label.robots[0], source
        body = playpen_of(label.attachments, source).robots[0].body
        measured = calibration_of(label.attachments, self._robot, source)
        if measured is None:
            raise LogError(f"{source}: no calibration; expected calibration/{self._robot}.toml")
        self._radius, self._feet = body.radius, np.array(body.sensor_positions)
        self._headings = np.radians(measured.heading_deg)
        proximity = measured.proximity
        self._gain = np.array(proximity.gain_counts_mm2)
        self._threshold = np.array(proximity.threshold_counts)
        self._offset = np.array(proximity.offset_mm)
        self._before: dict[str, Floats] = {}
        self._states: list[tuple[int, PoseState]] = [(0, PoseState.FOLLOWED)]
        self._suspected: tuple[Suspicion, ...] = ()
        self._named = set[str]()
        self._truth = _truth(label, source)

    def chunks(self, collected: Collector) -> Iterator[Chunk]:
        """Yield the additions of a piece."""
        if self._truth is not None:
            times_ns, poses = self._truth
            yield from self._outline(TRUTH, times_ns[::2], poses[::2])
            yield from self._path(TRUTH, times_ns, poses)
            self._truth = None
        found = collected.shadow()
        self._states = [self._states[-1], *self._read(collected, STATE, state_of)]
        ends_ns = [] if found is None else found.times_ns[-1:].tolist()
        yield from self._probabilities(self._read(collected, SUSPECTED, suspected_of), ends_ns)
        if found is None:
            return
        times_ns, residuals = found.times_ns, found.residuals
        for name, columns in RESIDUALS.items():
            asked = ~np.isnan(residuals[:, columns]).any(axis=1)
            if asked.any():
                times = time_column(times_ns[asked])
                scale = 1e3 if columns.start == TIMING else 1.0
                values = rr.Scalars.columns(scalars=scale * residuals[asked, columns])
                yield Chunk.from_columns(f"/{self._robot}/{name}", [times], values)
        reckoned = planar(found.reckoned)
        yield from self._path(RECKONED, times_ns, reckoned)
        few = slice(None, None, max(1, len(times_ns) // PICTURES))
        times_ns, poses = times_ns[few], planar(found.poses[few])
        yield from self._outline(RECKONED, times_ns, reckoned[few])
        yield from self._region(times_ns, poses, found.poses[few, 7:])
        yield from self._rays(times_ns, poses, found.expected[few], found.measured[few])
        if len(found.particles_ns):
            yield from self._particles(found.particles_ns, found.particles.reshape(-1, PARTICLES, 3))

    def _path(self, name: str, times_ns: NDArray[np.int64], poses: Floats) -> Iterator[Chunk]:
        points = np.column_stack([poses[:, :2], np.zeros(len(poses))])
        yield from path_chunks(trail(name), times_ns, points, COLOURS[name], self._before.get(name))
        if len(points):
            self._before[name] = points[-1]

    def _outline(self, name: str, times_ns: NDArray[np.int64], poses: Floats) -> Iterator[Chunk]:
        """Yield a robot's outline with its nose, at two heights."""
        nose = self._radius * np.array([(0.2, 0.0), (1.0, 0.0)])
        strips: list[Floats] = []
        for x, y, heading in poses.tolist():
            turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
            for height in (0.003, 0.03):
                for shape in (self._radius * _CIRCLE, nose @ turn):
                    strips.append(np.column_stack([np.add(shape, (x, y)), np.full(len(shape), height)]))
        yield from _lines(f"/ghost/{name}", times_ns, strips, [COLOURS[name]] * 4, 0.0007)

    def _read(self, collected: Collector, topic: str, read: Callable[[str], _T]) -> list[tuple[int, _T]]:
        """Return times [ns] and content of a channel of lines."""
        found: list[tuple[int, _T]] = []
        for time_ns, text in collected.texts(topic):
            try:
                found.append((time_ns, read(text)))
            except DecodeError as error:
                raise error.at(self._source, topic, time_ns) from None
        return found

    def _probabilities(
        self, found: list[tuple[int, tuple[Suspicion, ...]]], ends_ns: list[int]
    ) -> Iterator[Chunk]:
        """Yield the probability of each suspected fault where it changes, and at the end of the piece."""
        curves: dict[str, list[tuple[int, float]]] = {}
        last = [(end_ns, found[-1][1] if found else self._suspected) for end_ns in ends_ns]
        for time_ns, suspected in [*found, *last]:
            now = {each.name: each.probability for each in suspected}
            for name in {**{each.name: 0.0 for each in self._suspected}, **now}:
                curves.setdefault(name, []).append((time_ns, 100 * now.get(name, 0.0)))
            self._suspected = suspected
        for name, points in curves.items():
            place = f"/{self._robot}/{FAULTS}/{rr.escape_entity_path_part(name)}"
            times_ns, values = (np.array(column) for column in zip(*points, strict=True))
            if name not in self._named:
                self._named.add(name)
                look = rr.SeriesLines.columns(names=[name], interpolation_mode=["StepAfter"])
                yield Chunk.from_columns(place, [], look)
            yield Chunk.from_columns(place, [time_column(times_ns)], rr.Scalars.columns(scalars=values))

    def _colours(self, times_ns: NDArray[np.int64]) -> list[Any]:
        """Return the colour of the state at each time."""
        begins_ns = [time_ns for time_ns, _ in self._states[1:]]
        rows = np.searchsorted(begins_ns, times_ns, side="right").tolist()
        return [STATE_COLOURS[self._states[row][1]] for row in rows]

    def _region(self, times_ns: NDArray[np.int64], poses: Floats, covariances: Floats) -> Iterator[Chunk]:
        """Yield the ellipse that holds the position with 95 %, over the robot, in the colour of the state."""
        strips: list[Floats] = []
        whole = covariances.reshape(-1, 6, 6)[:, PLANAR[:2]][:, :, PLANAR[:2]]
        for (x, y, _), covariance in zip(poses.tolist(), whole, strict=True):
            values, vectors = np.linalg.eigh(covariance)
            edge = REGION * _CIRCLE * np.sqrt(np.maximum(values, 0)) @ vectors.T + (x, y)
            strips.append(np.column_stack([edge, np.full(len(edge), _ABOVE)]))
        lines = [strip.astype(np.float32) for strip in strips], self._colours(times_ns)
        yield from line_chunks("/ghost/spread", "world", times_ns, *lines, 0.0008, 1)

    def _rays(
        self, times_ns: NDArray[np.int64], poses: Floats, expected: Floats, measured: Floats
    ) -> Iterator[Chunk]:
        """Yield the rays of the expected and the measured readings, side by side."""
        ahead = poses[:, 2:] + self._headings
        forward, left = self._feet.T
        cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x = poses[:, :1] + cosine * forward - sine * left
        y = poses[:, 1:2] + sine * forward + cosine * left
        for name, counts, side in (("expected", expected, 0.0012), ("measured", measured, -0.0012)):
            start = np.stack([x - side * np.sin(ahead), y + side * np.cos(ahead)], axis=-1)
            reach = self._reach(counts)[..., None]
            end = start + reach * np.stack([np.cos(ahead), np.sin(ahead)], axis=-1)
            ends = np.stack([start, end], axis=2).reshape(-1, 2, 2)
            strips = np.concatenate([ends, np.full((*ends.shape[:2], 1), _RAY_HEIGHT)], axis=2)
            yield from _lines(f"/ghost/{name}", times_ns, list(strips), [COLOURS[name]] * 8, 0.0008)

    def _reach(self, counts: Floats) -> Floats:
        """Return the distances of a facing white wall by readings [m], at most `REACH`; 0 for no reading."""
        light = np.maximum(counts + self._threshold, 1e-9)
        millimetres = np.sqrt(self._gain / light) - self._offset
        return np.nan_to_num(np.clip(millimetres / 1000, 0, REACH))

    def _particles(self, times_ns: NDArray[np.int64], particles: Floats) -> Iterator[Chunk]:
        points = particles.copy()
        points[..., 2] = _ABOVE
        n = len(times_ns)
        columns = rr.Points3D.columns(
            positions=points.reshape(-1, 3).astype(np.float32),
            radii=np.full(n * PARTICLES, 0.0009, np.float32),
            colors=[colour for colour in self._colours(times_ns) for _ in range(PARTICLES)],
        )
        yield in_frame("/ghost/particles", "world")
        times = [time_column(times_ns)]
        yield Chunk.from_columns("/ghost/particles", times, columns.partition([PARTICLES] * n))


def _lines(
    place: str, times_ns: NDArray[np.int64], strips: list[Floats], colours: list[Any], radius: float
) -> Iterator[Chunk]:
    """Yield as many lines at each time as there are colours."""
    if len(times_ns):
        lines = [strip.astype(np.float32) for strip in strips], colours * len(times_ns)
        yield from line_chunks(place, "world", times_ns, *lines, radius, len(colours))


def _truth(label: Label, source: Path) -> tuple[NDArray[np.int64], Floats] | None:
    """Return times [ns] and poses of the log that the shadow has read, if it lies here and has them."""
    name = label.metadata.get("parent", "")
    parent = source.parent / name
    if not is_shadow(label) or not name or Path(name).name != name or not parent.is_file():
        return None
    if hash_of(parent) != label.metadata.get("parent_sha256"):
        return None
    recording = read_series(parent)
    robot = label.metadata.get("parent_robot", recording.label.robots[0])
    found = recording.series.get(f"/{robot}/pose")
    return None if found is None else (found.times_ns, found.values.astype(np.float64))
