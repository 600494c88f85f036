"""Search for a robot that was put elsewhere: the last replies, repeated with twins that may be anywhere."""

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.shadow.actions import Action, repeat
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.start import anywhere

GROUP = 120
"""Particles of a snapshot."""

LOST, TRIED, FOUND, HERE = 10_000, 3000, 1500, 500
"""Particles of a robot that was put anywhere, of one that may have been, of one that was found, and of one
that was not moved."""

SNAPSHOT_NS = 250_000_000
"""Interval of the snapshots [ns]."""

KEPT_NS = 4 * NS_PER_S
"""Time for which they are kept [ns]."""

RARE = 11.0
"""Logarithm of the odds against a robot that is put elsewhere (assumed)."""


class Search:
    """Search for a robot that was put elsewhere."""

    def __init__(self, setup: EpisodeSetup, rng: np.random.Generator) -> None:
        self._setup, self._rng = setup, rng
        self._snapshots: deque[tuple[int, Particles]] = deque()
        self._actions: deque[tuple[Action, float]] = deque()

    def note(self, action: Action, evidence: float) -> None:
        """Note an action, and the logarithm of the probability of all readings before it."""
        self._actions.append((action, evidence))

    def keep(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Keep what a filter knows at a time [ns], now and then."""
        if self._snapshots and time_ns - self._snapshots[-1][0] < SNAPSHOT_NS:
            return
        self._snapshots.append((time_ns, tracker.particles.drawn(GROUP, self._rng.random())))
        while self._snapshots[0][0] < time_ns - KEPT_NS:
            self._snapshots.popleft()
        while self._actions[0][0].time_ns < self._snapshots[0][0]:
            self._actions.popleft()

    def odds(
        self, tracker: ParticleFilter, since_ns: int, use: NDArray[np.bool_], fault: Hypothesis | None = None
    ) -> float:
        """Return the logarithm of the odds that the robot was put elsewhere since then.

        It is against what a filter considers, or against a fault that may have begun then instead.
        """
        if not self._snapshots:
            return -np.inf
        since_ns = max(since_ns, self._snapshots[0][0])
        before = next((told for action, told in self._actions if action.time_ns > since_ns), tracker.evidence)
        here = max(tracker.evidence - before, self._repeated(since_ns, HERE, use).evidence)
        if fault is not None:
            # As rare; a filter considers it some replies later, which surprise all its twins.
            begun = self._repeated(since_ns, HERE, use, lambda particles: fault.begin(particles, self._rng))
            here = max(here, begun.evidence - RARE)
        return self._repeated(since_ns, TRIED, use, self._scatter).evidence - RARE - here

    def lost(self, since_ns: int, use: NDArray[np.bool_]) -> Particles:
        """Return particles of a robot that was put anywhere, by the replies since; forget what was before."""
        particles = self._repeated(max(since_ns, self._snapshots[0][0]), LOST, use, self._scatter).particles
        self._snapshots.clear()
        return particles

    def _scatter(self, particles: Particles) -> None:
        particles.planes.move(anywhere(self._setup, particles.planes, self._rng))

    def _repeated(
        self,
        since_ns: int,
        count: int,
        use: NDArray[np.bool_],
        change: Callable[[Particles], None] | None = None,
    ) -> ParticleFilter:
        """Return a filter of so many twins that repeat what was since a time, with known sensors and faults.

        `change` does to the particles what happened at that time.
        """
        begin_ns, start = next(each for each in reversed(self._snapshots) if each[0] <= since_ns)
        few, actions = start.drawn(GROUP, 0.5), [action for action, _ in self._actions]
        for action in actions:
            if begin_ns < action.time_ns <= since_ns:
                repeat(action, few)
        particles = few.drawn(count, 0.5)
        particles.changes[:] = 0
        if change is not None:
            change(particles)
        tracker = ParticleFilter(self._setup, particles, self._rng, min(count, FOUND))
        tracker.spread()
        for action in actions:
            if action.time_ns > since_ns:
                tracker.act(action, use)
        return tracker
