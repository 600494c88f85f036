"""Map of a playpen: readings of a sound robot at poses of a grid, to propose poses where it may be."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.shadow.planes import Booleans, Floats, Twins
from khep_twin.shadow.sensor_model import usable_range
from khep_twin.shadow.start import are_inside

Integers = NDArray[np.int64]

CELL_SIZE, N_HEADINGS = 0.01, 48
"""Side of a cell [m], and number of headings: readings differ by half between neighbours (assumed)."""

MAX_CELLS = 20_000
"""Largest number of cells, which are larger in a large playpen."""

CHUNK = 2000
"""Twins that read their sensors together."""

SOFT_COUNTS = 30.0
"""Counts added to readings before the logarithm, for noise and the spread of thresholds (assumed)."""

LOG_DEVIATION = 0.7
"""Standard deviation of log(reading + SOFT_COUNTS) from the map, by gains and cell size (assumed)."""

UNIFORM_SHARE = 0.2
"""Share of a uniform distribution in the proposal."""

_MAX_MISFIT = 60.0
"""Largest squared deviation of one reply: the robot may have touched an obstacle and be elsewhere."""


class Sighting(NamedTuple):
    """Readings (s,) [counts] at a reply, and the robot's move since the start: x, y [m], heading [rad]."""

    moved: tuple[float, float, float]
    readings: Integers


class PlaceMap:
    """Poses of a playpen where the robot has room, on a grid.

    Args:
        setup: Playpen with the robot, prepared for the plane.
    """

    def __init__(self, setup: EpisodeSetup) -> None:
        corners = np.array(setup.playpen.arena.corners) * 1e-3
        self._low_corner = corners.min(axis=0)
        extent = corners.max(axis=0) - self._low_corner
        twins = Twins(setup, CHUNK)
        self._cell = max(CELL_SIZE * twins.scale, math.sqrt(float(extent.prod()) / MAX_CELLS))
        nx, ny = (np.ceil(extent / self._cell)).astype(int).tolist()
        cells = np.stack([indices.ravel() for indices in np.indices((nx, ny))], axis=1)
        places = np.column_stack([self._low_corner + (cells + 0.5) * self._cell, np.zeros(nx * ny)])
        # The robot is round: a place with room has it for all headings.
        is_free = _apply_in_chunks(twins.are_clear, places) & are_inside(corners, places)
        self.poses: Floats = np.repeat(places[is_free], N_HEADINGS, axis=0)
        self.poses[:, 2] = np.tile(np.arange(N_HEADINGS) * (math.tau / N_HEADINGS), int(is_free.sum()))
        self._pose_rows = np.full((nx, ny, N_HEADINGS), -1)
        self._pose_rows[*cells[is_free].T] = np.arange(len(self.poses)).reshape(-1, N_HEADINGS)
        outside = np.full((1, twins.n_sensors), np.inf)  # or without room
        log_readings = _apply_in_chunks(partial(_log_readings_at, twins), self.poses)
        self._log_readings = np.concatenate([log_readings, outside]).astype(np.float32)

    def draw(
        self, count: int, sightings: Sequence[Sighting], is_used: Booleans, rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Draw start poses by later sightings, with sensors to rely on (s,).

        Returns poses x, y [m], heading [rad] (count, 3), and log importance weights (count,), by which they
        represent a uniform distribution.
        """
        x, y, heading = self.poses.T
        cosine, sine = np.cos(heading), np.sin(heading)
        misfit = np.zeros(len(self.poses))
        for (dx, dy, turn), readings in sightings:
            place = np.column_stack([x + cosine * dx - sine * dy, y + sine * dx + cosine * dy])
            expected = self._log_readings[self._rows_at(place, heading + turn)][:, is_used]
            deviations = (expected - np.log(readings[is_used] + SOFT_COUNTS)) / LOG_DEVIATION
            misfit += np.minimum(np.square(deviations).sum(axis=1), _MAX_MISFIT)
        misfit /= math.sqrt(max(len(sightings), 1))  # Their errors are correlated.
        likelihoods = np.exp(-0.5 * (misfit - misfit.min()))
        probabilities = UNIFORM_SHARE / len(misfit) + (1 - UNIFORM_SHARE) * likelihoods / likelihoods.sum()
        rows = rng.choice(len(misfit), count, p=probabilities)
        offsets = rng.uniform(-0.5, 0.5, (count, 3)) * (self._cell, self._cell, math.tau / N_HEADINGS)
        return self.poses[rows] + offsets, -np.log(probabilities[rows] * len(misfit))

    def _rows_at(self, place: Floats, heading: Floats) -> NDArray[np.intp]:
        """Return the rows of poses (n,); the last row for those without room."""
        cells = np.floor((place - self._low_corner) / self._cell).astype(np.intp)
        headings = np.rint(heading * (N_HEADINGS / math.tau)).astype(np.intp) % N_HEADINGS
        nx, ny, _ = self._pose_rows.shape
        is_inside = (cells >= 0).all(axis=1) & (cells[:, 0] < nx) & (cells[:, 1] < ny)
        x, y = cells.clip(0, (nx - 1, ny - 1)).T
        return np.where(is_inside, self._pose_rows[x, y, headings], -1)


def _apply_in_chunks(function: Callable[[Floats], NDArray[Any]], poses: Floats) -> NDArray[Any]:
    """Apply a function of CHUNK poses to any number; the last pose fills the last chunk."""
    rows = np.arange(-(-len(poses) // CHUNK) * CHUNK).reshape(-1, CHUNK)
    chunks = np.minimum(rows, len(poses) - 1)
    return np.concatenate([function(poses[chunk]) for chunk in chunks])[: len(poses)]


def _log_readings_at(twins: Twins, poses: Floats) -> Floats:
    """Return the logarithms of readings at poses, plus SOFT_COUNTS (n, s)."""
    twins.reset_poses(poses)
    light, _ = twins.illuminate(np.zeros((len(twins), twins.n_sensors)))
    limit = float(twins.proximity["limit"])
    counts = np.clip(light - twins.proximity["threshold"], 0, limit * usable_range(twins))
    return np.log(counts + SOFT_COUNTS)
