"""Faults of what stands in a playpen, as hypotheses: a thing is missing, moved, or not of the playpen."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.sensing.mujoco_scene import visible
from khep_twin.shadow.hypotheses import Hypothesis, Placed, refined
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planar_bodies import AWAY, N_SPARE
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]

MOVED_LEAST, MOVED_BY = 0.015, 0.02
"""Least distance by which a thing was moved, lest errors of the pose are taken for it, and the standard
deviation of what comes to it [m] (assumed)."""

ADDED_RADII = 0.004, 0.03
"""Radii of a thing that is not in the playpen [m] (assumed)."""

ADDED_REACH = 0.03
"""Farthest that it stands from a sensor that sees it [m] (assumed)."""

_LEAST_SPREAD = 0.003
"""Least deviation of a thing's place and size, drawn anew [m] (assumed)."""

_HEIGHT = 0.05

_CIRCLE = flat.CENTRE_X, flat.CENTRE_Y, flat.LENGTH
"""Columns of a round thing's place and radius."""


@dataclass(frozen=True)
class _OfThing(Hypothesis):
    """A fault of a thing of the playpen: its name, and its rows among those of the plane."""

    channel, rare = "proximity", 10.0
    kind: ClassVar[str]
    thing: str
    rows: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the fault."""
        return f"{self.kind} {self.thing}"

    @property
    def alike(self) -> str:
        """Name of the thing."""
        return self.thing

    def end(self, particles: Particles) -> None:
        """Put the thing back."""
        particles.planes.restore(self.rows)


class Missing(_OfThing):
    """A thing that is not in the playpen any more."""

    kind = "missing"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Take the thing away."""
        particles.planes.things[:, self.rows, flat.CENTRE_X] += AWAY
        particles.planes.remeasure()


class Moved(_OfThing, Placed):
    """A thing that is not where the playpen says."""

    kind = "moved"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Move the thing."""
        by = MOVED_LEAST + np.abs(rng.standard_normal(len(particles))) * MOVED_BY
        way = rng.uniform(0, math.tau, len(particles))
        particles.planes.offset(self.rows, np.stack([by * np.cos(way), by * np.sin(way)], axis=1))

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its place anew."""
        self._offset(particles, refined(particles.planes.offsets(self.rows), _LEAST_SPREAD, rng))

    def draw_near(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Draw its place anew."""
        offsets = particles.planes.offsets(self.rows)
        self._offset(particles, offsets + spread * rng.standard_normal(offsets.shape))

    def _offset(self, particles: Particles, offsets: Floats) -> None:
        by = np.hypot(*offsets.T)[:, None]
        particles.planes.offset(self.rows, offsets * np.maximum(MOVED_LEAST / np.maximum(by, 1e-9), 1))


class Unexpected(Placed):
    """A thing that is not in the playpen."""

    channel, rare, quota = "proximity", 11.0, 300

    @property
    def name(self) -> str:
        """Name of the fault."""
        return "unexpected thing"

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Put a cylinder in front of one sensor of each robot."""
        planes, count = particles.planes, len(particles)
        x, y, heading = planes.poses.T
        mounts = planes.robots["mounts"][0, rng.integers(N_SENSORS, size=count)]
        ahead, left, cosine, sine = mounts[:, :4].T
        radius = rng.uniform(*ADDED_RADII, count)
        off = rng.uniform(0.001, ADDED_REACH, count) + radius
        way = heading + np.arctan2(sine, cosine) + rng.standard_normal(count) * math.radians(20)
        c, s = np.cos(heading), np.sin(heading)
        row = planes.things[:, -N_SPARE]
        row[:, flat.CENTRE_X] = x + c * ahead - s * left + off * np.cos(way)
        row[:, flat.CENTRE_Y] = y + s * ahead + c * left + off * np.sin(way)
        row[:, flat.LENGTH], row[:, flat.WIDTH] = radius, -1
        row[:, flat.BOTTOM], row[:, flat.TOP] = 0, _HEIGHT
        row[:, flat.TOUCHED] = row[:, flat.REFLECTANCE] = 1
        planes.remeasure()

    def end(self, particles: Particles) -> None:
        """Take it away."""
        particles.planes.restore((-N_SPARE,))

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its place and its size anew."""
        row = particles.planes.things[:, -N_SPARE]
        row[:, _CIRCLE] = refined(row[:, _CIRCLE], _LEAST_SPREAD, rng)
        particles.planes.remeasure()

    def draw_near(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Draw its place and its size anew."""
        row = particles.planes.things[:, -N_SPARE]
        row[:, _CIRCLE] += spread * rng.standard_normal((len(particles), len(_CIRCLE)))
        row[:, flat.LENGTH] = np.clip(row[:, flat.LENGTH], *ADDED_RADII)
        particles.planes.remeasure()


def things_of(setup: EpisodeSetup) -> dict[str, tuple[int, ...]]:
    """Return the rows of each thing of a playpen among those of its plane; the arena's walls are none."""
    model = setup.model
    rows: dict[str, tuple[int, ...]] = {}
    upright = [geom for geom in visible(model) if model.geom_bodyid[geom] == 0]
    for row, geom in enumerate(upright):
        name = str(model.geom(int(geom)).name).partition("_")[0]
        if name != "wall":
            rows[name] = (*rows.get(name, ()), row)
    return rows
