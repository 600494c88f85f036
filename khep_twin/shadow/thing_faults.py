"""Hypotheses of faults of obstacles: one is missing, moved, or not in the playpen."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as planar
from khep_twin.sensing.mujoco_scene import visible_geoms
from khep_twin.shadow.hypotheses import Hypothesis, Placed, shrink_and_jitter
from khep_twin.shadow.particles import Floats, Particles
from khep_twin.shadow.planar_bodies import AWAY, N_SPARE

MIN_MOVE, MOVE_DEVIATION = 0.015, 0.02
"""Least distance of a move, above errors of the pose, and standard deviation of the rest [m] (assumed); these
and the next lengths are those for a robot of a Khepera's size."""

ADDED_RADII = 0.004, 0.03
"""Radii of an obstacle that is not in the playpen [m] (assumed)."""

ADDED_REACH = 0.03
"""Largest distance of an added obstacle's surface from the sensor that sees it [m] (assumed)."""

_MIN_SPREAD = 0.003
"""Least standard deviation of the jitter of an obstacle's place and size [m] (assumed)."""

_HEIGHT = 0.05  # of an added obstacle [m]

_CIRCLE = planar.CENTRE_X, planar.CENTRE_Y, planar.HALF_LENGTH
"""Columns of a round obstacle's place and radius."""


@dataclass(frozen=True)
class _ObstacleFault(Hypothesis):
    """A fault of an obstacle of the playpen, with its name and its rows in `PlanarBodies.obstacles`."""

    log_odds_against = 10.0
    kind: ClassVar[str]
    obstacle: str
    rows: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the fault."""
        return f"{self.kind} {self.obstacle}"

    @property
    def group(self) -> str:
        """Name of the obstacle."""
        return self.obstacle

    def end(self, particles: Particles) -> None:
        """Move the obstacle back."""
        particles.twins.restore_obstacles(self.rows)


class Missing(_ObstacleFault):
    """An obstacle that is missing in the playpen."""

    kind = "missing"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Remove the obstacle."""
        particles.twins.obstacles[:, self.rows, planar.CENTRE_X] += AWAY
        particles.twins.remeasure()


class Moved(_ObstacleFault, Placed):
    """An obstacle that is not at its place in the playpen."""

    kind = "moved"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Move the obstacle."""
        scale = particles.twins.scale
        distance = MIN_MOVE * scale + np.abs(rng.standard_normal(len(particles))) * (MOVE_DEVIATION * scale)
        direction = rng.uniform(0, math.tau, len(particles))
        offsets = np.stack([distance * np.cos(direction), distance * np.sin(direction)], axis=1)
        particles.twins.set_obstacle_offsets(self.rows, offsets)

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the obstacle's place."""
        offsets = particles.twins.obstacle_offsets(self.rows)
        self._set_offsets(particles, shrink_and_jitter(offsets, _MIN_SPREAD, rng))

    def roughen(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Add noise to the obstacle's place."""
        offsets = particles.twins.obstacle_offsets(self.rows)
        self._set_offsets(particles, offsets + spread * rng.standard_normal(offsets.shape))

    def _set_offsets(self, particles: Particles, offsets: Floats) -> None:
        distances = np.hypot(*offsets.T)[:, None]
        offsets = offsets * np.maximum(MIN_MOVE * particles.twins.scale / np.maximum(distances, 1e-9), 1)
        particles.twins.set_obstacle_offsets(self.rows, offsets)


class Unexpected(Placed):
    """An obstacle that is not in the playpen."""

    log_odds_against = 11.0
    quota = 300

    @property
    def name(self) -> str:
        """Name of the fault."""
        return "unexpected thing"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add a cylinder in front of a random sensor of each particle."""
        twins, count = particles.twins, len(particles)
        x, y, heading = twins.poses.T
        mounts = twins.robots["mounts"][0, rng.integers(twins.n_sensors, size=count)]
        forward, left, cosine, sine = mounts[:, :4].T
        radius = rng.uniform(*ADDED_RADII, count) * twins.scale
        distance = rng.uniform(0.001, ADDED_REACH, count) * twins.scale + radius
        direction = heading + np.arctan2(sine, cosine) + rng.standard_normal(count) * math.radians(20)
        c, s = np.cos(heading), np.sin(heading)
        row = twins.obstacles[:, -N_SPARE]
        row[:, planar.CENTRE_X] = x + c * forward - s * left + distance * np.cos(direction)
        row[:, planar.CENTRE_Y] = y + s * forward + c * left + distance * np.sin(direction)
        row[:, planar.HALF_LENGTH], row[:, planar.HALF_WIDTH] = radius, -1
        row[:, planar.BOTTOM], row[:, planar.TOP] = 0, _HEIGHT * twins.scale
        row[:, planar.TOUCHABLE] = row[:, planar.REFLECTANCE] = 1
        twins.remeasure()

    def end(self, particles: Particles) -> None:
        """Move the added obstacle back out of reach."""
        particles.twins.restore_obstacles((-N_SPARE,))

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the obstacle's place and radius."""
        circles = particles.twins.obstacles[:, -N_SPARE][:, _CIRCLE]
        self._set_circles(particles, shrink_and_jitter(circles, _MIN_SPREAD, rng))

    def roughen(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Add noise to the obstacle's place and radius."""
        circles = particles.twins.obstacles[:, -N_SPARE][:, _CIRCLE]
        self._set_circles(particles, circles + spread * rng.standard_normal(circles.shape))

    def _set_circles(self, particles: Particles, circles: Floats) -> None:
        row = particles.twins.obstacles[:, -N_SPARE]
        row[:, _CIRCLE] = circles
        radii = np.array(ADDED_RADII) * particles.twins.scale
        row[:, planar.HALF_LENGTH] = np.clip(row[:, planar.HALF_LENGTH], *radii)
        particles.twins.remeasure()


def obstacle_rows(setup: EpisodeSetup) -> dict[str, tuple[int, ...]]:
    """Return the rows of a playpen's obstacles in `PlanarBodies.obstacles`, without the arena's walls."""
    model = setup.model
    rows: dict[str, tuple[int, ...]] = {}
    upright = [geom for geom in visible_geoms(model) if model.geom_bodyid[geom] == 0]
    for row, geom in enumerate(upright):
        name = str(model.geom(int(geom)).name).partition("_")[0]
        if name != "wall":
            rows[name] = (*rows.get(name, ()), row)
    return rows
