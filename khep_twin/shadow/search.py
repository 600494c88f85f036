"""Search for a change that explains unexpected replies: sequential Monte Carlo with tempered likelihoods.

A filter without changes suffices while replies are as expected. After unexpected ones, `search_since` replays
the last actions from an older snapshot of the particles, with every change that may have happened since.

A change with a place (of the robot or of an obstacle) fits within millimetres and degrees only, so few
particles drawn from the prior do. They are therefore sampled in `STEPS`. Each step weights the particles by
the likelihood of the first replies, raised to a small tempering power, and resamples them; then noise
(roughening) moves each one, less in each step. At the end each particle has an importance weight: the
likelihood of all replies, without the powers that were used, over the density by which it was proposed.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.shadow.actions import Action, ProximityReply, apply_action
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.displacements import Lifted, Relocated
from khep_twin.shadow.hypotheses import Placed
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Floats, Particles, resample_indices
from khep_twin.shadow.place_map import PlaceMap, Sighting
from khep_twin.shadow.planar_bodies import AWAY, Booleans
from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.sensor_model import log_sum_exp

SUBSAMPLE_SIZE = 120
"""Particles of a snapshot, and of the subsample from which placed changes start."""

N_UNMOVED = 600
"""Particles that start where the robot was."""

LEAD_NS = 300_000_000
"""Time by which a fault may precede the first unexpected reply [ns]."""

TEMPERED_NS, MAX_TEMPERED_NS = 500_000_000, 1_500_000_000
"""Time after the first sight of something, and at most after the change, whose replies are tempered [ns]."""


class _Step(NamedTuple):
    """A step of the tempering, which raises likelihoods to a small power.

    Attributes:
        size: Number of particles, as a multiple of the quota.
        power: Tempering power of the first replies' likelihood.
        roughening: Standard deviation of the noise after resampling [m].
    """

    size: float
    power: float
    roughening: float


STEPS = (_Step(5, 0.02, 8e-3), _Step(5, 0.05, 5e-3), _Step(3.5, 0.13, 3e-3), _Step(2.5, 0.3, 2e-3))
"""Steps of the tempering (assumed); the last resamples to its own size, the others to that of the next."""

SNAPSHOT_NS, MAX_AGE_NS = 250_000_000, 8 * NS_PER_S
"""Interval and largest age of the snapshots [ns]."""

_MIN_PROBABILITY = 1e-9
"""Least probability of no change, for its logarithm."""

_UNCHANGED_ABOVE = 0.9
"""Probability of no change above which snapshots are saved."""

_N_SIGHTINGS = 4
"""Number of replies with an obstacle in sight that draw places, and of replies without."""


class _ReplayedAction(NamedTuple):
    """An action; of a reply to N also its novelty."""

    action: Action
    novelty: float


class Search:
    """Search for a change of a robot or its playpen, with snapshots and actions of the last seconds."""

    def __init__(self, setup: EpisodeSetup, rng: np.random.Generator) -> None:
        self._setup = setup
        self._rng = rng
        self._snapshots: deque[tuple[int, Particles]] = deque()
        self._actions: deque[Action] = deque()
        self._places: PlaceMap | None = None

    def add_action(self, action: Action) -> None:
        """Add an action to those that a search replays."""
        self._actions.append(action)

    def save_snapshot(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Save a filter's particles at a time [ns] if a snapshot is due and no change is probable."""
        newest_ns = self._snapshots[-1][0] if self._snapshots else -SNAPSHOT_NS
        if time_ns - newest_ns >= SNAPSHOT_NS and tracker.probabilities[0] > _UNCHANGED_ABOVE:
            self._snapshots.append((time_ns, tracker.particles.resample(SUBSAMPLE_SIZE, self._rng.random())))
        while self._snapshots and self._snapshots[0][0] < time_ns - MAX_AGE_NS:
            self._snapshots.popleft()
        oldest_ns = self._snapshots[0][0] if self._snapshots else time_ns
        while self._actions[0].time_ns < oldest_ns:
            self._actions.popleft()

    def search_since(
        self, tracker: ParticleFilter, onset: Onset, changes: Sequence[FaultChange], is_used: Booleans
    ) -> ParticleFilter | None:
        """Return a filter that considers changes since the onset; None without a snapshot."""
        if not self._snapshots:
            return None
        start_ns, snapshot = self._snapshot_before(onset)
        particles = snapshot.resample(N_UNMOVED, 0.5)
        particles.changes[:] = 0
        candidate = tracker.with_particles(particles)
        candidate.consider_changes(changes)
        actions = [action for action in self._actions if action.time_ns > start_ns]
        jumps_ns = {max(jump_ns, start_ns) for jump_ns in onset.jumps_ns}
        log_evidences = dict.fromkeys((*sorted(jumps_ns), max(onset.largest_ns, start_ns)), 0.0)
        replayed: list[_ReplayedAction] = []
        for action in actions:
            candidate.follow(action, is_used)
            replayed.append(_ReplayedAction(action, candidate.novelty))
            # Up to its change, the robot was unchanged.
            unchanged = candidate.evidence + math.log(max(candidate.probabilities[0], _MIN_PROBABILITY))
            log_evidences |= {time_ns: unchanged for time_ns in log_evidences if action.time_ns <= time_ns}
        for change_ns, log_evidence in log_evidences.items():
            subsample = snapshot.resample(SUBSAMPLE_SIZE, 0.5)
            for action in actions:
                if action.time_ns <= change_ns:
                    apply_action(action, subsample)
            replayed_since = [step for step in replayed if step.action.time_ns > change_ns]
            for number, change in enumerate(candidate.changes, 1):
                fault = change.hypothesis
                # A relocation shows most at the largest surprisal, all others from the first on.
                may_start = change_ns in jumps_ns or isinstance(fault, Relocated)
                if change.starts and isinstance(fault, Placed) and may_start:
                    sample = self._sample_placed(candidate, subsample, fault, replayed_since, is_used)
                    sample.evidence += log_evidence - candidate.evidence - fault.log_odds_against
                    sample.evidence += math.log1p(change.unseen_s)
                    _add_sample(candidate, number, sample, change_ns)
        return candidate

    def start_ns(self, onset: Onset) -> int:
        """Return the time from which a search after an onset replays actions [ns]."""
        return self._snapshot_before(onset)[0] if self._snapshots else onset.calm_ns

    def _snapshot_before(self, onset: Onset) -> tuple[int, Particles]:
        """Return the last snapshot before an onset; without one, the oldest."""
        older = (item for item in reversed(self._snapshots) if item[0] <= onset.calm_ns - LEAD_NS)
        return next(older, self._snapshots[0])

    def _sample_placed(
        self,
        tracker: ParticleFilter,
        subsample: Particles,
        fault: Placed,
        replayed: Sequence[_ReplayedAction],
        is_used: Booleans,
    ) -> ParticleFilter:
        """Return a filter of particles with a placed fault, sampled by all replies since it started."""
        sizes = [round(step.size * fault.quota) for step in STEPS]
        particles = subsample.resample(sizes[0], 0.5)
        log_weights = np.zeros(sizes[0])
        if isinstance(fault, Lifted):
            if self._places is None:
                self._places = PlaceMap(self._setup)
            sightings = _sightings(subsample.resample(1, 0.5), replayed)
            # Replies of the whole time propose the poses, as the first ones fit many places. The log weights
            # correct for that in the end.
            poses, log_weights = self._places.draw(sizes[0], sightings, is_used, self._rng)
            particles.twins.reset_poses(poses)
        else:
            fault.begin(particles, self._rng)
        change_ns = replayed[0].action.time_ns
        sights = (step.action for step in replayed if isinstance(step.action, ProximityReply))
        sight_ns = next((reply.time_ns for reply in sights if reply.in_sight), change_ns)
        tempered_ns = min(sight_ns + TEMPERED_NS, change_ns + MAX_TEMPERED_NS)
        early = [step for step in replayed if step.action.time_ns <= tempered_ns]
        evidence = 0.0
        for step, size in zip(STEPS, [*sizes[1:], sizes[-1]], strict=True):
            tempered = step.power * _log_likelihoods(_copy_with(tracker, particles), early, is_used)
            norm = log_sum_exp(tempered)
            evidence += norm - math.log(len(tempered))
            indices = resample_indices(np.exp(tempered - norm), size, self._rng.random())
            particles = particles.select(indices)
            log_weights = log_weights[indices]
            particles.log_weights = np.full(size, -math.log(size))
            fault.roughen(particles, step.roughening, self._rng)
        sample = _copy_with(tracker, particles)
        tempered = sum(step.power for step in STEPS) * _log_likelihoods(sample, early, is_used)
        log_weights = log_weights + _log_likelihoods(sample, replayed[len(early) :], is_used) - tempered
        norm = log_sum_exp(log_weights)
        sample.particles.log_weights = log_weights - norm
        sample.evidence = evidence + norm - math.log(sizes[-1])
        return sample


def _sightings(twin: Particles, replayed: Sequence[_ReplayedAction]) -> list[Sighting]:
    """Return a few readings, with the path of one twin that touches nothing.

    Half of them are of replies with something in sight, if there are any.
    """
    twin.twins.move(np.array([[-AWAY, -AWAY, 0.0]]))
    by_sight: tuple[list[Sighting], list[Sighting]] = [], []
    for step in replayed:
        apply_action(step.action, twin)
        if isinstance(step.action, ProximityReply):
            x, y, heading = twin.twins.poses[0].tolist()
            sighting = Sighting((x + AWAY, y + AWAY, heading), step.action.readings)
            by_sight[step.action.in_sight].append(sighting)
    numbers = range(_N_SIGHTINGS)
    return [half[len(half) * number // _N_SIGHTINGS] for half in by_sight if half for number in numbers]


def _copy_with(tracker: ParticleFilter, particles: Particles) -> ParticleFilter:
    """Return a filter with copies of equally probable particles."""
    return tracker.with_particles(particles.resample(len(particles), 0.5))


def _log_likelihoods(
    tracker: ParticleFilter, replayed: Sequence[_ReplayedAction], is_used: Booleans
) -> Floats:
    """Follow actions; return the log likelihoods of all replies so far by each particle (n,)."""
    for action, novelty in replayed:
        tracker.weigh(action, is_used, novelty)
    return tracker.particles.log_weights + math.log(len(tracker.particles)) + tracker.evidence


def _add_sample(tracker: ParticleFilter, number: int, sample: ParticleFilter, since_ns: int) -> None:
    """Add another filter's particles, which have a change since a time [ns], by its evidence."""
    particles = sample.particles
    particles.changes[:] = number
    particles.since_ns[:] = since_ns
    particles.log_weights += sample.evidence
    tracker.particles = tracker.particles.concatenate(particles)
    norm = log_sum_exp(tracker.particles.log_weights)
    tracker.particles.log_weights -= norm
    tracker.evidence += norm
