"""Statistics of a run: distance, turns, nearness, collisions, light and slip, from the arrays of its log.

All functions are pure. A sample is valid until the next one. Path lengths are measured in steps of 1 mm, so
that the jitter of a counter or of a body at rest does not accumulate.
"""

import math
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import Block, Playpen
from khep_twin.playpen.footprint import Footprint, Rectangle
from khep_twin.playpen.polygon import walls_around
from khep_twin.robots.body import Body
from khep_twin.robots.registry import default_model

Floats = NDArray[np.float64]

_BODY = default_model().body

NEAR_COUNTS = _BODY.near_counts
"""Proximity of a Khepera above which an obstacle is near [counts]."""

CONTACT_DISTANCE = 0.001
"""Distance between a robot's edge and a fixed object below which they are in contact [m]."""

SAME_CONTACT_S = 0.1
"""Shortest time between two collisions [s]; contacts with shorter gaps count as one collision."""

_STEP = 0.001
"""Step of path lengths [m]."""


@dataclass(frozen=True, slots=True)
class Intervals:
    """Time intervals in which a condition is true.

    Attributes:
        times_s: Start and end of each interval (n, 2) [s].
        total_s: Total time in which the condition is true [s].
        share: Share of the total duration, 0 to 1.
    """

    times_s: Floats
    total_s: float
    share: float

    @property
    def longest_s(self) -> float:
        """Longest interval [s]."""
        return float(np.diff(self.times_s, axis=1).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of a robot.

    Attributes:
        duration_s: Time from the first sample to the last [s].
        distance: Path length [m].
        top_speed: Highest speed between two samples [m/s].
        left_turn: Sum of counter-clockwise turns [rad].
        right_turn: Sum of clockwise turns [rad].
    """

    duration_s: float
    distance: float
    top_speed: float
    left_turn: float
    right_turn: float

    @property
    def mean_speed(self) -> float:
        """Mean speed over the duration, including standing [m/s]; 0 for no duration."""
        return self.distance / self.duration_s if self.duration_s else 0.0


@dataclass(frozen=True, slots=True)
class Slip:
    """Difference between odometry and ground truth.

    Attributes:
        distance: Path length by odometry [m].
        end: Distance between the end positions of odometry and ground truth [m].
        heading: Largest heading error, odometry less ground truth, counter-clockwise positive [rad].
        heading_s: Time of the largest heading error [s].
    """

    distance: float
    end: float
    heading: float
    heading_s: float


@dataclass(frozen=True, slots=True)
class LightStatistics:
    """Light received from lamps.

    Attributes:
        mean: Mean depth below the dark level, over all sensors and samples [counts].
        brightest: Largest depth below the dark level [counts].
        sensor: Index of the sensor with the brightest reading, in the order of O.
        time_s: Time of the brightest reading [s].
    """

    mean: float
    brightest: float
    sensor: int
    time_s: float


def find_intervals(times_s: Floats, is_true: NDArray[np.bool_], gap_s: float = 0.0) -> Intervals:
    """Return the time intervals in which a condition is true.

    Args:
        times_s: Increasing times of the samples (n,) [s].
        is_true: True where the condition is true (n,).
        gap_s: Gap below which intervals are joined [s]; the total excludes the gaps.
    """
    edges = np.diff(is_true[:-1].astype(np.int8), prepend=0, append=0)
    spans = np.column_stack([times_s[np.flatnonzero(edges > 0)], times_s[np.flatnonzero(edges < 0)]])
    total_s = float(np.diff(spans, axis=1).sum())
    is_separate = spans[1:, 0] - spans[:-1, 1] >= gap_s
    starts = spans[np.append(True, is_separate)[: len(spans)], 0]
    joined = np.column_stack([starts, spans[np.append(is_separate, True)[: len(spans)], 1]])
    duration_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    return Intervals(joined, total_s, total_s / duration_s if duration_s else 0.0)


def motion(times_s: Floats, pose: Floats) -> Motion:
    """Return the motion of a robot from at least one pose x, y [m], heading [rad] (n, 3) at its time [s]."""
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    spans_s = np.diff(times_s)
    speeds = np.divide(steps, spans_s, out=np.zeros_like(steps), where=spans_s > 0)
    turns = np.diff(np.unwrap(pose[:, 2]))
    return Motion(
        float(times_s[-1] - times_s[0]),
        path_length(pose[:, :2]),
        float(speeds.max(initial=0.0)),
        float(turns[turns > 0].sum()),
        float(-turns[turns < 0].sum()),
    )


def path_length(positions: Floats) -> float:
    """Return the length of a path [m] through points (n, 2) [m], in steps of 1 mm."""
    if not len(positions):
        return 0.0
    total = 0.0
    x, y = positions[0].tolist()
    for next_x, next_y in positions.tolist():
        step = math.hypot(next_x - x, next_y - y)
        if step >= _STEP:
            total, x, y = total + step, next_x, next_y
    return total


def odometry(pulses: NDArray[np.int64], start: Floats, body: Body = _BODY) -> Floats:
    """Return a robot's pose by odometry: x, y [m] and heading [rad], not wrapped (n, 3).

    Inputs are the left and right counters (n, 2) [pulses] and the pose at the first sample (3,).
    """
    left, right = (pulses - pulses[0]).T * body.pulse_length
    heading = start[2] + (right - left) / body.wheel_base
    steps = np.diff((left + right) / 2)
    middle = (heading[1:] + heading[:-1]) / 2
    displacements = np.column_stack([steps * np.cos(middle), steps * np.sin(middle)])
    positions = np.vstack([start[:2], start[:2] + np.cumsum(displacements, axis=0)])
    return np.column_stack([positions, heading])


def slip(times_s: Floats, pose: Floats, pulses: NDArray[np.int64], body: Body = _BODY) -> Slip:
    """Return the difference between odometry and ground truth over at least one sample."""
    estimate = odometry(pulses, pose[0], body)
    heading_errors = estimate[:, 2] - np.unwrap(pose[:, 2])
    worst = int(np.argmax(np.abs(heading_errors)))
    end = math.hypot(*(estimate[-1, :2] - pose[-1, :2]).tolist())
    return Slip(path_length(estimate[:, :2]), end, float(heading_errors[worst]), float(times_s[worst]))


def near(times_s: Floats, proximity: NDArray[np.int64], counts: int = NEAR_COUNTS) -> Intervals:
    """Return the intervals in which any proximity reading (n, n_sensors) [counts] is above `counts`."""
    return find_intervals(times_s, np.max(proximity, axis=1, initial=0) > counts)


def collisions(times_s: Floats, pose: Floats, playpen: Playpen, radius: float) -> Intervals:
    """Return the intervals in which a robot with this radius [m] touches walls or fixed objects."""
    touching = clearance(pose[:, :2], playpen) - radius < CONTACT_DISTANCE
    return find_intervals(times_s, touching, SAME_CONTACT_S)


def clearance(positions: Floats, playpen: Playpen) -> Floats:
    """Return the distances of points (n, 2) [m] from walls and fixed objects (n,) [m]; below 0 inside one."""
    arena = playpen.arena
    shapes: list[Footprint] = [] if arena.table else [*walls_around(arena.corners, arena.wall_thickness_mm)]
    for item in chain(*playpen.obstacles.values()):
        if not (item.movable or (isinstance(item, Block) and item.ramp)):
            shapes += item.footprints
    nearest = np.full(len(positions), np.inf)
    for shape in shapes:
        np.minimum(nearest, _signed_distances(positions, shape), out=nearest)
    return nearest


def light(times_s: Floats, ambient: NDArray[np.int64], dark: Floats) -> LightStatistics:
    """Return the light of lamps at times (n,) [s] from ambient (n, m) and the dark levels (m,) [counts]."""
    depth = dark - ambient
    row, sensor = (int(index) for index in np.unravel_index(np.argmax(depth), depth.shape))
    return LightStatistics(float(depth.mean()), float(depth[row, sensor]), sensor, float(times_s[row]))


def _signed_distances(positions: Floats, shape: Footprint) -> Floats:
    """Return the distances of points from a shape (n,) [m]; below 0 inside it."""
    dx, dy = positions[:, 0] - shape.x_mm / 1000, positions[:, 1] - shape.y_mm / 1000
    if not isinstance(shape, Rectangle):
        return np.hypot(dx, dy) - shape.radius_mm / 1000
    (along_x, along_y), (across_x, across_y) = shape.axes()
    along = np.abs(dx * along_x + dy * along_y) - shape.length_mm / 2000
    across = np.abs(dx * across_x + dy * across_y) - shape.width_mm / 2000
    outside = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
    return outside + np.minimum(np.maximum(along, across), 0)
