"""A particle filter whose particles are planar twins: where a robot is, from commands and sensor replies.

Each particle has its own pose, wheels and sensors; what was learned of these is forgotten slowly.
Replies to N weigh the particles (`sensor_model`), by how far the robot went since the last; those to H move
them; where few of them count, they are drawn anew. Some have a fault that may have begun, or ended
(`changes`).
"""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.shadow.actions import LATE_NS, Action, Commanded, Counted, Seen, repeat
from khep_twin.shadow.changes import FaultChange, mixed, quotas
from khep_twin.shadow.motion_noise import moves
from khep_twin.shadow.particles import Particles, drawn
from khep_twin.shadow.persistence import PERSISTENCE, SENSOR_RADIUS, part_new
from khep_twin.shadow.planar_bodies import TICK_NS
from khep_twin.shadow.pose_estimate import PoseEstimate
from khep_twin.shadow.sensor_model import SensorModel, log_of_sum

Floats = NDArray[np.float64]

MANY, MANY_TEMPER = 3000, 0.17
"""Number of particles that are many, of a robot that may be anywhere, and the power of their likelihood: what
is dropped too early is lost."""

LEAST_EFFECTIVE = 0.5
"""Part of the particles that count, below which they are drawn anew."""

FEW, ROUGH = 0.1, 0.3
"""Part of the particles that count, below which those drawn of them are spread by this part of their spread:
few of a wide cloud fit a reading (assumed)."""

_TICK_S = TICK_NS * 1e-9

_FRESH_TICKS = 25
"""Time for whose noise few particles are spread that become many [ticks]."""

_LONGEST_TICKS, _LONGEST_SOUND_TICKS = 10, 50
"""Longest time after which the particles are drawn anew, with changes that may begin then, and without
[ticks]."""

_IN_CELL, _IN_CELL_CHANGED = 200, 10
"""Particles for each cell of 30 mm and 15 degrees where the robot may be, and with changes (assumed)."""

_IMPROBABLE = 0.01
"""Probability below which a change need not be considered any more."""


class ParticleFilter:
    """A particle filter of one robot, of `count` particles once the pose is known.

    Attributes:
        particles: Particles.
        changes: Changes that are considered: 1, 2, ... of the particles'.
        evidence: Logarithm of the probability of all readings so far.
        expected: Readings expected last, over all particles (8,).
        surprise: What the last reply was less likely than an expected one, by sensor (8,), in logarithms.
        new: Part of the last reply to N that was new.
    """

    def __init__(
        self, setup: EpisodeSetup, particles: Particles, rng: np.random.Generator, count: int
    ) -> None:
        self._setup, self.particles, self._rng, self._count = setup, particles, rng, count
        self._model = SensorModel(particles.planes)
        self.changes: list[FaultChange] = []
        self.evidence = 0.0
        self.expected: Floats = np.zeros(8)
        self.surprise: Floats = np.zeros(8)
        self.new = 1.0
        self._drifted_ticks = particles.planes.ticks
        self._uncertain_s = _TICK_S
        """Time within which the last command was executed [s]."""
        self._jolts: Floats = np.zeros(3)
        """Variances by changes of speed since the last drift [m^2, rad^2]."""
        self._way = 0.0
        """Way of a sensor since the last reply to N [m]."""
        self._taught = particles.wheels
        """Wheels of particles when the robot drove freely last (n, 3)."""

    def like(self, particles: Particles) -> Self:
        """Return a filter of other particles of the robot."""
        return type(self)(self._setup, particles, self._rng, self._count)

    def act(self, action: Action, use: NDArray[np.bool_]) -> Floats:
        """Follow an action; return what counters tell beyond commands (2,), NaN for any other one.

        Sensors to rely on are those of `use` (8,).
        """
        told = self.weigh(action, use)
        if isinstance(action, Seen):
            self._renew()
        return told

    def weigh(self, action: Action, use: NDArray[np.bool_], new: float | None = None) -> Floats:
        """Follow an action as `act` does, with the same particles; a part of a reply to N is new.

        By default that is by the way of these particles. Evidence of two filters compares only if the parts
        are the same.
        """
        before, speeds = self.particles.planes.poses, self._speeds
        repeat(action, self.particles)
        # Twins obey at whole ticks; the robot did at a time that is not certain.
        self._jolts += self.weights @ np.square(self._speeds - speeds) * (self._uncertain_s**2 / 12)
        if isinstance(action, Commanded):
            self._uncertain_s = _TICK_S + min(max(action.late_ns - action.time_ns, 0), LATE_NS) * 1e-9
        along = np.abs(self.particles.planes.poses - before) @ (1, 1, SENSOR_RADIUS)
        self._way += float(self.weights @ along)
        if isinstance(action, Seen):
            part = self._part_new(action)
            self.new = part if new is None else new
            self._see(action, use)
        if isinstance(action, Counted):
            return self.weights @ self.particles.count(action.counters)
        return np.full(2, np.nan)

    @property
    def _speeds(self) -> Floats:
        """Speeds of the particles along x, y [m/s] and in turning [rad/s] (n, 3)."""
        ahead, aside, turn = self.particles.planes.robots["speeds"][:, :3].T
        heading = self.particles.planes.poses[:, 2]
        cosine, sine = np.cos(heading), np.sin(heading)
        return np.stack([cosine * ahead - sine * aside, sine * ahead + cosine * aside, turn], axis=1)

    @property
    def range_left(self) -> Floats:
        """Part of each sensor's range that the lamps left at the last reply (8,)."""
        return self._model.range_left

    def consider(self, wanted: Sequence[FaultChange]) -> None:
        """Consider changes from now on, and those of the present ones that are not improbable."""
        keys = [each.key for each in wanted]
        probable = self.probabilities[1:] > _IMPROBABLE
        kept = [
            each for each, is_so in zip(self.changes, probable, strict=True) if is_so and each.key not in keys
        ]
        changes = [*wanted, *kept]
        numbers = {each.key: number for number, each in enumerate(changes, 1)}
        new = np.array([0, *(numbers.get(each.key, -1) for each in self.changes)])[self.particles.changes]
        if (new < 0).any():
            self.particles = self.particles.taken(np.flatnonzero(new >= 0))
            new = new[new >= 0]
        self.particles.changes = new
        self.changes = changes

    def adopt(self, number: int) -> None:
        """Go on with the particles of one change alone, as the robot is now."""
        particles = self.particles.taken(np.flatnonzero(self.particles.changes == number))
        self.take(particles)

    def take(self, particles: Particles) -> None:
        """Go on with other particles of the present time."""
        norm = log_of_sum(particles.logs)
        particles.logs = particles.logs - norm
        particles.changes[:] = 0
        self.particles, self.changes = particles, []
        if len(particles) < self._count:
            self.particles = particles.drawn(self._count, self._rng.random())
        self.spread()

    def spread(self) -> None:
        """Spread the particles a little, as many were drawn of few."""
        self._drifted_ticks = self.particles.planes.ticks - _FRESH_TICKS
        self._drift(np.zeros(3))

    def _see(self, seen: Seen, use: NDArray[np.bool_]) -> None:
        """Weigh the particles by a reply to N of the sensors to rely on (8,)."""
        particles, new = self.particles, self.new
        self.expected, self.surprise, logs = self._model.explain(particles, seen.readings, use, new)
        new *= MANY_TEMPER if not self.changes and len(particles) > MANY else 1.0
        self.surprise *= new
        particles.logs += new * logs.sum(axis=1)
        norm = log_of_sum(particles.logs)
        self.evidence += norm
        particles.logs -= norm

    def _part_new(self, seen: Seen) -> float:
        """Return the part of a reply to N that is new, after the way since the last."""
        # The time is not certain, by a tick at the least.
        uncertain_s = _TICK_S + max(seen.late_ns - seen.time_ns, 0) * 1e-9
        vague = uncertain_s * float(self.weights @ np.abs(self._speeds) @ (1, 1, SENSOR_RADIUS))
        way, self._way = self._way, 0.0
        return part_new(way, PERSISTENCE, vague)

    def estimate(self, time_ns: int) -> PoseEstimate:
        """Return the estimate of the pose, of the most probable change."""
        likely = self.particles.changes == np.argmax(self.probabilities)
        poses, weights = self.particles.planes.poses[likely], self.weights[likely]
        weights /= weights.sum()
        # Twins are at a whole tick; the robot went on since.
        since_s = min(max(time_ns - self.particles.planes.ticks * TICK_NS, 0), TICK_NS) * 1e-9
        poses = poses + self._speeds[likely] * since_s
        return PoseEstimate.of(time_ns, poses, weights)

    @property
    def weights(self) -> Floats:
        """Weights of the particles (n,)."""
        return np.exp(self.particles.logs)

    @property
    def probabilities(self) -> Floats:
        """Probabilities of no change and of each one (1 + n_changes,)."""
        return np.bincount(self.particles.changes, self.weights, len(self.changes) + 1).astype(np.float64)

    def since_ns(self, number: int) -> int:
        """Return the mean time since when particles have a change [ns]."""
        has = self.particles.changes == number
        return int(np.average(self.particles.since_ns[has], weights=self.weights[has]))

    @property
    def poses(self) -> Floats:
        """Poses of equally probable particles (n, 3) [m, rad]."""
        return self.particles.planes.poses[drawn(self.weights, len(self.particles), 0.5)]

    def _renew(self) -> None:
        """Draw the particles anew where too few count, and now and then; spread them a little."""
        weights = self.weights
        ticks = self.particles.planes.ticks
        passed = ticks - self._drifted_ticks
        effective = 1 / np.square(weights).sum()
        longest = _LONGEST_TICKS if self.changes else _LONGEST_SOUND_TICKS
        if passed >= longest or effective <= LEAST_EFFECTIVE * (len(weights) - self._quota):
            step = TICK_NS * 1e-9
            spread = np.sqrt(self.estimate(0).covariance.diagonal())
            self.particles = mixed(
                self.particles, self.changes, self._wanted(weights), passed * step, ticks * TICK_NS, self._rng
            )
            if self._drives_freely:
                self._taught = self.particles.wheels
            else:
                # What pushes or grinds goes otherwise than its wheels turn, and teaches nothing of them.
                rows = self._rng.integers(len(self._taught), size=len(self.particles))
                self.particles.wheels = self._taught[rows]
            self._drift(ROUGH * spread if effective < FEW * len(weights) else np.zeros(3))

    @property
    def _quota(self) -> int:
        """Number of particles that consider changes."""
        return sum(quotas(self.changes))

    @property
    def _drives_freely(self) -> bool:
        """True if most particles touch nothing and do not slip."""
        planes = self.particles.planes
        hindered = planes.pushes.any(axis=1) | (planes.robots["last"][:, flat.SLIPS] != 0)
        return float(self.weights @ hindered) < 0.5

    def _wanted(self, weights: Floats) -> int:
        """Return the number of particles that the spread of the pose needs, besides those of changes."""
        most = len(weights) - self._quota
        if most <= 2 * self._count:
            return self._count
        poses = self.particles.planes.poses[weights > 1e-3 / len(weights)]
        cells = np.unique(np.floor(poses / (0.03, 0.03, math.radians(15))), axis=0)
        in_each = _IN_CELL_CHANGED if self.changes else _IN_CELL
        return int(np.clip(in_each * len(cells), self._count, most))

    def _drift(self, rough: Floats) -> None:
        """Move the particles by the noise since the last drift, and by a deviation (3,) [m, rad]."""
        particles, planes = self.particles, self.particles.planes
        passed_s = (planes.ticks - self._drifted_ticks) * TICK_NS * 1e-9
        self._drifted_ticks = planes.ticks
        planes.move(planes.poses + moves(planes, passed_s, self._jolts, rough, self._rng))
        self._jolts = np.zeros(3)
        particles.forget(passed_s, self._rng)
