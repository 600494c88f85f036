"""Additions to the views of a shadow's log: region, particles, dead reckoning, rays, curves, ground truth.

The robot is drawn at the estimate, which is /tf of the log. A ray ends where a facing white wall would give
the reading, by the log's calibration: one ray for the expected reading, one for the measured reading.
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
from khep_twin.log.channels import MAP, PLANAR_ROWS
from khep_twin.log.decoding import DecodeError
from khep_twin.log.entries import Label
from khep_twin.log.reader import hash_file, read_series
from khep_twin.log.shadow_channels import (
    PARTICLES,
    REGION_SIGMAS,
    STATE,
    STATE_COLOURS,
    SUSPECTED,
    PoseState,
    Suspicion,
    is_shadow,
    parse_state,
    parse_suspicions,
)
from khep_twin.log.shadow_track import planar_poses, split_residuals
from khep_twin.log.viewer.arena import RAY_LIMIT, frame_chunk, line_chunks, trail_chunks, trail_path
from khep_twin.log.viewer.collected import Collector, Floats, time_column

PICTURES = 10_000
"""Maximum number of drawn updates of a run; a longer run has fewer than one per reply."""

FAULT_PATH = "suspected"
"""Component of the entity paths of suspected faults."""

RECKONED, TRUTH = "reckoned", "truth"
"""Names of the poses drawn beside the estimate."""

COLOURS = {
    "estimate": STATE_COLOURS[PoseState.FOLLOWED],
    RECKONED: (70, 70, 70),
    TRUTH: (30, 140, 70),
    "expected": (0, 150, 160),
    "measured": (228, 30, 20),
}
_OVERLAY_HEIGHT = 0.036
"""Height of the drawings over the robot [m]."""

_T = TypeVar("_T")

_RAY_HEIGHT = 0.012
_ANGLES = np.linspace(0, math.tau, 33)
_CIRCLE = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


class Ghost:
    """Additions for a shadow's log, batch by batch; its parent, the log it follows, gives ground truth."""

    def __init__(self, label: Label, source: Path) -> None:
        self._robot = label.robots[0]
        self._source = source
        body = playpen_of(label.attachments, source).robots[0].body
        calibration = calibration_of(label.attachments, self._robot, source)
        if calibration is None:
            raise LogError(f"{source}: no calibration; expected calibration/{self._robot}.toml")
        self._radius = body.radius
        self._sensor_positions = np.array(body.sensor_positions)
        self._headings = np.radians(calibration.heading_deg)
        proximity = calibration.proximity
        self._gain = np.array(proximity.gain_counts_mm2)
        self._threshold = np.array(proximity.threshold_counts)
        self._offset = np.array(proximity.offset_mm)
        self._last_poses: dict[str, Floats] = {}
        self._states: list[tuple[int, PoseState]] = [(0, PoseState.FOLLOWED)]
        self._suspected: tuple[Suspicion, ...] = ()
        self._named_faults = set[str]()
        self._truth = _read_truth(label, source)

    def chunks(self, collector: Collector) -> Iterator[Chunk]:
        """Yield the additions of a batch."""
        if self._truth is not None:
            times_ns, poses = self._truth
            yield from self._outline(TRUTH, times_ns[::2], poses[::2])
            yield from self._path(TRUTH, times_ns, poses)
            self._truth = None
        samples = collector.shadow()
        self._states = [self._states[-1], *self._parse(collector, STATE, parse_state)]
        ends_ns = [] if samples is None else samples.times_ns[-1:].tolist()
        yield from self._probabilities(self._parse(collector, SUSPECTED, parse_suspicions), ends_ns)
        if samples is None:
            return
        times_ns = samples.times_ns
        for kind, residuals in split_residuals(samples.residuals).items():
            is_measured = ~np.isnan(residuals).any(axis=1)
            if is_measured.any():
                times = time_column(times_ns[is_measured])
                scale = 1e3 if kind == "timing" else 1.0  # in ms
                values = rr.Scalars.columns(scalars=scale * residuals[is_measured])
                yield Chunk.from_columns(f"/{self._robot}/residual_{kind}", [times], values)
        reckoned = planar_poses(samples.reckoned)
        yield from self._path(RECKONED, times_ns, reckoned)
        stride = slice(None, None, max(1, len(times_ns) // PICTURES))
        times_ns, poses = times_ns[stride], planar_poses(samples.poses[stride])
        yield from self._outline(RECKONED, times_ns, reckoned[stride])
        yield from self._region(times_ns, poses, samples.poses[stride, 7:])
        yield from self._rays(times_ns, poses, samples.expected[stride], samples.measured[stride])
        if len(samples.particles_ns):
            yield from self._particles(samples.particles_ns, samples.particles.reshape(-1, PARTICLES, 3))

    def _path(self, name: str, times_ns: NDArray[np.int64], poses: Floats) -> Iterator[Chunk]:
        points = np.column_stack([poses[:, :2], np.zeros(len(poses))])
        yield from trail_chunks(trail_path(name), times_ns, points, COLOURS[name], self._last_poses.get(name))
        if len(points):
            self._last_poses[name] = points[-1]

    def _outline(self, name: str, times_ns: NDArray[np.int64], poses: Floats) -> Iterator[Chunk]:
        """Yield a robot's outline with a heading line, at two heights."""
        nose = self._radius * np.array([(0.2, 0.0), (1.0, 0.0)])
        strips: list[Floats] = []
        for x, y, heading in poses.tolist():
            cosine, sine = math.cos(heading), math.sin(heading)
            rotation = np.array([[cosine, sine], [-sine, cosine]])
            for height in (0.003, 0.03):
                for shape in (self._radius * _CIRCLE, nose @ rotation):
                    strips.append(np.column_stack([np.add(shape, (x, y)), np.full(len(shape), height)]))
        yield from _line_chunks(f"/ghost/{name}", times_ns, strips, [COLOURS[name]] * 4, 0.0007)

    def _parse(self, collector: Collector, topic: str, read: Callable[[str], _T]) -> list[tuple[int, _T]]:
        """Return times [ns] and parsed content of a text channel."""
        lines: list[tuple[int, _T]] = []
        for time_ns, text in collector.texts(topic):
            try:
                lines.append((time_ns, read(text)))
            except DecodeError as error:
                raise error.to_log_error(self._source, topic, time_ns) from None
        return lines

    def _probabilities(
        self, changes: list[tuple[int, tuple[Suspicion, ...]]], ends_ns: list[int]
    ) -> Iterator[Chunk]:
        """Yield the probability of each suspected fault at its changes, and at `ends_ns`, the batch's end."""
        curves: dict[str, list[tuple[int, float]]] = {}
        end_values = [(end_ns, changes[-1][1] if changes else self._suspected) for end_ns in ends_ns]
        for time_ns, suspected in [*changes, *end_values]:
            probabilities = {suspicion.name: suspicion.probability for suspicion in suspected}
            for name in {**{suspicion.name: 0.0 for suspicion in self._suspected}, **probabilities}:
                curves.setdefault(name, []).append((time_ns, 100 * probabilities.get(name, 0.0)))
            self._suspected = suspected
        for name, points in curves.items():
            path = f"/{self._robot}/{FAULT_PATH}/{rr.escape_entity_path_part(name)}"
            times_ns, values = (np.array(column) for column in zip(*points, strict=True))
            if name not in self._named_faults:
                self._named_faults.add(name)
                style = rr.SeriesLines.columns(names=[name], interpolation_mode=["StepAfter"])
                yield Chunk.from_columns(path, [], style)
            yield Chunk.from_columns(path, [time_column(times_ns)], rr.Scalars.columns(scalars=values))

    def _state_colours(self, times_ns: NDArray[np.int64]) -> list[Any]:
        """Return the colour of the state at each time."""
        changes_ns = [time_ns for time_ns, _ in self._states[1:]]
        rows = np.searchsorted(changes_ns, times_ns, side="right").tolist()
        return [STATE_COLOURS[self._states[row][1]] for row in rows]

    def _region(self, times_ns: NDArray[np.int64], poses: Floats, covariances: Floats) -> Iterator[Chunk]:
        """Yield the 95 % ellipse of the position, over the robot, in the colour of the state."""
        strips: list[Floats] = []
        position_covariances = covariances.reshape(-1, 6, 6)[:, PLANAR_ROWS[:2]][:, :, PLANAR_ROWS[:2]]
        for (x, y, _), covariance in zip(poses.tolist(), position_covariances, strict=True):
            values, vectors = np.linalg.eigh(covariance)
            edge = REGION_SIGMAS * _CIRCLE * np.sqrt(np.maximum(values, 0)) @ vectors.T + (x, y)
            strips.append(np.column_stack([edge, np.full(len(edge), _OVERLAY_HEIGHT)]))
        lines = [strip.astype(np.float32) for strip in strips], self._state_colours(times_ns)
        yield from line_chunks("/ghost/spread", MAP, times_ns, *lines, radius=0.0008, n_lines=1)

    def _rays(
        self, times_ns: NDArray[np.int64], poses: Floats, expected: Floats, measured: Floats
    ) -> Iterator[Chunk]:
        """Yield the rays of the expected and the measured readings, side by side."""
        directions = poses[:, 2:] + self._headings
        forward, left = self._sensor_positions.T
        cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x = poses[:, :1] + cosine * forward - sine * left
        y = poses[:, 1:2] + sine * forward + cosine * left
        for name, counts, side in (("expected", expected, 0.0012), ("measured", measured, -0.0012)):
            start = np.stack([x - side * np.sin(directions), y + side * np.cos(directions)], axis=-1)
            distances = self._wall_distances(counts)[..., None]
            end = start + distances * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
            ends = np.stack([start, end], axis=2).reshape(-1, 2, 2)
            strips = np.concatenate([ends, np.full((*ends.shape[:2], 1), _RAY_HEIGHT)], axis=2)
            colours = [COLOURS[name]] * len(forward)
            yield from _line_chunks(f"/ghost/{name}", times_ns, list(strips), colours, 0.0008)

    def _wall_distances(self, counts: Floats) -> Floats:
        """Return the distances of a facing white wall by readings [m], up to `RAY_LIMIT`; 0 if NaN."""
        light = np.maximum(counts + self._threshold, 1e-9)
        millimetres = np.sqrt(self._gain / light) - self._offset
        return np.nan_to_num(np.clip(millimetres / 1000, 0, RAY_LIMIT))

    def _particles(self, times_ns: NDArray[np.int64], particles: Floats) -> Iterator[Chunk]:
        points = particles.copy()
        points[..., 2] = _OVERLAY_HEIGHT
        n = len(times_ns)
        columns = rr.Points3D.columns(
            positions=points.reshape(-1, 3).astype(np.float32),
            radii=np.full(n * PARTICLES, 0.0009, np.float32),
            colors=[colour for colour in self._state_colours(times_ns) for _ in range(PARTICLES)],
        )
        yield frame_chunk("/ghost/particles", MAP)
        times = [time_column(times_ns)]
        yield Chunk.from_columns("/ghost/particles", times, columns.partition([PARTICLES] * n))


def _line_chunks(
    path: str, times_ns: NDArray[np.int64], strips: list[Floats], colours: list[Any], radius: float
) -> Iterator[Chunk]:
    """Yield one line per colour at each time."""
    if len(times_ns):
        lines = [strip.astype(np.float32) for strip in strips], colours * len(times_ns)
        yield from line_chunks(path, MAP, times_ns, *lines, radius, len(colours))


def _read_truth(label: Label, source: Path) -> tuple[NDArray[np.int64], Floats] | None:
    """Read times [ns] and poses of the shadow's parent log, if it is in the same folder and contains them."""
    name = label.metadata.get("parent", "")
    parent = source.parent / name
    if not is_shadow(label) or not name or Path(name).name != name or not parent.is_file():
        return None
    if hash_file(parent) != label.metadata.get("parent_sha256"):
        return None
    recording = read_series(parent)
    robot = label.metadata.get("parent_robot", recording.label.robots[0])
    series = recording.series.get(f"/{robot}/pose")
    return None if series is None else (series.times_ns, series.values.astype(np.float64))
