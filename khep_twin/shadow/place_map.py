"""Map of a playpen: what a sound robot reads at places of a grid, to draw those where it may be."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.shadow.planes import Planes
from khep_twin.shadow.sensor_model import range_left
from khep_twin.shadow.start import inside
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CELL, N_TURNS = 0.01, 48
"""Side of a cell [m], and number of headings: readings differ by half from one to the next (assumed)."""

MOST_CELLS = 20_000
"""Number of cells above which they are larger."""

CHUNK = 2000
"""Twins that look around at once."""

SOFT_COUNTS = 30.0
"""Counts that are added to readings before their logarithm: noise, and the threshold's spread (assumed)."""

APART = 0.7
"""Standard deviation of that logarithm from the map's: gains, and errors of a cell (assumed)."""

EVEN = 0.2
"""Part of the places that are drawn whatever the replies are."""


class Sight(NamedTuple):
    """Readings (8,) [counts], and where the robot was by then: x, y [m], heading [rad] from the start."""

    moved: tuple[float, float, float]
    readings: Integers


class PlaceMap:
    """Places of a playpen where there is room, on a grid.

    Args:
        setup: Playpen with the robot, prepared for the plane.
    """

    def __init__(self, setup: EpisodeSetup) -> None:
        corners = np.array(setup.playpen.arena.corners) * 1e-3
        self._low = corners.min(axis=0)
        extent = corners.max(axis=0) - self._low
        self._cell = max(CELL, math.sqrt(float(extent.prod()) / MOST_CELLS))
        nx, ny = (np.ceil(extent / self._cell)).astype(int).tolist()
        cells = np.stack([each.ravel() for each in np.indices((nx, ny))], axis=1)
        places = np.column_stack([self._low + (cells + 0.5) * self._cell, np.zeros(nx * ny)])
        planes = Planes(setup, CHUNK)
        # The robot is round: where there is room, there is for all headings.
        free = _in_chunks(planes.free, places) & inside(corners, places)
        self.poses: Floats = np.repeat(places[free], N_TURNS, axis=0)
        self.poses[:, 2] = np.tile(np.arange(N_TURNS) * (math.tau / N_TURNS), int(free.sum()))
        self._rows = np.full((nx, ny, N_TURNS), -1)
        self._rows[*cells[free].T] = np.arange(len(self.poses)).reshape(-1, N_TURNS)
        outside = np.full((1, N_SENSORS), np.inf)  # or where there is no room
        logs = _in_chunks(partial(_readings, planes), self.poses)
        self._logs = np.concatenate([logs, outside]).astype(np.float32)

    def draw(
        self, count: int, sights: Sequence[Sight], use: NDArray[np.bool_], rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Draw starts by what was seen since, by the sensors to rely on (8,).

        Returns poses x, y [m], heading [rad] (count, 3), and the logarithms of their weights, by which they
        are as if drawn evenly (count,).
        """
        x, y, heading = self.poses.T
        cosine, sine = np.cos(heading), np.sin(heading)
        off = np.zeros(len(self.poses))
        for (dx, dy, turn), readings in sights:
            place = np.column_stack([x + cosine * dx - sine * dy, y + sine * dx + cosine * dy])
            expected = self._logs[self._rows_at(place, heading + turn)][:, use]
            apart = (expected - np.log(readings[use] + SOFT_COUNTS)) / APART
            off += np.minimum(np.square(apart).sum(axis=1), _FARTHEST)
        off /= math.sqrt(max(len(sights), 1))  # Their errors are alike.
        fits = np.exp(-0.5 * (off - off.min()))
        chances = EVEN / len(off) + (1 - EVEN) * fits / fits.sum()
        rows = rng.choice(len(off), count, p=chances)
        within = rng.uniform(-0.5, 0.5, (count, 3)) * (self._cell, self._cell, math.tau / N_TURNS)
        return self.poses[rows] + within, -np.log(chances[rows] * len(off))

    def _rows_at(self, place: Floats, heading: Floats) -> NDArray[np.intp]:
        """Return the rows of poses (n,); the last one where the robot cannot be."""
        cells = np.floor((place - self._low) / self._cell).astype(np.intp)
        turns = np.rint(heading * (N_TURNS / math.tau)).astype(np.intp) % N_TURNS
        nx, ny, _ = self._rows.shape
        is_in = (cells >= 0).all(axis=1) & (cells[:, 0] < nx) & (cells[:, 1] < ny)
        x, y = cells.clip(0, (nx - 1, ny - 1)).T
        return np.where(is_in, self._rows[x, y, turns], -1)


_FARTHEST = 60.0
"""Largest squared deviation of one reply: the robot may have touched something and stand elsewhere."""


def _in_chunks(function: Callable[[Floats], NDArray[Any]], poses: Floats) -> NDArray[Any]:
    """Return what a function of CHUNK poses returns for each of these; the last one fills the last chunk."""
    rows = np.arange(-(-len(poses) // CHUNK) * CHUNK).reshape(-1, CHUNK)
    return np.concatenate([function(poses[each]) for each in np.minimum(rows, len(poses) - 1)])[: len(poses)]


def _readings(planes: Planes, poses: Floats) -> Floats:
    """Return the logarithms of what sensors read at poses, with SOFT_COUNTS (n, 8)."""
    planes.put(poses)
    light, _ = planes.illuminate(np.zeros((len(planes), N_SENSORS)))
    limit = float(planes.proximity["limit"])
    counts = np.clip(light - planes.proximity["threshold"], 0, limit * range_left(planes))
    return np.log(counts + SOFT_COUNTS)
