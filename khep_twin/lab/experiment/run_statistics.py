"""Statistics of a run: distance, turns, nearness, collisions, light and slip, from the arrays of its log.

All functions are pure. A sample holds until the next one. Path lengths are measured in steps of 1 mm, so that
the jitter of a counter or of a body at rest does not add up.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import Block, Playpen
from khep_twin.playpen.footprint import Footprint, Rectangle
from khep_twin.playpen.polygon import walls_around
from khep_twin.units import BODIES, Body

Floats = NDArray[np.float64]

NEAR_COUNTS = BODIES["khepera1"].near_counts
"""Proximity of a Khepera above which something is near [counts]."""

TOUCHING = 0.001
"""Distance between a robot's edge and a fixed object below which they touch [m]."""

SAME_CONTACT_S = 0.1
"""Shortest time between two collisions [s]; contacts in between count as one."""

_STEP = 0.001
"""Step of path lengths [m]."""


@dataclass(frozen=True, slots=True)
class Stretches:
    """Time intervals in which a condition held.

    Attributes:
        times_s: Begin and end of each interval (n, 2) [s].
        total_s: Time in which the condition held [s].
        share: Share of the whole time, 0 to 1.
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
        """Mean speed over the whole time, standing included [m/s]; 0 for no time."""
        return self.distance / self.duration_s if self.duration_s else 0.0


@dataclass(frozen=True, slots=True)
class Slip:
    """Difference between odometry and ground truth.

    Attributes:
        distance: Path length by odometry [m].
        end: Distance between the odometry's end and the true one [m].
        heading: Largest heading error, positive where odometry is ahead counter-clockwise [rad].
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
        sensor: Index of the sensor with that reading, in the order of O.
        time_s: Time of that reading [s].
    """

    mean: float
    brightest: float
    sensor: int
    time_s: float


def stretches(times_s: Floats, holds: NDArray[np.bool_], gap_s: float = 0.0) -> Stretches:
    """Return the time intervals in which a condition held.

    Args:
        times_s: Times of the samples, rising (n,) [s].
        holds: True where the condition holds (n,).
        gap_s: Gap below which intervals are joined [s]; the total is without the gaps.
    """
    turns = np.diff(holds[:-1].astype(np.int8), prepend=0, append=0)
    spans = np.column_stack([times_s[np.flatnonzero(turns > 0)], times_s[np.flatnonzero(turns < 0)]])
    total_s = float(np.diff(spans, axis=1).sum())
    apart = spans[1:, 0] - spans[:-1, 1] >= gap_s
    joined = np.column_stack(
        [spans[np.append(True, apart)[: len(spans)], 0], spans[np.append(apart, True)[: len(spans)], 1]]
    )
    duration_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    return Stretches(joined, total_s, total_s / duration_s if duration_s else 0.0)


def motion(times_s: Floats, pose: Floats) -> Motion:
    """Return the motion of a robot by at least a pose x, y [m], heading [rad] (n, 3), at rising times [s]."""
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


def reckoned(pulses: NDArray[np.int64], start: Floats, body: Body = BODIES["khepera1"]) -> Floats:
    """Return a robot's pose by odometry: x, y [m] and heading [rad], not wrapped (n, 3).

    It is from the left and right counters (n, 2) [pulses] and the pose at the first sample (3,).
    """
    left, right = (pulses - pulses[0]).T * body.pulse_length
    heading = start[2] + (right - left) / body.wheel_base
    steps = np.diff((left + right) / 2)
    middle = (heading[1:] + heading[:-1]) / 2
    moved = np.column_stack([steps * np.cos(middle), steps * np.sin(middle)])
    positions = np.vstack([start[:2], start[:2] + np.cumsum(moved, axis=0)])
    return np.column_stack([positions, heading])


def slip(times_s: Floats, pose: Floats, pulses: NDArray[np.int64], body: Body = BODIES["khepera1"]) -> Slip:
    """Return the difference between odometry and ground truth over at least one sample."""
    told = reckoned(pulses, pose[0], body)
    ahead = told[:, 2] - np.unwrap(pose[:, 2])
    worst = int(np.argmax(np.abs(ahead)))
    end = math.hypot(*(told[-1, :2] - pose[-1, :2]).tolist())
    return Slip(path_length(told[:, :2]), end, float(ahead[worst]), float(times_s[worst]))


def near(times_s: Floats, proximity: NDArray[np.int64], counts: int = NEAR_COUNTS) -> Stretches:
    """Return the intervals in which any sensor reads more than `counts`; proximity (n, 8) [counts]."""
    return stretches(times_s, np.max(proximity, axis=1, initial=0) > counts)


def collisions(times_s: Floats, pose: Floats, playpen: Playpen, radius: float) -> Stretches:
    """Return the intervals in which a robot of this radius [m] touches walls or fixed objects."""
    touching = clearance(pose[:, :2], playpen) - radius < TOUCHING
    return stretches(times_s, touching, SAME_CONTACT_S)


def clearance(positions: Floats, playpen: Playpen) -> Floats:
    """Return distances from points (n, 2) [m] to walls and fixed objects (n,) [m]; below 0 within one."""
    arena = playpen.arena
    shapes: list[Footprint] = [] if arena.table else [*walls_around(arena.corners, arena.wall_thickness_mm)]
    shapes += [shape for wall in playpen.walls for shape in wall.footprints]
    items = (item for items in playpen.objects.values() for item in items if not item.movable)
    shapes += [item.footprint for item in items if not (isinstance(item, Block) and item.ramp)]
    nearest = np.full(len(positions), np.inf)
    for shape in shapes:
        np.minimum(nearest, _away(positions, shape), out=nearest)
    return nearest


def light(times_s: Floats, ambient: NDArray[np.int64], dark: Floats) -> LightStatistics:
    """Return the light received from lamps over at least one sample, at times (n,) [s].

    Ambient readings are (n, 8), the dark level of each sensor is (8,) [counts].
    """
    depth = dark - ambient
    row, sensor = (int(place) for place in np.unravel_index(np.argmax(depth), depth.shape))
    return LightStatistics(float(depth.mean()), float(depth[row, sensor]), sensor, float(times_s[row]))


def _away(positions: Floats, shape: Footprint) -> Floats:
    """Return distances from points [m] to a shape (n,) [m]; below 0 within it."""
    dx, dy = positions[:, 0] - shape.x_mm / 1000, positions[:, 1] - shape.y_mm / 1000
    if not isinstance(shape, Rectangle):
        return np.hypot(dx, dy) - shape.radius_mm / 1000
    (along_x, along_y), (across_x, across_y) = shape.axes()
    along = np.abs(dx * along_x + dy * along_y) - shape.length_mm / 2000
    across = np.abs(dx * across_x + dy * across_y) - shape.width_mm / 2000
    outside = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
    return outside + np.minimum(np.maximum(along, across), 0)
