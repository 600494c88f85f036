"""A run in numbers: ways, turns, nearness, collisions, light and slip, from the arrays of its log.

All functions are pure. A sample stands for the time until the next one. Ways are measured in steps of 1 mm,
so that neither a pulse more or less of a counter nor the trembling of a body at rest adds up to a drive.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import Playpen
from khep_twin.playpen.footprint import Footprint, Rectangle
from khep_twin.playpen.polygon import walls_around
from khep_twin.units import PULSE_LENGTH, WHEEL_BASE

Floats = NDArray[np.float64]

NEAR_COUNTS = 100
"""Proximity above this is near something [counts]."""

TOUCHING = 0.001
"""A robot's edge nearer than this to something fixed touches it [m]."""

SAME_CONTACT_S = 0.1
"""Contacts with less time between them are one collision [s]."""

_STEP = 0.001
"""In which ways are measured [m]."""


@dataclass(frozen=True, slots=True)
class Stretches:
    """When something held.

    Attributes:
        times_s: begin and end of each stretch (n, 2) [s].
        total_s: time in which it held [s].
        share: of the whole time, 0 to 1.
    """

    times_s: Floats
    total_s: float
    share: float

    @property
    def longest_s(self) -> float:
        """The longest stretch [s]."""
        return float(np.diff(self.times_s, axis=1).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a robot got to.

    Attributes:
        duration_s: from the first sample to the last [s].
        distance: along its way [m].
        top_speed: between two samples [m/s].
        left_turn: all that it turned counter-clockwise [rad].
        right_turn: all that it turned clockwise [rad].
    """

    duration_s: float
    distance: float
    top_speed: float
    left_turn: float
    right_turn: float

    @property
    def mean_speed(self) -> float:
        """Over the whole time, standing included [m/s]; 0 for no time."""
        return self.distance / self.duration_s if self.duration_s else 0.0


@dataclass(frozen=True, slots=True)
class Slip:
    """What the wheels' counters say, against the truth.

    Attributes:
        distance: along the way as the counters have it [m].
        end: how far from the true end theirs is [m].
        heading: largest difference of heading, positive where the counters are ahead counter-clockwise [rad].
        heading_s: when that was [s].
    """

    distance: float
    end: float
    heading: float
    heading_s: float


@dataclass(frozen=True, slots=True)
class Light:
    """What came in from lamps.

    Attributes:
        mean: depth below the dark level, over all sensors and samples [counts].
        brightest: deepest reading below the dark level [counts].
        sensor: whose reading that was, in the order of O.
        time_s: when [s].
    """

    mean: float
    brightest: float
    sensor: int
    time_s: float


def stretches(times_s: Floats, holds: NDArray[np.bool_], gap_s: float = 0.0) -> Stretches:
    """When a condition held.

    Args:
        times_s: of the samples, rising (n,) [s].
        holds: whether it held then (n,).
        gap_s: stretches with less between them count as one; the total is without the gaps.
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
    """A robot's way.

    Args:
        times_s: of the samples, rising, at least one (n,) [s].
        pose: x, y [m] and heading [rad] (n, 3).
    """
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    spans_s = np.diff(times_s)
    speeds = np.divide(steps, spans_s, out=np.zeros_like(steps), where=spans_s > 0)
    turns = np.diff(np.unwrap(pose[:, 2]))
    return Motion(
        float(times_s[-1] - times_s[0]),
        way(pose[:, :2]),
        float(speeds.max(initial=0.0)),
        float(turns[turns > 0].sum()),
        float(-turns[turns < 0].sum()),
    )


def way(places: Floats) -> float:
    """Length of a way [m] through places (n, 2) [m], in steps of 1 mm."""
    if not len(places):
        return 0.0
    total = 0.0
    x, y = places[0].tolist()
    for next_x, next_y in places.tolist():
        step = math.hypot(next_x - x, next_y - y)
        if step >= _STEP:
            total, x, y = total + step, next_x, next_y
    return total


def reckoned(pulses: NDArray[np.int64], start: Floats) -> Floats:
    """Where a robot is by its counters: x, y [m] and heading [rad], not wrapped (n, 3).

    Args:
        pulses: left and right counters (n, 2) [pulses].
        start: pose at the first sample (3,).
    """
    left, right = (pulses - pulses[0]).T * PULSE_LENGTH
    heading = start[2] + (right - left) / WHEEL_BASE
    steps = np.diff((left + right) / 2)
    middle = (heading[1:] + heading[:-1]) / 2
    moved = np.column_stack([steps * np.cos(middle), steps * np.sin(middle)])
    places = np.vstack([start[:2], start[:2] + np.cumsum(moved, axis=0)])
    return np.column_stack([places, heading])


def slip(times_s: Floats, pose: Floats, pulses: NDArray[np.int64]) -> Slip:
    """The counters against the truth, over at least one sample."""
    told = reckoned(pulses, pose[0])
    ahead = told[:, 2] - np.unwrap(pose[:, 2])
    worst = int(np.argmax(np.abs(ahead)))
    end = math.hypot(*(told[-1, :2] - pose[-1, :2]).tolist())
    return Slip(way(told[:, :2]), end, float(ahead[worst]), float(times_s[worst]))


def near(times_s: Floats, proximity: NDArray[np.int64]) -> Stretches:
    """When any sensor had something before it; proximity (n, 8) [counts]."""
    return stretches(times_s, np.max(proximity, axis=1, initial=0) > NEAR_COUNTS)


def collisions(times_s: Floats, pose: Floats, playpen: Playpen, radius: float) -> Stretches:
    """When a robot of this radius [m] touched walls or fixed objects."""
    touching = clearance(pose[:, :2], playpen) - radius < TOUCHING
    return stretches(times_s, touching, SAME_CONTACT_S)


def clearance(places: Floats, playpen: Playpen) -> Floats:
    """From places (n, 2) [m] to the nearest wall or fixed object [m] (n,); below 0 within one."""
    arena = playpen.arena
    shapes: list[Footprint] = list(walls_around(arena.corners, arena.wall_thickness_mm))
    shapes += [shape for wall in playpen.walls for shape in wall.footprints]
    shapes += [item.footprint for item in (*playpen.blocks, *playpen.cylinders) if not item.movable]
    nearest = np.full(len(places), np.inf)
    for shape in shapes:
        np.minimum(nearest, _away(places, shape), out=nearest)
    return nearest


def light(times_s: Floats, ambient: NDArray[np.int64], dark: Floats) -> Light:
    """What lamps gave over at least one sample.

    Args:
        times_s: of the samples (n,) [s].
        ambient: (n, 8) [counts].
        dark: level of each sensor in the dark (8,) [counts].
    """
    depth = dark - ambient
    row, sensor = (int(place) for place in np.unravel_index(np.argmax(depth), depth.shape))
    return Light(float(depth.mean()), float(depth[row, sensor]), sensor, float(times_s[row]))


def _away(places: Floats, shape: Footprint) -> Floats:
    """From places [m] to a shape [m] (n,); below 0 within it."""
    dx, dy = places[:, 0] - shape.x_mm / 1000, places[:, 1] - shape.y_mm / 1000
    if not isinstance(shape, Rectangle):
        return np.hypot(dx, dy) - shape.radius_mm / 1000
    (along_x, along_y), (across_x, across_y) = shape.axes()
    along = np.abs(dx * along_x + dy * along_y) - shape.length_mm / 2000
    across = np.abs(dx * across_x + dy * across_y) - shape.width_mm / 2000
    outside = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
    return outside + np.minimum(np.maximum(along, across), 0)
