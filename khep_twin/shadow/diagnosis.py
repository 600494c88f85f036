"""Diagnosis: which fault explains a robot's replies better than a sound robot does.

The filter has twins of each fault that may begin (`changes`). A fault is raised when it has become certain;
the filter goes on with its twins, and considers its end. While replies surprise all of them, the last second
is repeated with twins that may be anywhere. Sensors, counters, lamps and the line are watched on their own.
"""

import math
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.exchanges import Exchange
from khep_twin.log.shadow_channels import Alarm, State, Suspicion
from khep_twin.shadow.actions import Action, Counted, Restarted, Seen, Waited
from khep_twin.shadow.candidates import Candidates
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.lamp_watch import LampWatch
from khep_twin.shadow.line_watch import LOSING, LineWatch
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.search import KEPT_NS, Search
from khep_twin.shadow.sensor_model import SensorModel
from khep_twin.shadow.sensor_watch import SensorWatch
from khep_twin.shadow.wheel_watch import WheelWatch

Floats = NDArray[np.float64]

WINDOW_NS = 1_300_000_000
"""Time before now from which on a robot that surprises is looked for everywhere [ns]."""

SURPRISE_S = 0.7
"""Time constant over which surprise is summed [s]."""

SURPRISED = 3.0
"""Surprise of one sensor from which on the robot may be elsewhere."""

STARTLED = 1.2
"""Surprise of one sensor without which nothing has begun: what explains readings a little better for long
explains errors of the model."""

WAITED_NS = 1_000_000_000
"""Time for which replies surprise before it is looked for everywhere [ns]."""

TRIED_NS = NS_PER_S
"""Interval at which it is [ns]."""

EARLIER_NS = NS_PER_S // 2
"""Time by which a fault may seem to begin before replies surprise [ns]."""

RAISED = 9.0
"""Logarithm of the odds from which on it is elsewhere."""

SURE, NAMED = 0.95, 0.5
"""Probabilities from which on there is a fault, of any name, and from which on it has that name."""

SUSPECTED = 0.2
"""Probability from which on a fault is suspected (assumed)."""

TOLD_NS = NS_PER_S
"""Time for which replies show a fault before it has a name [ns]."""

SETTLED_NS = 5 * NS_PER_S
"""Time for which a fault is probable before it is taken for granted, beside which others may begin [ns]."""

FOUND_NS = 5 * NS_PER_S
"""Time of replies without surprise after which a pose that was searched counts as found [ns]."""

LIFTED = "robot lifted"


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
        lit = bool(tracker.particles.planes.lamps.names)
        self._sensors = SensorWatch(self._model.quiet, self._model.limit, lit)
        self._wheels, self._line = WheelWatch(), LineWatch()
        self._lamps = LampWatch(tracker.particles.planes.lamps.names)
        self._counted: Floats | None = None
        self._late = False
        self._begins = Candidates(setup)
        self._present: list[tuple[Hypothesis, Alarm]] = []
        self._leading: tuple[Hypothesis, Alarm] | None = None
        self._others: list[Alarm] = []
        self._search = Search(setup, rng)
        self._surprise: Floats = np.zeros(8)
        self._seen_ns = self._tried_ns = 0
        self._lost_ns = 0
        self._vague_ns = -1, -1
        """Begin and end of the last time for which the pose was vague [ns]."""
        self._startled_ns = -KEPT_NS
        """Time of the last reply that surprised so much [ns]."""
        self._searches = not self._known
        self._surprised_ns: int | None = None
        self._onsets: deque[int] = deque(maxlen=20)
        """Times of the replies before those that began to surprise [ns]."""
        self.ended: tuple[Alarm, ...] = ()

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms that last, in the order of their begin."""
        faults = [*self._present] if self._leading is None else [*self._present, self._leading]
        found = [alarm for _, alarm in faults] + self._others + self._sensors.alarms
        found += self._wheels.alarms + self._lamps.alarms + self._line.alarms
        return tuple(sorted(found, key=lambda alarm: alarm.raised_ns))

    @property
    def state(self) -> State:
        """State of the estimated pose."""
        if self._others or self._searches:
            return State.LOST
        sees = self._surprised_ns is None and self._known
        return State.FOLLOWED if sees else State.UNSURE

    @property
    def suspected(self) -> tuple[Suspicion, ...]:
        """Faults that are suspected without an alarm, the most probable first."""
        raised = {alarm.fault for alarm in self.alarms}
        found: list[Suspicion] = []
        for number, probability in enumerate(self.filter.probabilities[1:].tolist(), 1):
            fault, begins, _ = self.filter.changes[number - 1]
            if begins and probability > SUSPECTED and fault.name not in raised:
                since_ns = self.filter.since_ns(number)
                found.append(Suspicion((fault.name,), fault.channel, since_ns, probability))
        return tuple(sorted(found, key=lambda each: -each.probability))

    def hear(self, exchange: Exchange) -> None:
        """Begin with an exchange, whose actions follow."""
        self.ended = self._line.hear(exchange)

    def follow(self, action: Action) -> Floats:
        """Follow an action; return what counters tell beyond commands (2,)."""
        self._search.note(action, self.filter.evidence)
        told = self.filter.act(action, self._sensors.sound)
        if isinstance(action, Seen):
            left = self.filter.range_left
            if self._lamps.alarms or ((self._others or not self._known) and self._lamps.names):
                left = np.zeros_like(left)  # Any sensor may be blinded.
            self.ended += self._sensors.see(action, left, self.filter.surprise)
        elif isinstance(action, Counted):
            if action.late_ns > action.time_ns or self._late:
                self._wheels.forget()
            elif self._counted is not None:
                turned = action.counters - self._counted
                self.ended += self._wheels.count(action.time_ns, turned, turned - told)
            self._counted, self._late = action.counters.astype(np.float64), action.late_ns > action.time_ns
        elif isinstance(action, Restarted):
            self._counted = None
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
        """Take a reply to N: diagnose, keep a snapshot, and search while it surprises."""
        time_ns = action.time_ns
        before_ns, self._seen_ns = self._seen_ns, time_ns
        passed_s = (time_ns - before_ns) * 1e-9
        self._surprise = self._surprise * math.exp(-passed_s / SURPRISE_S)
        self._surprise += np.maximum(self.filter.surprise - _USUAL, 0)
        self._end_lifted(time_ns)
        if not self._known and np.argmax(self.filter.probabilities) == 0:
            began_ns, last_ns = self._vague_ns
            self._vague_ns = (began_ns if last_ns == before_ns else time_ns), time_ns
        if self._surprise.max() > STARTLED:
            self._startled_ns = time_ns
        self._diagnose(time_ns)
        if self._surprise.max() <= SURPRISED:
            self._surprised_ns = None
        elif self._surprised_ns is None:
            self._surprised_ns = time_ns
            self._onsets.append(before_ns)
        elif (
            time_ns - max(self._tried_ns, self._surprised_ns) >= TRIED_NS
            and time_ns - self._surprised_ns >= WAITED_NS
            and self._leading is None
            and self._known
        ):
            self._tried_ns = time_ns
            self._find(time_ns, max(self._onsets[-1], time_ns - WINDOW_NS), RAISED)
        self._search.keep(time_ns, self.filter)

    @property
    def _known(self) -> bool:
        """True if the pose is known."""
        spread = self.filter.estimate(0).covariance.diagonal()
        return bool(spread[0] + spread[1] < _KNOWN * _KNOWN and spread[2] < _KNOWN_TURN * _KNOWN_TURN)

    def _diagnose(self, time_ns: int) -> None:
        """Raise and end alarms as changes become probable; consider those that may happen now."""
        tracker, leading = self.filter, self._leading
        probabilities = tracker.probabilities
        number = int(np.argmax(probabilities))
        sureness = float(probabilities[number])
        if leading is not None:
            leads = [each.begins and each.hypothesis.name == leading[0].name for each in tracker.changes]
            if probabilities[1:][leads].sum() < 1 - SURE:
                self._give_up(time_ns)
                leading = None
        if number > 0 and probabilities[0] < 1 - SURE and sureness > NAMED:
            fault, begins, _ = tracker.changes[number - 1]
            if not begins:
                if sureness > SURE:
                    self.ended += tuple(
                        replace(alarm, ended_ns=time_ns) for each, alarm in self._present if each is fault
                    )
                    self._present = [each for each in self._present if each[0] is not fault]
                    self._adopt(number, time_ns)
            elif leading is None or (leading[0].name != fault.name and sureness > SURE):
                since_ns = tracker.since_ns(number)
                vague = self._vague_ns[0] <= since_ns <= self._vague_ns[1]
                startled = self._startled_ns > since_ns - EARLIER_NS
                told = startled and time_ns - since_ns >= TOLD_NS and not vague
                if told and not self._find(time_ns, since_ns, 0.0, fault):
                    self._give_up(time_ns)
                    alarm = Alarm(fault.name, fault.channel, since_ns, time_ns, min(sureness, 0.999))
                    self._leading = fault, alarm
            elif leading[0].name == fault.name and sureness > SURE:
                if time_ns - leading[1].raised_ns > SETTLED_NS:
                    self._present.append((fault, leading[1]))
                    self._leading = None
                    self._adopt(number, time_ns)
                elif (
                    time_ns - max(self._tried_ns, leading[1].raised_ns) >= TRIED_NS
                    and time_ns - leading[1].since_ns < KEPT_NS
                ):
                    self._tried_ns = time_ns
                    self._find(time_ns, leading[1].since_ns, 0.0)
        ends = [FaultChange(fault, False) for fault, _ in self._present]
        tracker.consider([*self._candidates(time_ns), *ends])

    def _adopt(self, number: int, time_ns: int) -> None:
        """Take a change for what the robot is now."""
        self._give_up(time_ns)
        self.filter.adopt(number)
        self._surprise[:] = 0

    def _give_up(self, time_ns: int) -> None:
        """End the alarm of the fault that was the most probable one."""
        if self._leading is not None:
            self.ended += (replace(self._leading[1], ended_ns=time_ns),)
            self._leading = None

    def _find(self, time_ns: int, since_ns: int, least: float, fault: Hypothesis | None = None) -> bool:
        """Go on elsewhere, if the odds that the robot was put there, not of a fault, are above the least."""
        use = self._sensors.sound
        since_ns = next((each for each in self._onsets if each > since_ns - EARLIER_NS), since_ns)
        if self._search.odds(self.filter, since_ns, use, fault) < least:
            return False
        # Of a robot whose commands are lost the twins know as little.
        self._searches = self._searches or any(each.fault == LOSING for each in self._line.alarms)
        if not self._others and not self._searches:
            self._others.append(Alarm(LIFTED, "proximity", since_ns, time_ns, 0.999))
        self._give_up(time_ns)
        self.filter.take(self._search.lost(since_ns, use))
        self._surprise[:] = 0
        return True

    def _candidates(self, time_ns: int) -> list[FaultChange]:
        """Return the faults that may begin; where the pose is vague, they could be anything."""
        if self._others:
            return []
        if self._vague_ns[1] == time_ns:  # It may be so because of one of these.
            return [each for each in self.filter.changes if each.begins]
        present = {fault.name for fault, _ in self._present}
        stands = any(fault.channel == "wheels" for fault, _ in self._present)
        sensor, counted = int(np.argmax(self._surprise)), self._counted is not None
        return [
            each
            for each in self._begins.at(time_ns, self.filter, sensor, counted)
            if each.hypothesis.name not in present and not (stands and each.hypothesis.channel == "wheels")
        ]

    def _end_lifted(self, time_ns: int) -> None:
        """End the alarm of a robot that was put elsewhere, once its pose is known."""
        if not self._known or self._surprised_ns is not None:
            self._lost_ns = time_ns
        elif time_ns - self._lost_ns > FOUND_NS:
            self._searches = False
            self.ended += tuple(replace(alarm, ended_ns=time_ns) for alarm in self._others)
            self._others.clear()


_KNOWN, _KNOWN_TURN = 0.025, math.radians(10)
"""Standard deviations of a known position [m] and heading [rad] (assumed)."""

_USUAL = 0.15
"""Surprise of one reading that is usual."""
