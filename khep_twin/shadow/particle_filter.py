"""A particle filter whose particles are planar twins: it estimates a robot's pose from commands and replies.

Each particle has a pose, wheels and sensors; learned wheels and sensors decay slowly to the prior.
Replies to N weight the particles (`sensor_model`), and so do distances by ultrasound (`sonar_model`), both by
their novelty (`persistence`); replies to H move them;
at a low effective sample size they are resampled. Some have a started or ended fault (`changes`).
"""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as planar
from khep_twin.shadow.actions import (
    LATE_NS,
    Action,
    CounterReply,
    ProximityReply,
    RangeReply,
    SonarReply,
    WheelCommand,
    apply_action,
)
from khep_twin.shadow.changes import FaultChange, quotas, resample_changes
from khep_twin.shadow.motion_noise import draw_moves
from khep_twin.shadow.particles import Floats, Particles, resample_indices
from khep_twin.shadow.persistence import PERSISTENCE, SENSOR_RADIUS, novelty_of
from khep_twin.shadow.planar_bodies import TICK_NS, Booleans
from khep_twin.shadow.pose_estimate import PoseEstimate
from khep_twin.shadow.sensor_model import SensorModel, log_sum_exp
from khep_twin.shadow.sonar_model import PERSISTENCE as SONAR_PERSISTENCE
from khep_twin.shadow.sonar_model import sonar_likelihoods

GLOBAL_COUNT, GLOBAL_TEMPER = 3000, 0.17
"""Number of particles above which the robot may be anywhere, and the tempering power of their likelihood, so
that the right pose is not dropped early."""

MIN_EFFECTIVE = 0.5
"""Effective sample size, over the number of particles, below which they are resampled."""

FEW_EFFECTIVE, ROUGHENING = 0.1, 0.3
"""The same ratio below which they are also roughened, and that noise over their deviation (assumed)."""

_TICK_S = TICK_NS * 1e-9

_ROUGHENING_TICKS = 25
"""Time whose noise roughens few particles that are resampled to many [ticks]."""

_MAX_TICKS, _MAX_SOUND_TICKS = 10, 50
"""Longest time between two resamplings, with changes and without [ticks]."""

_PER_CELL, _PER_CELL_CHANGED = 200, 10
"""Particles per cell of 30 mm and 15 degrees where the robot may be, without changes and with (assumed)."""

_IMPROBABLE = 0.01
"""Probability below which a change is no longer considered."""


class ParticleFilter:
    """A particle filter of one robot, of `count` particles once the pose is known.

    Attributes:
        particles: Particles.
        changes: Changes that are considered, with the numbers 1, 2, ... in `Particles.changes`.
        evidence: Logarithm of the marginal likelihood of all replies so far.
        expected: Proximity expected at the last reply to N, mean over the particles (s,) [counts].
        surprisal: Log likelihood ratio of the most probable reading and the last one, by sensor (s,); of a
            robot with ultrasonic sensors (s + 1,), with the second largest of theirs last, as one may fail.
        novelty: Novelty of the last reply that weighted the particles.
    """

    def __init__(
        self, setup: EpisodeSetup, particles: Particles, rng: np.random.Generator, count: int
    ) -> None:
        self.particles = particles
        self._setup = setup
        self._rng = rng
        self._count = count
        self._model = SensorModel(particles.twins)
        self._turn_radius = 1, 1, SENSOR_RADIUS * particles.twins.scale
        self.changes: list[FaultChange] = []
        self.evidence = 0.0
        self.expected, self.surprisal = np.zeros((2, particles.twins.n_sensors))
        self.novelty = 1.0
        self._is_in_sight = False
        """Whether something was in reach of a sensor at the last reply to N."""
        self._noise_ticks = particles.twins.ticks
        self._timing_s = _TICK_S
        """Uncertainty of the time of the last command [s]."""
        self._timing_variances: Floats = np.zeros(3)
        """Variances due to changes of speed at uncertain times since the last noise [m^2, rad^2]."""
        self._travel: dict[type[RangeReply], float] = {ProximityReply: 0.0, SonarReply: 0.0}
        """Travel of a sensor since the last reply [m], by the reply's class."""
        self._free_wheels = particles.wheels
        """Wheels of the particles when the robot last drove freely (n, 3)."""

    def with_particles(self, particles: Particles) -> Self:
        """Return a filter of the same robot with other particles, without changes."""
        return type(self)(self._setup, particles, self._rng, self._count)

    def follow(self, action: Action, is_used: Booleans) -> Floats:
        """Follow an action, with sensors to rely on (s,); return the residual of counters (2,), or NaN."""
        residual = self.weigh(action, is_used)
        if isinstance(action, RangeReply):
            self._resample()
        return residual

    def weigh(self, action: Action, is_used: Booleans, novelty: float | None = None) -> Floats:
        """Follow an action as `follow` does, without resampling.

        The default novelty is that by the travel of these particles; evidence compares only at equal novelty.
        """
        last_poses, last_speeds = self.particles.twins.poses, self._speeds
        apply_action(action, self.particles)
        # Twins execute commands at whole ticks; the time at which the robot did is uncertain.
        square_speed_changes = np.square(self._speeds - last_speeds)
        self._timing_variances += self.weights @ square_speed_changes * (self._timing_s**2 / 12)
        if isinstance(action, WheelCommand):
            self._timing_s = _TICK_S + min(max(action.late_ns - action.time_ns, 0), LATE_NS) * 1e-9
        travel = np.abs(self.particles.twins.poses - last_poses) @ self._turn_radius
        for reply in self._travel:
            self._travel[reply] += float(self.weights @ travel)
        if isinstance(action, RangeReply):
            travel_novelty = self._novelty(action)
            self.novelty = travel_novelty if novelty is None else novelty
            self._weigh_reply(action, is_used)
        if isinstance(action, CounterReply):
            return self.weights @ self.particles.follow_counters(action.counters)
        return np.full(2, np.nan)

    @property
    def _speeds(self) -> Floats:
        """Speeds of the particles along x, y [m/s] and in turning [rad/s] (n, 3)."""
        forward, sideways, turn = self.particles.twins.robots["speeds"][:, :3].T
        heading = self.particles.twins.poses[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        return np.stack([c * forward - s * sideways, s * forward + c * sideways, turn], axis=1)

    @property
    def usable_range(self) -> Floats:
        """Part of each sensor's range that the lamps left at the last reply (s,)."""
        return self._model.usable_range

    def consider_changes(self, requested: Sequence[FaultChange]) -> None:
        """Consider changes from now on; present ones remain unless they are improbable."""
        keys = [change.key for change in requested]
        pairs = zip(self.changes, self.probabilities[1:] > _IMPROBABLE, strict=True)
        retained = [change for change, is_probable in pairs if is_probable and change.key not in keys]
        changes = [*requested, *retained]
        numbers = {change.key: number for number, change in enumerate(changes, 1)}
        new_numbers = np.array([0, *(numbers.get(change.key, -1) for change in self.changes)])
        renumbered = new_numbers[self.particles.changes]
        if (renumbered < 0).any():
            self.particles = self.particles.select(np.flatnonzero(renumbered >= 0))
            renumbered = renumbered[renumbered >= 0]
        self.particles.changes = renumbered
        self.changes = changes

    def adopt(self, number: int) -> None:
        """Continue with the particles of one change alone."""
        particles = self.particles.select(np.flatnonzero(self.particles.changes == number))
        self.replace_particles(particles)

    def replace_particles(self, particles: Particles) -> None:
        """Continue with other particles of the present time."""
        norm = log_sum_exp(particles.log_weights)
        particles.log_weights = particles.log_weights - norm
        particles.changes[:] = 0
        self.particles = particles
        self.changes = []
        if len(particles) < self._count:
            self.particles = particles.resample(self._count, self._rng.random())
        # Many particles may be copies of few, so noise of some time separates them.
        self._noise_ticks = self.particles.twins.ticks - _ROUGHENING_TICKS
        self._add_noise(np.zeros(3))

    def _weigh_reply(self, reply: RangeReply, is_used: Booleans) -> None:
        """Weight the particles by a reply, with sensors for N to rely on (s,)."""
        particles, power = self.particles, self.novelty
        if isinstance(reply, SonarReply):
            likelihoods, largest = sonar_likelihoods(particles.twins.echoes(), reply.readings)
            log_likelihoods = np.log(likelihoods)
            surprisal = np.sort(np.log(largest / (self.weights @ likelihoods)).clip(0))
            self.surprisal = np.append(np.zeros(len(is_used)), surprisal[-2:][0])
        else:
            self._is_in_sight = bool((reply.readings > self._model.quiet).any())
            values = self._model.observe(particles, reply.readings, is_used, power)
            self.expected, self.surprisal, log_likelihoods = values
            if particles.twins.entry.body.sonar is not None:
                self.surprisal = np.append(self.surprisal, 0.0)
        power *= GLOBAL_TEMPER if not self.changes and len(particles) > GLOBAL_COUNT else 1.0
        self.surprisal *= power
        particles.log_weights += power * log_likelihoods.sum(axis=1)
        norm = log_sum_exp(particles.log_weights)
        self.evidence += norm
        particles.log_weights -= norm

    def _novelty(self, reply: RangeReply) -> float:
        """Return the novelty of a reply after the travel since the last one of its class."""
        # The time is uncertain, by at least a tick.
        timing_s = _TICK_S + max(reply.late_ns - reply.time_ns, 0) * 1e-9
        uncertain_travel = timing_s * float(self.weights @ np.abs(self._speeds) @ self._turn_radius)
        travel, self._travel[type(reply)] = self._travel[type(reply)], 0.0
        persistence = SONAR_PERSISTENCE if isinstance(reply, SonarReply) else PERSISTENCE
        return novelty_of(travel, persistence, uncertain_travel)

    def estimate(self, time_ns: int) -> PoseEstimate:
        """Return the estimate of the pose, by the particles of the most probable change."""
        is_likely = self.particles.changes == np.argmax(self.probabilities)
        poses, weights = self.particles.twins.poses[is_likely], self.weights[is_likely]
        weights /= weights.sum()
        # Twins are at a whole tick; the robot has moved since.
        since_s = min(max(time_ns - self.particles.twins.ticks * TICK_NS, 0), TICK_NS) * 1e-9
        poses = poses + self._speeds[is_likely] * since_s
        return PoseEstimate.of(time_ns, poses, weights)

    @property
    def weights(self) -> Floats:
        """Weights of the particles (n,)."""
        return np.exp(self.particles.log_weights)

    @property
    def probabilities(self) -> Floats:
        """Probabilities of no change and of each one (1 + n_changes,)."""
        return np.bincount(self.particles.changes, self.weights, len(self.changes) + 1).astype(np.float64)

    def since_ns(self, number: int) -> int:
        """Return the mean time since when the particles of a change have it [ns]."""
        is_changed = self.particles.changes == number
        return int(np.average(self.particles.since_ns[is_changed], weights=self.weights[is_changed]))

    @property
    def poses(self) -> Floats:
        """Poses of equally probable particles (n, 3) [m, rad]."""
        return self.particles.twins.poses[resample_indices(self.weights, len(self.particles), 0.5)]

    def _resample(self) -> None:
        """Resample the particles at a low effective sample size, and from time to time; add noise."""
        weights = self.weights
        ticks = self.particles.twins.ticks
        passed_ticks = ticks - self._noise_ticks
        effective = 1 / np.square(weights).sum()
        max_ticks = _MAX_TICKS if self.changes else _MAX_SOUND_TICKS
        if passed_ticks >= max_ticks or effective <= MIN_EFFECTIVE * (len(weights) - self._quota):
            deviations = np.sqrt(self.estimate(0).covariance.diagonal())
            times = passed_ticks * _TICK_S, ticks * TICK_NS
            count = self._n_needed(weights)
            self.particles = resample_changes(self.particles, self.changes, count, *times, self._rng)
            if self.drives_freely:
                self._free_wheels = self.particles.wheels
            else:
                # A robot that pushes or slips does not move as its wheels turn, so they are not learned.
                rows = self._rng.integers(len(self._free_wheels), size=len(self.particles))
                self.particles.wheels = self._free_wheels[rows]
            needs_roughening = effective < FEW_EFFECTIVE * len(weights)
            self._add_noise(ROUGHENING * deviations if needs_roughening else np.zeros(3))

    @property
    def _quota(self) -> int:
        """Least number of particles for changes."""
        return sum(quotas(self.changes))

    @property
    def drives_freely(self) -> bool:
        """True if most particles touch nothing and do not slip."""
        twins = self.particles.twins
        is_hindered = twins.push_directions.any(axis=1) | (twins.robots["last_step"][:, planar.SLIPS] != 0)
        return float(self.weights @ is_hindered) < 0.5

    def _n_needed(self, weights: Floats) -> int:
        """Return the number of particles that the spread of the pose needs, besides those of changes."""
        available = len(weights) - self._quota
        if available <= 2 * self._count:
            return self._count
        poses = self.particles.twins.poses[weights > 1e-3 / len(weights)]
        cells = np.unique(np.floor(poses / (0.03, 0.03, math.radians(15))), axis=0)
        per_cell = _PER_CELL_CHANGED if self.changes else _PER_CELL
        return int(np.clip(per_cell * len(cells), self._count, available))

    def _add_noise(self, roughening: Floats) -> None:
        """Add the noise of the time since the last one, and that of a roughening (3,) [m, rad]."""
        particles, twins = self.particles, self.particles.twins
        passed_s = (twins.ticks - self._noise_ticks) * TICK_NS * 1e-9
        self._noise_ticks = twins.ticks
        moves = draw_moves(twins, passed_s, self._timing_variances, roughening, self._rng)
        twins.move(twins.poses + moves)
        self._timing_variances = np.zeros(3)
        particles.forget(passed_s, self._rng, self._is_in_sight)
