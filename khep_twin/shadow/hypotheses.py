"""Hypotheses of what may be wrong: each makes twins with a fault of sound ones, and sound ones of those."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.sensing.mujoco_scene import visible
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planes import AWAY, N_SPARE
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]

SIDES = ("left", "right")

WEAKEST, STRONGEST = 0.06, 0.3
"""Parts of its torque that a weak motor gives: below, the gear holds it; above, the controller makes up for
it, so that nothing shows at the speeds that hosts drive."""

MOST_HOLD = 0.1
"""Part of its friction that a slipping tyre has at the most: with more, hosts' speeds show little."""

MOVED_LEAST, MOVED_BY = 0.015, 0.02
"""Least distance by which a thing was moved, lest errors of the pose are taken for it, and the standard
deviation of what comes to it [m] (assumed)."""

ADDED_RADII = 0.004, 0.03
"""Radii of a thing that is not in the playpen [m] (assumed)."""

ADDED_REACH = 0.03
"""Farthest that it stands from a sensor that sees it [m] (assumed)."""

QUOTA = 150
"""Particles of a change at the least."""

REFINED = 0.2
"""Part of their deviation by which values are drawn anew (assumed)."""

_LEAST_SPREAD = 0.003
"""Least deviation of a thing's place and size, drawn anew [m] (assumed)."""

_HEIGHT = 0.05

_CIRCLE = flat.CENTRE_X, flat.CENTRE_Y, flat.LENGTH
"""Columns of a round thing's place and radius."""


class Hypothesis(ABC):
    """One fault.

    Attributes:
        channel: Channel in which it shows.
        rare: Logarithm of the odds against it, in a second (assumed).
        quota: Particles that consider it, at the least.
        is_found: True if only a search can tell where it leads: it does not begin, or end, by itself.
        is_fault: True unless nobody needs to be told.
    """

    channel: ClassVar[str]
    rare: ClassVar[float]
    quota: ClassVar[int] = QUOTA
    is_found: ClassVar[bool] = False
    is_fault: ClassVar[bool] = True

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the fault."""

    @property
    def alike(self) -> str:
        """Name of all faults that look like it."""
        return self.name

    @abstractmethod
    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Give particles the fault."""

    @abstractmethod
    def end(self, particles: Particles) -> None:
        """Take it from them."""

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw what differs among equally probable particles with the fault anew, close to what it is."""
        return  # by default nothing does


class Placed(Hypothesis):
    """One fault that has a place, which a search makes probable step by step."""

    @abstractmethod
    def draw_near(self, particles: Particles, spread: float, rng: np.random.Generator) -> None:
        """Draw the place of each particle anew, within a standard deviation of what it is [m]."""


@dataclass(frozen=True)
class _OfWheel(Hypothesis):
    """A fault of a motor or a wheel; 0 is left, 1 right."""

    channel = "wheels"
    kind: ClassVar[str]
    side: int

    @property
    def name(self) -> str:
        """Name of the fault."""
        return f"{self.kind} {SIDES[self.side]}"

    @property
    def alike(self) -> str:
        """Name of the wheel."""
        return f"{SIDES[self.side]} wheel"


class StandingWheel(_OfWheel):
    """A wheel that stands: one without current, which yields to a push, or one that is blocked."""

    kind, rare = "dead motor or blocked wheel", 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Take the current from every other motor, block the others."""
        particles.planes.strength[:, self.side] = -1
        particles.planes.strength[::2, self.side] = 0

    def end(self, particles: Particles) -> None:
        """Give it back."""
        particles.planes.strength[:, self.side] = 1


class WeakMotor(_OfWheel):
    """A motor that gives a part of its torque."""

    kind, rare = "weak motor", 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Weaken the motor."""
        particles.planes.strength[:, self.side] = rng.uniform(WEAKEST, STRONGEST, len(particles))

    def end(self, particles: Particles) -> None:
        """Strengthen it."""
        particles.planes.strength[:, self.side] = 1

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its strength anew."""
        strength = particles.planes.strength
        strength[:, self.side] = np.clip(refined(strength[:, self.side], 0.01, rng), WEAKEST, STRONGEST)


class SlippingWheel(_OfWheel):
    """A wheel whose tyre slips on the floor."""

    kind, rare = "slipping wheel", 10.0

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Make the tyre slip."""
        hold = MOST_HOLD * rng.uniform(0, 1, len(particles)) ** 2
        particles.planes.robots[f"{SIDES[self.side]}_hold"] = hold

    def end(self, particles: Particles) -> None:
        """Make it grip."""
        particles.planes.robots[f"{SIDES[self.side]}_hold"] = 1

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its hold anew."""
        hold = particles.planes.robots[f"{SIDES[self.side]}_hold"]
        hold[:] = np.clip(refined(hold, 0.005, rng), 0, MOST_HOLD)


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


def of_wheels() -> Iterator[Hypothesis]:
    """Yield the faults of motors and wheels."""
    for side in range(len(SIDES)):
        yield StandingWheel(side)
        yield WeakMotor(side)
        yield SlippingWheel(side)


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


def refined(values: Floats, least: float, rng: np.random.Generator) -> Floats:
    """Return values drawn anew, each close to one of these, with the same mean and deviation (n, ...).

    There is a least deviation, as few may have been drawn many times by their weights.
    """
    mean, deviation = values.mean(axis=0), np.maximum(values.std(axis=0), least)
    kept = math.sqrt(1 - REFINED * REFINED)
    return mean + kept * (values - mean) + REFINED * deviation * rng.standard_normal(values.shape)
