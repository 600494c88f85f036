"""Search for what has happened: the last replies are repeated with twins that have faults, or are elsewhere.

A filter without faults is enough while replies are as expected. Once they surprise, a new one begins with
what was known before that, and considers all that may have happened since (`again`).
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.shadow.actions import Action, Seen, repeat
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.displacements import Displaced
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Particles, drawn
from khep_twin.shadow.place_map import PlaceMap, Sight
from khep_twin.shadow.planes import AWAY
from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.sensor_model import log_of_sum

Floats = NDArray[np.float64]

GROUP = 120
"""Particles of a snapshot."""

HERE = 600
"""Particles that begin where the robot was."""

EARLIER_NS = 300_000_000
"""Time by which faults begin before replies surprise [ns]."""

JUMPED_NS = 2_500_000_000
"""Time for which a robot may have been elsewhere before a search [ns]."""

FIRST_NS = 500_000_000
"""Time after a robot was put elsewhere whose replies are enough to draw places [ns]."""

TURN = 10.0
"""Deviation of headings after each step, as a multiple of that of places [rad/m] (assumed)."""


class _Step(NamedTuple):
    """A step in which places become probable.

    Attributes:
        times: Number of places, as a multiple of the quota.
        power: Power of the likelihood of the first replies.
        spread: Deviation of places after it [m].
    """

    times: float
    power: float
    spread: float


STEPS = _Step(5, 0.02, 8e-3), _Step(5, 0.05, 5e-3), _Step(3.5, 0.13, 3e-3), _Step(2.5, 0.3, 2e-3)
"""Steps by the first replies (assumed); the last has as many places as are left."""

SNAPSHOT_NS = 250_000_000
"""Interval of the snapshots [ns]."""

KEPT_NS = 8 * NS_PER_S
"""Time for which they are kept [ns]."""

_LEAST = 1e-9
"""Probability that nothing has happened, at the least."""

_SOUND = 0.9
"""Probability that nothing has happened, above which what is known is kept."""

_SIGHTS = 8
"""Replies by which places are drawn."""


class Search:
    """Search for what has happened to a robot."""

    def __init__(self, setup: EpisodeSetup, rng: np.random.Generator) -> None:
        self._setup, self._rng = setup, rng
        self._snapshots: deque[tuple[int, Particles]] = deque()
        self._actions: deque[Action] = deque()
        self._places: PlaceMap | None = None

    def note(self, action: Action) -> None:
        """Note an action."""
        self._actions.append(action)

    def keep(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Keep what a filter knows at a time [ns], now and then, unless something seems to have happened."""
        newest_ns = self._snapshots[-1][0] if self._snapshots else -SNAPSHOT_NS
        if time_ns - newest_ns >= SNAPSHOT_NS and tracker.probabilities[0] > _SOUND:
            self._snapshots.append((time_ns, tracker.particles.drawn(GROUP, self._rng.random())))
        while self._snapshots and self._snapshots[0][0] < time_ns - KEPT_NS:
            self._snapshots.popleft()
        first_ns = self._snapshots[0][0] if self._snapshots else time_ns
        while self._actions[0].time_ns < first_ns:
            self._actions.popleft()

    def again(
        self, tracker: ParticleFilter, onset: Onset, changes: Sequence[FaultChange], use: NDArray[np.bool_]
    ) -> ParticleFilter | None:
        """Return a filter that considers changes since the onset; None if nothing is known of before."""
        if not self._snapshots:
            return None
        begin_ns, start = next(
            (each for each in reversed(self._snapshots) if each[0] <= onset.calm_ns - EARLIER_NS),
            self._snapshots[0],
        )
        particles = start.drawn(HERE, 0.5)
        particles.changes[:] = 0
        found = tracker.like(particles)
        found.consider(changes)
        actions = [action for action in self._actions if action.time_ns > begin_ns]
        first_ns = self._actions[-1].time_ns - JUMPED_NS
        jumps = {max(each, begin_ns): 0.0 for each in onset.jumps_ns if each > first_ns}
        for action in actions:
            # Until then the robot was sound, too.
            sound = found.evidence + math.log(max(found.probabilities[0], _LEAST))
            jumps |= {since_ns: sound for since_ns in jumps if action.time_ns <= since_ns}
            found.act(action, use)
        for since_ns, sound in jumps.items():
            few = start.drawn(GROUP, 0.5)
            for action in actions:
                if action.time_ns <= since_ns:
                    repeat(action, few)
            for number, change in enumerate(found.changes, 1):
                if change.hypothesis.is_found:
                    elsewhere = self._elsewhere(found, few, change.hypothesis, since_ns, use)
                    elsewhere.evidence += sound - found.evidence - change.hypothesis.rare
                    _add(found, number, elsewhere, since_ns)
        return found

    def _elsewhere(
        self,
        tracker: ParticleFilter,
        few: Particles,
        hypothesis: Hypothesis,
        since_ns: int,
        use: NDArray[np.bool_],
    ) -> ParticleFilter:
        """Return a filter of particles that were put elsewhere at a time [ns], by all replies since.

        The places become probable step by step, and are drawn anew, close to what they are, after each: what
        fits within millimetres and degrees is rare among any that are drawn.
        """
        counts = [round(each.times * hypothesis.quota) for each in STEPS]
        if isinstance(hypothesis, Displaced):
            near = few.drawn(counts[0], 0.5)
            hypothesis.begin(near, self._rng)
            poses, logs = near.planes.poses, np.zeros(counts[0])
        else:
            if self._places is None:
                self._places = PlaceMap(self._setup)
            sights = self._sights(few.drawn(1, 0.5), since_ns)
            poses, logs = self._places.draw(counts[0], sights, use, self._rng)
        actions = [action for action in self._actions if action.time_ns > since_ns]
        first = [action for action in actions if action.time_ns <= since_ns + FIRST_NS]
        evidence = 0.0
        for step, count in zip(STEPS, [*counts[1:], counts[-1]], strict=True):
            logs += step.power * _told(self._put(tracker, few, poses), first, use)
            norm = log_of_sum(logs)
            evidence += norm - math.log(len(logs))
            rows = drawn(np.exp(logs - norm), count, self._rng.random())
            poses = poses[rows] + step.spread * self._rng.standard_normal((count, 3)) * (1, 1, TURN)
            logs = np.zeros(count)
        found = self._put(tracker, few, poses)
        begun = _told(found, first, use)
        logs = _told(found, actions[len(first) :], use) - sum(each.power for each in STEPS) * begun
        norm = log_of_sum(logs)
        found.particles.logs = logs - norm
        found.evidence = evidence + norm - math.log(counts[-1])
        return found

    def _put(self, tracker: ParticleFilter, few: Particles, poses: Floats) -> ParticleFilter:
        """Return a filter of particles that were put at poses."""
        particles = few.drawn(len(poses), 0.5)
        particles.planes.put(poses)
        return tracker.like(particles)

    def _sights(self, one: Particles, since_ns: int) -> list[Sight]:
        """Return some of the readings since then, with the way of one twin that touches nothing."""
        one.planes.move(np.array([[-AWAY, -AWAY, 0.0]]))
        seen: list[Sight] = []
        for action in self._actions:
            if action.time_ns > since_ns:
                repeat(action, one)
                if isinstance(action, Seen):
                    x, y, heading = one.planes.poses[0].tolist()
                    seen.append(Sight((x + AWAY, y + AWAY, heading), action.readings))
        return [seen[len(seen) * number // _SIGHTS] for number in range(_SIGHTS)] if seen else []


def _told(tracker: ParticleFilter, actions: Sequence[Action], use: NDArray[np.bool_]) -> Floats:
    """Follow actions; return what all replies tell of each particle, in logarithms (n,)."""
    for action in actions:
        tracker.weigh(action, use)
    return tracker.particles.logs + math.log(len(tracker.particles)) + tracker.evidence


def _add(tracker: ParticleFilter, number: int, other: ParticleFilter, since_ns: int) -> None:
    """Add the particles of another filter, with a change since a time [ns], by its evidence."""
    particles = other.particles
    particles.changes[:] = number
    particles.since_ns[:] = since_ns
    particles.logs += other.evidence
    tracker.particles = tracker.particles.joined(particles)
    tracker.particles.logs -= log_of_sum(tracker.particles.logs)
