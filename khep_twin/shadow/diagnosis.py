"""Diagnosis: which fault explains a robot's replies better than a sound robot does.

While replies are as expected, the filter has sound twins alone. Once they surprise, a new one begins where
they did not yet, with twins of each fault that may begin (`changes`), of each that may end, and of a robot
that was put elsewhere (`search`). `FaultWatch` tells which has become certain; the filter goes on with its
twins. `PoseWatch` has the state of the pose: while it is lost, no fault of wheels or things is considered.
Sensors, counters, lamps and the line are watched on their own. All limits are those of `THRESHOLDS`.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.exchanges import Exchange
from khep_twin.log.shadow_channels import Alarm, PoseState, Suspicion
from khep_twin.shadow.actions import LATE_NS, Action, Counted, Restarted, Seen, Waited
from khep_twin.shadow.candidates import Candidates
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.displacements import Displaced, Lifted
from khep_twin.shadow.fault_watch import Alike, FaultWatch
from khep_twin.shadow.lamp_watch import LampWatch
from khep_twin.shadow.line_watch import SHOWN_NS, LineWatch
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.pose_watch import Onset, PoseWatch
from khep_twin.shadow.search import Search
from khep_twin.shadow.sensor_model import UNLIT, SensorModel, range_left_at_least
from khep_twin.shadow.sensor_watch import SensorWatch
from khep_twin.shadow.thresholds import THRESHOLDS
from khep_twin.shadow.wheel_watch import WheelWatch

Floats = NDArray[np.float64]


class Diagnosis:
    """Filter of a robot, with the faults that it has.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        tracker: Filter.
        rng: Random stream.

    Attributes:
        filter: Filter, whose particles have the present faults.
        ended: Alarms that the last exchange has ended.
    """

    def __init__(self, setup: EpisodeSetup, tracker: ParticleFilter, rng: np.random.Generator) -> None:
        planes = tracker.particles.planes
        self.filter, self._rng = tracker, rng
        self._lit = bool(planes.lamps.names)
        model = SensorModel(planes)
        self._quiet = model.quiet
        self._sensors = SensorWatch(model.quiet, model.limit, self._lit)
        self._wheels, self._line = WheelWatch(), LineWatch()
        self._lamps = LampWatch(setup.playpen, planes)
        self._begins, self._search = Candidates(setup), Search(setup, rng)
        self._pose = PoseWatch(PoseState.FOLLOWED if self._known else PoseState.LOST)
        self._faults = FaultWatch()
        self._lifted: tuple[Alarm, ...] = ()
        self._counted: Floats | None = None
        self._late = False
        self._tried_ns = 0
        self._onset: Onset | None = None
        self._has_found = self._doubts = False
        self.ended: tuple[Alarm, ...] = ()

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms that last, in the order of their begin."""
        found = [*self._faults.alarms, *self._lifted, *self._sensors.alarms]
        found += self._wheels.alarms + self._lamps.alarms + self._line.alarms
        return tuple(sorted(found, key=lambda alarm: alarm.raised_ns))

    @property
    def state(self) -> PoseState:
        """State of the estimated pose."""
        return self._pose.state

    @property
    def suspected(self) -> tuple[Suspicion, ...]:
        """Faults that are suspected without an alarm, the most probable first."""
        found = sorted((*self._faults.suspected, *self._lamps.suspected), key=lambda each: -each.probability)
        return tuple(replace(each, probability=THRESHOLDS.believed * each.probability) for each in found)

    def hear(self, exchange: Exchange) -> None:
        """Begin with an exchange, whose actions follow."""
        self.ended = self._line.hear(exchange)
        if self._pose.is_blind(exchange.heard_ns) and not self._known:
            self._pose.doubt(exchange.heard_ns)

    def follow(self, action: Action) -> Floats:
        """Follow an action; return what counters tell beyond commands (2,)."""
        self._search.note(action)
        use = self._sensors.sound
        if isinstance(action, Seen) and self._lamps.alarms:
            # Which sensors the lamps leave their range is not known.
            use &= (action.readings > self._quiet) & (self.filter.range_left > UNLIT)
        told = self.filter.act(action, use)
        if isinstance(action, Seen):
            left = self.filter.range_left
            is_sure = self.state is PoseState.FOLLOWED and self._pose.is_proven
            is_sure &= action.time_ns - self._tried_ns > THRESHOLDS.window_ns
            if self._lamps.alarms or (self._lit and not is_sure):
                left = np.zeros_like(left)  # Any sensor may be blinded.
            elif self._lit:
                left = np.minimum(left, range_left_at_least(self.filter.particles))
            self.ended += self._sensors.see(action, left, self.filter.surprise)
            self._see(action.time_ns, bool(action.readings.max() > THRESHOLDS.in_sight))
        elif isinstance(action, Counted):
            self._count(action, told)
        elif isinstance(action, Restarted):
            self._counted = None
        return told

    def see_light(self, time_ns: int, readings: NDArray[np.int64]) -> Floats:
        """Take a reply to O; return the expected readings (8,) [counts], NaN for a pose not known well."""
        self.filter.act(Waited(time_ns), self._sensors.sound)
        is_followed = self.state is PoseState.FOLLOWED
        if not (is_followed and self._knows(THRESHOLDS.lit, THRESHOLDS.lit_turn)):
            return np.full_like(self._lamps.expected, np.nan)
        self.ended += self._lamps.see(time_ns, readings, self.filter.particles)
        return self._lamps.expected

    def _count(self, action: Counted, told: Floats) -> None:
        """Take a reply to H, of which twins tell a part of the pulses (2,)."""
        is_late = action.late_ns - action.time_ns >= LATE_NS
        if is_late or self._late:
            self._wheels.forget()
        elif self._counted is not None:
            turned = action.counters - self._counted
            self.ended += self._wheels.count(action.time_ns, turned, turned - told)
        self._counted, self._late = action.counters.astype(np.float64), is_late

    def _see(self, time_ns: int, in_sight: bool) -> None:
        """Take a reply to N: diagnose, keep a snapshot, and search for what has happened if it surprises."""
        if self._lifted and time_ns - self._lifted[0].raised_ns > SHOWN_NS:
            self.ended += tuple(replace(alarm, ended_ns=time_ns) for alarm in self._lifted)
            self._lifted = ()
        is_sound = np.argmax(self.filter.probabilities) == 0
        is_known = self._known or not is_sound
        self._pose.see(time_ns, self.filter.surprise, in_sight=in_sight, is_known=is_known)
        self._begins.pass_by(time_ns, self.filter)
        self._diagnose(time_ns)
        self._look_back(time_ns)
        self._search.keep(time_ns, self.filter)

    def _look_back(self, time_ns: int) -> None:
        """Search for what has happened if replies surprise; drop faults that are improbable."""
        onset, before = self._pose.onset, self._onset
        if self._doubts and onset is None:
            onset = before
        nothing = float(self.filter.probabilities[0])
        is_explained, passed_ns = nothing < THRESHOLDS.explained, time_ns - self._tried_ns
        if onset is None:
            if nothing > THRESHOLDS.dropped and passed_ns >= THRESHOLDS.dropped_ns:
                self.filter.consider([])
            elif self.filter.changes and passed_ns >= THRESHOLDS.window_ns and self._faults.leading is None:
                self._give_up(time_ns)
            return
        if before is not None and (is_explained or time_ns - before.calm_ns < THRESHOLDS.window_ns):
            onset = before.later(onset)  # The last search has found too little, or nothing.
        again_ns = min((time_ns - onset.jumps_ns[0]) // 2, THRESHOLDS.tried_ns)
        was_known = not self._pose.was_vague(onset.calm_ns)
        if not (was_known or self._doubts) or passed_ns < max(again_ns, THRESHOLDS.waited_ns):
            return
        self._tried_ns, self._doubts, self._onset = time_ns, False, onset
        changes = self._candidates(self._onset)
        found = self._search.again(self.filter, self._onset, changes, self._sensors.sound)
        if found is not None:
            self.filter = found
            self._pose.explain()
            self._has_found = bool(found.probabilities[0] <= THRESHOLDS.explained)
            if not self._has_found:
                self._pose.expect()

    def _give_up(self, time_ns: int) -> None:
        """Go on with a sound robot, if one is likely, as nothing has told a fault for so long."""
        is_fault = [False, *(each.hypothesis.is_fault for each in self.filter.changes)]
        sound = np.where(is_fault, 0.0, self.filter.probabilities)
        if sound.max() > 1 - THRESHOLDS.sure:
            self._adopt(int(sound.argmax()), time_ns)

    def _was_lossy(self, time_ns: int) -> bool:
        """Return whether the line lost commands at a time, or lately then [ns]."""
        return time_ns <= self._line.lossy_ns + THRESHOLDS.found_ns

    def _was_obscure(self, time_ns: int) -> bool:
        """Return whether twins knew little of what the robot did at a time, or lately then [ns]."""
        return self._was_lossy(time_ns) or self._pose.was_vague(time_ns, THRESHOLDS.found_ns)

    def _was_crippled(self, time_ns: int) -> bool:
        """Return whether a wheel failed at a time or since [ns]: what else seems wrong follows from that."""
        return any(fault.channel == "wheels" for fault in self._faults.had(time_ns))

    @property
    def _known(self) -> bool:
        """True if the pose is known."""
        return self._knows(THRESHOLDS.known, THRESHOLDS.known_turn)

    def _knows(self, place: float, turn: float) -> bool:
        """Return whether the pose is known to these standard deviations [m, rad]."""
        spread = self.filter.estimate(0).covariance.diagonal()
        return bool(spread[0] + spread[1] < place**2 and spread[2] < turn**2)

    def _diagnose(self, time_ns: int) -> None:
        """Raise and end alarms as changes become probable."""
        tracker, faults = self.filter, self._faults
        if faults.has_gone(tracker):
            self.ended += faults.give_up(time_ns)
        number, ended = faults.over(time_ns, tracker)
        certain = faults.see(time_ns, tracker)
        if number:
            self.ended += ended
            self._adopt(number, time_ns)
        elif certain is not None:
            self._go_on(certain, time_ns)

    def _begin(self, certain: Alike, time_ns: int) -> None:
        """Raise the alarm of faults that are certain, once replies have shown them for long enough."""
        since_ns = certain.since_ns
        if time_ns - since_ns < THRESHOLDS.told_ns or not self._faults.is_named(certain, time_ns):
            return
        if not certain.faults[0].is_fault:
            self._adopt(certain.numbers[0], time_ns)
        elif not self._has_found:
            self._doubts = True  # It became probable after the search, where no other place can.
        elif isinstance(certain.faults[0], Lifted):
            self._lift(certain, time_ns)
        elif not self._was_obscure(since_ns):
            self._faults.raise_alarm(certain, time_ns)

    def _lift(self, certain: Alike, time_ns: int) -> None:
        """Go on where the robot was put."""
        if self._pose.is_proven and not (self._was_crippled(time_ns) or self._was_obscure(certain.since_ns)):
            self._lifted = (self._faults.alarm(certain, time_ns),)
        self._adopt(certain.numbers[0], time_ns)
        self._pose.lose()

    def _go_on(self, certain: Alike, time_ns: int) -> None:
        """Begin with faults that are certain; settle those of an alarm."""
        faults = self._faults
        if faults.leading is None or faults.leading[0].key != certain.key:
            self.ended += faults.give_up(time_ns)
            self._begin(certain, time_ns)
            return
        alarm = faults.leading[1]
        if faults.rename(certain):
            self.ended += (replace(alarm, ended_ns=time_ns),)
        elif time_ns - alarm.raised_ns > THRESHOLDS.settled_ns:
            faults.settle(certain)
            self._adopt(certain.numbers[0], time_ns)

    def _adopt(self, number: int, time_ns: int) -> None:
        """Take a change for what the robot is now."""
        self.ended += self._faults.give_up(time_ns)
        self.filter.adopt(number)
        self._pose.explain()

    def _candidates(self, onset: Onset) -> list[FaultChange]:
        """Return what may have happened since the pose was confirmed last."""
        begin_ns = self._search.begin_ns(onset)
        present = {fault.name: fault for fault in self._faults.had(begin_ns)}
        changes = [FaultChange(each, True) for each in (Lifted(), Displaced())]
        changes += [FaultChange(fault, False) for fault in present.values()]
        if self._was_crippled(begin_ns) or not self._pose.is_proven or self._was_lossy(onset.calm_ns):
            return changes
        begins = self._begins.since(onset.calm_ns, self._counted is not None)
        return changes + [each for each in begins if each.hypothesis.name not in present]
