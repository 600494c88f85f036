"""Diagnosis: which fault explains a robot's replies better than a sound robot does.

While replies surprise the filter, the last seconds are repeated from snapshots of its particles with twins of
each hypothesis (`hypotheses`), beside sound ones of the same particles. A fault is raised when its twins make
the replies more probable by far; the filter goes on with these twins. It ends when sound ones do better.
Sensors are watched on their own (`sensor_watch`): a stuck one repeats itself.
"""

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.exchanges import Exchange
from khep_twin.rollout.episode_setup import EpisodeSetup
from khep_twin.rollout.planar import plane as flat
from khep_twin.shadow import hypotheses
from khep_twin.shadow.actions import Action, Counted, Restarted, Seen, Waited, repeat
from khep_twin.shadow.alarms import Alarm
from khep_twin.shadow.hypotheses import Hypothesis, Missing, Moved, SlippingWheel, Unexpected
from khep_twin.shadow.lamp_watch import LampWatch
from khep_twin.shadow.line_watch import LOSING, LineWatch
from khep_twin.shadow.particle_filter import ParticleFilter, anywhere
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.sensor_model import SensorModel, log_of_sum
from khep_twin.shadow.sensor_watch import SensorWatch
from khep_twin.shadow.wheel_watch import WheelWatch

Floats = NDArray[np.float64]

GROUP = 120
"""Particles of each hypothesis."""

LOST, TRIED = 10_000, 2000
"""Particles of a robot that was put anywhere, and of one that may have been."""

SNAPSHOT_NS = 500_000_000
"""Interval of the snapshots [ns]."""

WINDOWS_NS = 1_300_000_000, 3_000_000_000, 6_000_000_000
"""Ages of the snapshots from which hypotheses are tried [ns]."""

MANY = 1500
"""Particles that go through a fault once it is raised."""

ONSETS_LATER = 30
"""Times within a window at which it may have begun, for these."""

ONSETS = 6
"""Times within a window at which a fault may begin or end, in equal parts of each hypothesis' particles."""

SURPRISE_S = 0.7
"""Time constant over which surprise is summed [s]."""

SURPRISED = 3.0
"""Surprise of one sensor from which on hypotheses are tried."""

WAITED_NS = 1_000_000_000
"""Time for which replies surprise before hypotheses are tried: enough to tell one from another [ns]."""

SETTLED_NS = 1_500_000_000
"""Time after a fault has been raised before another one is looked for [ns]."""

TRIED_NS = 400_000_000
"""Interval at which hypotheses are tried [ns]."""

RAISED = 9.0
"""Logarithm of the odds from which on a fault is raised."""

SURE = 0.95
"""Probability, among all that are tried, from which on it has a name."""

ENDED = 4.0
"""Logarithm of the odds from which on it ends."""

RARE = 6.0
"""Logarithm of the odds against a robot that is put elsewhere, beside a fault."""

NEAR = 0.09
"""Farthest distance of a thing from the robot's centre, to be seen or missed [m]."""

FOUND_NS = 5 * NS_PER_S
"""Time of replies without surprise after which a pose that was searched counts as found [ns]."""

LIFTED = "robot lifted"


class _Tried(NamedTuple):
    """A hypothesis that was tried.

    Attributes:
        odds: Logarithm of its odds against no change.
        hypothesis: Fault; None for a robot that was put elsewhere.
        begins: Whether it begins, or ends.
        since_ns: Begin of the window [ns].
        start: Particles then.
    """

    odds: float
    hypothesis: Hypothesis | None
    begins: bool
    since_ns: int
    start: Particles


class Diagnosis:
    """Filter of a robot, with the faults that it has.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        tracker: Filter.
        rng: Random stream.

    Attributes:
        filter: Filter, whose particles have the present faults.
        alarms: Alarms that last.
        ended: Alarms that the last exchange has ended.
    """

    def __init__(self, setup: EpisodeSetup, tracker: ParticleFilter, rng: np.random.Generator) -> None:
        self._setup, self.filter, self._rng = setup, tracker, rng
        self._model = SensorModel(tracker.particles.planes)
        self._sensors = SensorWatch(self._model.quiet, self._model.limit)
        self._wheels, self._line = WheelWatch(), LineWatch()
        self._lamps = LampWatch(tracker.particles.planes.lamps.names)
        self._counted: Floats | None = None
        self._things = hypotheses.things_of(setup)
        self._present: list[tuple[Hypothesis, Alarm]] = []
        self._others: list[Alarm] = []
        self._snapshots: deque[tuple[int, Particles, float]] = deque()
        self._actions: deque[Action] = deque()
        self._surprise: Floats = np.zeros(8)
        self._seen_ns = self._tried_ns = 0
        self._changed_ns = -SETTLED_NS
        self._lost_ns = 0
        self._searches = not self._known
        self._surprised_ns: int | None = None
        self.ended: tuple[Alarm, ...] = ()

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms that last, in the order of their begin."""
        found = [alarm for _, alarm in self._present] + self._others + self._sensors.alarms
        found += self._wheels.alarms + self._lamps.alarms + self._line.alarms
        return tuple(sorted(found, key=lambda alarm: alarm.raised_ns))

    def hear(self, exchange: Exchange) -> None:
        """Begin with an exchange, whose actions follow."""
        self.ended = self._line.hear(exchange)

    def follow(self, action: Action) -> Floats:
        """Follow an action; return what counters tell beyond commands (2,)."""
        told = self.filter.act(action, self._sensors.sound)
        if isinstance(action, Seen):
            self.ended += self._sensors.see(action, self.filter.range_left, self.filter.surprise)
        elif isinstance(action, Counted):
            if self._counted is not None:
                turned = action.counters - self._counted
                self.ended += self._wheels.count(action.time_ns, turned, turned - told)
            self._counted = action.counters.astype(np.float64)
        elif isinstance(action, Restarted):
            self._counted = None
        self._actions.append(action)
        if isinstance(action, Seen):
            self._see(action)
        return told

    def see_light(self, time_ns: int, readings: NDArray[np.int64]) -> Floats:
        """Take a reply to O; return the expected readings (8,) [counts]."""
        self.filter.act(Waited(time_ns), self._sensors.sound)
        if self._known:
            self.ended += self._lamps.see(time_ns, readings, self.filter.particles)
        return self._lamps.expected

    def _see(self, action: Seen) -> None:
        """Take a reply to N: keep a snapshot, and try hypotheses while it surprises."""
        time_ns = action.time_ns
        passed_s = (time_ns - self._seen_ns) * 1e-9
        self._seen_ns = time_ns
        self._surprise = self._surprise * math.exp(-passed_s / SURPRISE_S)
        self._surprise += np.maximum(self.filter.surprise - _USUAL, 0)
        self._end_lifted(time_ns)
        if self._surprise.max() <= SURPRISED:
            self._surprised_ns = None
        elif self._surprised_ns is None:
            self._surprised_ns = time_ns
        elif (
            time_ns - max(self._tried_ns, self._surprised_ns) >= TRIED_NS
            and time_ns - self._surprised_ns >= WAITED_NS
            and time_ns - self._changed_ns >= SETTLED_NS
            and self._known
        ):
            self._tried_ns = time_ns
            self._try(time_ns)
        if not self._snapshots or time_ns - self._snapshots[-1][0] >= SNAPSHOT_NS:
            small = self.filter.particles.drawn(GROUP, self._rng.random())
            self._snapshots.append((time_ns, small, self.filter.evidence))
            while self._snapshots[0][0] < time_ns - WINDOWS_NS[-1] - SNAPSHOT_NS:
                self._snapshots.popleft()
            while self._actions[0].time_ns < self._snapshots[0][0]:
                self._actions.popleft()

    @property
    def _known(self) -> bool:
        """Whether the pose is known."""
        covariance = self.filter.estimate(0).covariance
        return covariance[0, 0] + covariance[1, 1] < _KNOWN * _KNOWN

    def _try(self, time_ns: int) -> None:
        """Try all hypotheses from snapshots of different ages; adopt the best if it is better by far."""
        tried: list[_Tried] = []
        for age_ns in WINDOWS_NS:
            older = [each for each in self._snapshots if each[0] <= time_ns - age_ns]
            if not older:
                continue
            since_ns, start, evidence = older[-1]
            tried += self._compared(since_ns, start, self.filter.evidence - evidence, time_ns)
        if not tried:
            return
        names: dict[tuple[str, bool], float] = {}
        for each in tried:
            key = "" if each.hypothesis is None else each.hypothesis.name, each.begins
            names[key] = max(names.get(key, -math.inf), each.odds)
        odds, hypothesis, begins, since_ns, start = max(tried, key=lambda each: each.odds)
        sureness = 1 / sum(math.exp(min(each - odds, 0)) for each in (0.0, *names.values()))
        if odds < (RAISED if begins else ENDED) or sureness < SURE:
            return
        alarm = Alarm("", "", since_ns, time_ns, min(sureness, 0.999))
        if hypothesis is None:
            # Of a robot whose commands are lost the twins know as little.
            self._searches = self._searches or any(each.fault == LOSING for each in self._line.alarms)
            if not self._others and not self._searches:
                self._others.append(replace(alarm, fault=LIFTED, channel="proximity"))
        elif begins:
            named = replace(alarm, fault=hypothesis.name, channel=hypothesis.channel)
            self._present.append((hypothesis, named))
        else:
            self.ended += tuple(
                replace(each, ended_ns=time_ns) for fault, each in self._present if fault is hypothesis
            )
            self._present = [each for each in self._present if each[0] is not hypothesis]
        self.filter.take(self._refined(since_ns, start, hypothesis, begins))
        self._changed_ns = time_ns
        self._snapshots.clear()
        self._surprise[:] = 0

    def _refined(
        self, since_ns: int, start: Particles, hypothesis: Hypothesis | None, begins: bool
    ) -> Particles:
        """Return many particles that have gone through a hypothesis since a snapshot."""
        if hypothesis is None:
            particles = self._anywhere(start, LOST)
        else:
            particles = start.drawn(MANY, self._rng.random())
        tracker = ParticleFilter(self._setup, particles, self._rng, MANY)
        tracker.spread()
        actions = [action for action in self._actions if action.time_ns > since_ns]
        end_ns = actions[-1].time_ns
        onsets = deque(
            since_ns + (end_ns - since_ns) * onset // ONSETS_LATER for onset in range(ONSETS_LATER)
        )
        size, turn = MANY // ONSETS_LATER, 0
        for action in actions:
            while hypothesis is not None and onsets and onsets[0] <= action.time_ns:
                # In any order: the particles may have been drawn anew meanwhile.
                part = tracker.particles.taken(slice(turn * size, (turn + 1) * size))
                if begins:
                    hypothesis.begin(part, self._rng)
                else:
                    hypothesis.end(part)
                turn += 1
                onsets.popleft()
            tracker.act(action, self._sensors.sound, renew=not onsets or hypothesis is None)
        return tracker.particles

    def _compared(self, since_ns: int, start: Particles, sound: float, time_ns: int) -> list[_Tried]:
        """Return the odds of each hypothesis against no change, whether it begins, since when, and its twins.

        Args:
            since_ns: Time of the snapshot [ns].
            start: Particles of the snapshot.
            sound: Evidence of the filter since then.
            time_ns: Present time [ns].
        """
        changes = [(fault, True) for fault in self._candidates(start)]
        changes += [(fault, False) for fault, _ in self._present]
        groups = 1 + len(changes)
        all_of_them = start.taken(np.tile(np.arange(GROUP), groups))
        parts = [all_of_them.taken(slice(i * GROUP, (i + 1) * GROUP)) for i in range(groups)]
        actions = [action for action in self._actions if action.time_ns > since_ns]
        onsets = [since_ns + (time_ns - since_ns) * onset // ONSETS for onset in range(ONSETS)]
        for action in actions:
            while onsets and onsets[0] <= action.time_ns:
                turn = slice(
                    (ONSETS - len(onsets)) * GROUP // ONSETS, (ONSETS + 1 - len(onsets)) * GROUP // ONSETS
                )
                for (fault, begins), part in zip(changes, parts[1:], strict=True):
                    if begins:
                        fault.begin(part.taken(turn), self._rng)
                    else:
                        fault.end(part.taken(turn))
                del onsets[0]
            repeat(action, all_of_them)
            if isinstance(action, Seen):
                _, _, logs = self._model.explain(all_of_them, action.readings, self._sensors.sound)
                all_of_them.logs += logs.sum(axis=1)
            elif isinstance(action, Counted):
                all_of_them.count(action.counters)
        evidence = [log_of_sum(part.logs) for part in parts]
        none = max(evidence[0], sound)
        found = [
            _Tried(each - none - (fault.rare if begins else 0.0), fault, begins, since_ns, start)
            for each, (fault, begins) in zip(evidence[1:], changes, strict=True)
        ]
        short = time_ns - since_ns < WINDOWS_NS[1]
        if short and none < -(RAISED + RARE):
            lost = ParticleFilter(self._setup, self._anywhere(start, TRIED), self._rng, TRIED)
            for action in actions:
                lost.act(action, self._sensors.sound)
            found.append(_Tried(lost.evidence - none - RARE, None, True, since_ns, start))
        return found

    def _candidates(self, start: Particles) -> list[Hypothesis]:
        """Return the faults that may begin."""
        present = {fault.name for fault, _ in self._present}
        if self._others:  # its pose may still be another one
            return []
        present_wheels = any(fault.channel == "wheels" for fault, _ in self._present)
        counted = any(isinstance(action, Counted) for action in self._actions)
        found: list[Hypothesis] = []
        if not present_wheels:
            # Counters tell on their own which wheel stands or is slow.
            found += [
                each for each in hypotheses.of_wheels() if not counted or isinstance(each, SlippingWheel)
            ]
        x, y, _ = self.filter.estimate(0).pose
        things = start.planes.things[0]
        for name, rows in self._things.items():
            reach = [
                math.hypot(x - things[row, flat.CENTRE_X], y - things[row, flat.CENTRE_Y])
                - things[row, flat.LENGTH]
                for row in rows
            ]
            if min(reach) < NEAR:
                found += [Missing(name, rows), Moved(name, rows)]
        sensor = int(np.argmax(self._surprise))
        found.append(Unexpected(sensor, self.filter.estimate(0).pose))
        return [fault for fault in found if fault.name not in present]

    def _anywhere(self, start: Particles, count: int) -> Particles:
        """Return particles of a robot that may be anywhere, with the gains and faults that are known."""
        particles = start.drawn(count, 0.5)
        particles.planes.move(anywhere(self._setup, particles.planes, self._rng))
        return particles

    def _end_lifted(self, time_ns: int) -> None:
        """End the alarm of a robot that was put elsewhere, once its pose is known."""
        if not self._known or self._surprised_ns is not None:
            self._lost_ns = time_ns
        elif time_ns - self._lost_ns > FOUND_NS:
            self._searches = False
            self.ended += tuple(replace(alarm, ended_ns=time_ns) for alarm in self._others)
            self._others.clear()


_KNOWN = 0.03
"""Standard deviation of a known position [m]."""

_USUAL = 0.15
"""Surprise of one reading that is usual."""
