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
from khep_twin.shadow.displacements import Elsewhere, Lifted
from khep_twin.shadow.hypotheses import Placed
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Particles, drawn
from khep_twin.shadow.place_map import PlaceMap, Sight
from khep_twin.shadow.planar_bodies import AWAY
from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.sensor_model import log_of_sum
from khep_twin.shadow.thresholds import THRESHOLDS

Floats = NDArray[np.float64]

GROUP = 120
"""Particles of a snapshot."""

HERE = 600
"""Particles that begin where the robot was."""

EARLIER_NS = 300_000_000
"""Time by which faults begin before replies surprise [ns]."""

FIRST_NS = 500_000_000
"""Time after something is in sight whose replies are enough to draw places [ns]."""

MOST_FIRST_NS = 1_500_000_000
"""The same after something was put elsewhere, if nothing is in sight [ns]."""


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

_SIGHTS = 4
"""Replies with something in sight by which places are drawn, and as many without."""


class _Heard(NamedTuple):
    """An action, and the part of a reply to N that was new."""

    action: Action
    new: float

    @property
    def has_sight(self) -> bool:
        """True of a reply with something in sight."""
        return isinstance(self.action, Seen) and bool(self.action.readings.max() > THRESHOLDS.in_sight)


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
        begin_ns, start = self._start(onset)
        particles = start.drawn(HERE, 0.5)
        particles.changes[:] = 0
        found = tracker.like(particles)
        found.consider(changes)
        actions = [action for action in self._actions if action.time_ns > begin_ns]
        begun_ns = {max(each, begin_ns) for each in onset.jumps_ns}
        jumps = dict.fromkeys((*sorted(begun_ns), max(onset.most_ns, begin_ns)), 0.0)
        heard: list[_Heard] = []
        for action in actions:
            found.act(action, use)
            heard.append(_Heard(action, found.new))
            # Until then the robot was sound, too.
            sound = found.evidence + math.log(max(found.probabilities[0], _LEAST))
            jumps |= {since_ns: sound for since_ns in jumps if action.time_ns <= since_ns}
        for since_ns, sound in jumps.items():
            few = start.drawn(GROUP, 0.5)
            for action in actions:
                if action.time_ns <= since_ns:
                    repeat(action, few)
            since = [each for each in heard if each.action.time_ns > since_ns]
            for number, change in enumerate(found.changes, 1):
                fault = change.hypothesis
                # Replies surprise most as a robot is put elsewhere, from the begin on at what else there is.
                may_begin = since_ns in begun_ns or isinstance(fault, Elsewhere)
                if change.begins and isinstance(fault, Placed) and may_begin:
                    placed = self._placed(found, few, fault, since, use)
                    placed.evidence += sound - found.evidence - fault.rare
                    placed.evidence += math.log1p(change.unseen_s)
                    _add(found, number, placed, since_ns)
        return found

    def begin_ns(self, onset: Onset) -> int:
        """Return the time at which a search for what has happened since an onset begins [ns]."""
        return self._start(onset)[0] if self._snapshots else onset.calm_ns

    def _start(self, onset: Onset) -> tuple[int, Particles]:
        """Return the last snapshot before an onset, or the first one of all."""
        before = (each for each in reversed(self._snapshots) if each[0] <= onset.calm_ns - EARLIER_NS)
        return next(before, self._snapshots[0])

    def _placed(
        self,
        tracker: ParticleFilter,
        few: Particles,
        fault: Placed,
        since: Sequence[_Heard],
        use: NDArray[np.bool_],
    ) -> ParticleFilter:
        """Return a filter of particles with a fault that has a place, by all replies since it began.

        The places become probable step by step, and are drawn anew, close to what they are, after each: what
        fits within millimetres and degrees is rare among any that are drawn.
        """
        counts = [round(each.times * fault.quota) for each in STEPS]
        begun = few.drawn(counts[0], 0.5)
        owed = np.zeros(counts[0])
        if isinstance(fault, Lifted):
            if self._places is None:
                self._places = PlaceMap(self._setup)
            sights = _sights(few.drawn(1, 0.5), since)
            # All sights draw the places, which is made up for at the end: the first are alike in many places.
            poses, owed = self._places.draw(counts[0], sights, use, self._rng)
            begun.planes.put(poses)
        else:
            fault.begin(begun, self._rng)
        seen_ns = next((each.action.time_ns for each in since if each.has_sight), since[0].action.time_ns)
        first_ns = min(seen_ns + FIRST_NS, since[0].action.time_ns + MOST_FIRST_NS)
        first = [each for each in since if each.action.time_ns <= first_ns]
        evidence = 0.0
        for step, count in zip(STEPS, [*counts[1:], counts[-1]], strict=True):
            logs = step.power * _told(_copied(tracker, begun), first, use)
            norm = log_of_sum(logs)
            evidence += norm - math.log(len(logs))
            rows = drawn(np.exp(logs - norm), count, self._rng.random())
            begun, owed = begun.taken(rows), owed[rows]
            begun.logs = np.full(count, -math.log(count))
            fault.draw_near(begun, step.spread, self._rng)
        found = _copied(tracker, begun)
        told = _told(found, first, use)
        logs = owed + _told(found, since[len(first) :], use) - sum(each.power for each in STEPS) * told
        norm = log_of_sum(logs)
        found.particles.logs = logs - norm
        found.evidence = evidence + norm - math.log(counts[-1])
        return found


def _sights(one: Particles, since: Sequence[_Heard]) -> list[Sight]:
    """Return some of the readings since then, with the way of one twin that touches nothing.

    Half of them are of replies with something in sight, if there are any.
    """
    one.planes.move(np.array([[-AWAY, -AWAY, 0.0]]))
    seen: tuple[list[Sight], list[Sight]] = [], []
    for each in since:
        repeat(each.action, one)
        if isinstance(each.action, Seen):
            x, y, heading = one.planes.poses[0].tolist()
            seen[each.has_sight].append(Sight((x + AWAY, y + AWAY, heading), each.action.readings))
    return [of[len(of) * number // _SIGHTS] for of in seen if of for number in range(_SIGHTS)]


def _copied(tracker: ParticleFilter, particles: Particles) -> ParticleFilter:
    """Return a filter of copies of particles that are equally probable."""
    return tracker.like(particles.drawn(len(particles), 0.5))


def _told(tracker: ParticleFilter, heard: Sequence[_Heard], use: NDArray[np.bool_]) -> Floats:
    """Follow actions; return the log likelihoods of all replies by each particle (n,)."""
    for action, new in heard:
        tracker.weigh(action, use, new)
    return tracker.particles.logs + math.log(len(tracker.particles)) + tracker.evidence


def _add(tracker: ParticleFilter, number: int, other: ParticleFilter, since_ns: int) -> None:
    """Add the particles of another filter, with a change since a time [ns], by its evidence."""
    particles = other.particles
    particles.changes[:] = number
    particles.since_ns[:] = since_ns
    particles.logs += other.evidence
    tracker.particles = tracker.particles.joined(particles)
    norm = log_of_sum(tracker.particles.logs)
    tracker.particles.logs -= norm
    tracker.evidence += norm
