"""Diagnosis: which fault explains a robot's replies better than a robot without faults does.

While replies are as expected, all twins (particles) of the filter are without a change. After unexpected
replies, when due by `SearchSchedule`, `Search` replays the last actions with twins of each fault that may
have started or ended (`changes`), and of a robot put elsewhere. `FaultWatch` decides which one is certain;
the filter continues with its twins. `PoseWatch` has the state of the pose; while it is lost, faults of wheels
and obstacles are not considered. Other watches cover sensors, counters, lamps and the line (`thresholds`).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.exchanges import Exchange
from khep_twin.log.shadow_channels import Alarm, PoseState, Suspicion
from khep_twin.shadow.actions import Action, CounterReply, ProximityReply, RangeReply, Restart, Silence
from khep_twin.shadow.candidates import Candidates
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.displacements import Displaced, Lifted
from khep_twin.shadow.fault_watch import AmbiguityGroup, FaultWatch
from khep_twin.shadow.lamp_watch import LampWatch
from khep_twin.shadow.line_watch import LineWatch
from khep_twin.shadow.particle_filter import Floats, ParticleFilter
from khep_twin.shadow.pose_watch import Onset, PoseWatch
from khep_twin.shadow.search import Search
from khep_twin.shadow.search_schedule import SearchSchedule, SearchState
from khep_twin.shadow.sensor_model import UNLIT, SensorModel, min_usable_range
from khep_twin.shadow.sensor_watch import SensorWatch
from khep_twin.shadow.thresholds import THRESHOLDS
from khep_twin.shadow.wheel_watch import WheelWatch


class Diagnosis:
    """Filter of a robot, with its watches.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        tracker: Filter.
        rng: Random stream.

    Attributes:
        filter: Filter, whose particles have the present faults.
        ended: Alarms that the last exchange has ended.
    """

    def __init__(self, setup: EpisodeSetup, tracker: ParticleFilter, rng: np.random.Generator) -> None:
        twins = tracker.particles.twins
        model = SensorModel(twins)
        self.filter = tracker
        self.ended: tuple[Alarm, ...] = ()
        self._has_lamps = bool(twins.lamps.names)
        self._quiet = model.quiet
        self._sensors = SensorWatch(twins.n_sensors, model.quiet, model.limit, self._has_lamps)
        self._wheels = WheelWatch(setup.entry.body.pulse_length, twins.motor_lag)
        self._lamps = LampWatch(setup.playpen, twins)
        self._line = LineWatch(setup.entry.robot_model.dialect)
        self._faults = FaultWatch()
        self._pose = PoseWatch(PoseState.FOLLOWED if self._is_pose_known else PoseState.LOST)
        self._candidates = Candidates(setup)
        self._search = Search(setup, rng)
        self._schedule = SearchSchedule()

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms that last, in the order of their starts."""
        alarms = [*self._faults.alarms, *self._sensors.alarms]
        alarms += self._wheels.alarms + self._lamps.alarms + self._line.alarms
        return tuple(sorted(alarms, key=lambda alarm: alarm.raised_ns))

    @property
    def state(self) -> PoseState:
        """State of the estimated pose."""
        return self._pose.state

    @property
    def suspected(self) -> tuple[Suspicion, ...]:
        """Faults that are suspected without an alarm, the most probable first."""
        suspicions = [*self._faults.suspected, *self._lamps.suspected]
        suspicions.sort(key=lambda item: -item.probability)
        factor = THRESHOLDS.suspicion_factor
        return tuple(replace(item, probability=factor * item.probability) for item in suspicions)

    def start_exchange(self, exchange: Exchange) -> None:
        """Begin an exchange (a command and its reply); calls of `follow` with its actions come next."""
        self.ended = self._line.update(exchange)
        if self._pose.is_blind(exchange.reply_ns) and not self._is_pose_known:
            self._pose.set_unsure(exchange.reply_ns)

    def follow(self, action: Action) -> Floats:
        """Follow an action; return the residual of counters (2,), NaN for any other action."""
        self._search.add_action(action)
        is_used = self._sensors.is_sound
        if isinstance(action, ProximityReply) and self._lamps.alarms:
            # It is not known which sensors the lamps leave their range.
            is_used &= (action.readings > self._quiet) & (self.filter.usable_range > UNLIT)
        residual = self.filter.follow(action, is_used)
        if isinstance(action, ProximityReply):
            usable_range = self._usable_range(action.time_ns)
            surprisal = self.filter.surprisal[: len(action.readings)]
            self.ended += self._sensors.update(action, usable_range, surprisal)
        if isinstance(action, RangeReply):
            self._update(action)
        elif isinstance(action, CounterReply):
            is_free = self.state is not PoseState.LOST and self.filter.drives_freely
            self.ended += self._wheels.take_counters(action, residual, is_free)
        elif isinstance(action, Restart):
            self._wheels.restart()
        return residual

    def update_lamps(self, time_ns: int, readings: NDArray[np.int64]) -> Floats:
        """Update lamps by a reply to O; return expected readings (s,) [counts], NaN at an unsure pose."""
        self.filter.follow(Silence(time_ns), self._sensors.is_sound)
        is_followed = self.state is PoseState.FOLLOWED
        if not (is_followed and self._is_within(THRESHOLDS.lamp_place, THRESHOLDS.lamp_turn)):
            return np.full_like(self._lamps.expected, np.nan)
        self.ended += self._lamps.update(time_ns, readings, self.filter.particles)
        return self._lamps.expected

    def _usable_range(self, time_ns: int) -> Floats:
        """Return the part of each sensor's range that the lamps leave at the least (s,)."""
        usable_range = self.filter.usable_range
        is_certain = self.state is PoseState.FOLLOWED and self._pose.is_proven
        is_certain &= time_ns - self._schedule.last_ns > THRESHOLDS.window_ns
        if self._lamps.alarms or (self._has_lamps and not is_certain):
            return np.zeros_like(usable_range)  # Any sensor may be blinded.
        if self._has_lamps:
            return np.minimum(usable_range, min_usable_range(self.filter.particles))
        return usable_range

    def _update(self, reply: RangeReply) -> None:
        """Update alarms by a reply, search for changes if a search is due, and save a snapshot."""
        time_ns = reply.time_ns
        self.ended += self._faults.end_events(time_ns)
        is_changed = np.argmax(self.filter.probabilities) != 0
        is_known = self._is_pose_known or bool(is_changed)
        self._pose.update(time_ns, self.filter.surprisal, in_sight=reply.in_sight, is_known=is_known)
        self._candidates.record_encounters(time_ns, self.filter)
        self._diagnose(time_ns)
        self._search_if_due(time_ns)
        self._search.save_snapshot(time_ns, self.filter)

    def _search_if_due(self, time_ns: int) -> None:
        """Search for changes if a search is due; otherwise drop changes that are improbable."""
        unchanged = float(self.filter.probabilities[0])
        is_explained = unchanged < THRESHOLDS.explained_below
        onset = self._schedule.pending_onset(time_ns, self._pose.onset, is_explained)
        if onset is None:
            self._drop_changes(time_ns, unchanged)
        elif self._schedule.is_due(time_ns, onset, not self._pose.was_unknown(onset.calm_ns)):
            self._schedule.start(time_ns, onset)
            changes = self._changes_since(onset)
            candidate = self._search.search_since(self.filter, onset, changes, self._sensors.is_sound)
            if candidate is not None:
                self._adopt_search(candidate)

    def _adopt_search(self, candidate: ParticleFilter) -> None:
        """Continue with the filter that a search returned."""
        self.filter = candidate
        self._pose.reset_surprisal()
        is_found = candidate.probabilities[0] <= THRESHOLDS.explained_below
        self._schedule.state = SearchState.CHANGE_FOUND if is_found else SearchState.NOT_FOUND
        if not is_found:
            self._pose.raise_threshold()

    def _drop_changes(self, time_ns: int, unchanged: float) -> None:
        """Drop changes that no reply has shown for long enough after the last search."""
        passed_ns = time_ns - self._schedule.last_ns
        if unchanged > THRESHOLDS.drop_above and passed_ns >= THRESHOLDS.drop_delay_ns:
            self.filter.consider_changes([])
        elif self.filter.changes and passed_ns >= THRESHOLDS.window_ns and self._faults.leading is None:
            is_fault = [False, *(change.hypothesis.is_fault for change in self.filter.changes)]
            no_fault_probabilities = np.where(is_fault, 0.0, self.filter.probabilities)
            if no_fault_probabilities.max() > 1 - THRESHOLDS.certain_above:
                self._adopt(int(no_fault_probabilities.argmax()), time_ns)

    def _was_lossy(self, time_ns: int) -> bool:
        """Return whether the line lost commands at a time [ns], or shortly before."""
        return time_ns <= self._line.lossy_ns + THRESHOLDS.relocated_ns

    def _was_uncertain(self, time_ns: int) -> bool:
        """Return whether the pose or the commands were uncertain at a time [ns], or shortly before."""
        return self._was_lossy(time_ns) or self._pose.was_unknown(time_ns, THRESHOLDS.relocated_ns)

    def _had_wheel_fault(self, time_ns: int) -> bool:
        """Return whether a wheel failed at a time [ns] or since, which may cause all other deviations."""
        return any(fault.channel == "wheels" for fault in self._faults.settled_since(time_ns))

    @property
    def _is_pose_known(self) -> bool:
        return self._is_within(THRESHOLDS.known_place, THRESHOLDS.known_turn)

    def _is_within(self, position: float, heading: float) -> bool:
        """Return whether the pose is known to these standard deviations [m, rad]."""
        variances = self.filter.estimate(0).covariance.diagonal()
        position *= self.filter.particles.twins.scale
        return bool(variances[0] + variances[1] < position**2 and variances[2] < heading**2)

    def _diagnose(self, time_ns: int) -> None:
        """Raise and end alarms as changes become probable."""
        tracker, faults = self.filter, self._faults
        if faults.is_refuted(tracker):
            self.ended += faults.drop_leading(time_ns)
        number, ended = faults.end_settled(time_ns, tracker)
        group = faults.update(time_ns, tracker)
        if number:
            self.ended += ended
            self._adopt(number, time_ns)
        elif group is None:
            return
        elif faults.leading is None or faults.leading[0].key != group.key:
            self.ended += faults.drop_leading(time_ns)
            self._accept(group, time_ns)
        else:
            self._confirm(group, faults.leading[1], time_ns)

    def _accept(self, group: AmbiguityGroup, time_ns: int) -> None:
        """Raise the alarm of a certain group, or adopt its change, once replies have shown it long enough."""
        since_ns = group.since_ns
        is_shown = time_ns - since_ns >= THRESHOLDS.alarm_delay_ns
        if not (is_shown and self._faults.is_distinguished(group, time_ns)):
            return
        if not group.hypotheses[0].is_fault:
            self._adopt(group.changes[0], time_ns)
        elif self._schedule.state is not SearchState.CHANGE_FOUND:
            self._schedule.state = SearchState.REPEAT
        elif isinstance(group.hypotheses[0], Lifted):
            if self._pose.is_proven and not (self._had_wheel_fault(time_ns) or self._was_uncertain(since_ns)):
                self._faults.show_event(group, time_ns)
            self._adopt(group.changes[0], time_ns)
            self._pose.lose()
        elif not self._was_uncertain(since_ns):
            self._faults.raise_alarm(group, time_ns)

    def _confirm(self, group: AmbiguityGroup, alarm: Alarm, time_ns: int) -> None:
        """Replace an alarm with several names by the certain fault's, or settle the fault after a delay."""
        if self._faults.rename(group):
            self.ended += (replace(alarm, ended_ns=time_ns),)
        elif time_ns - alarm.raised_ns > THRESHOLDS.settle_delay_ns:
            self._faults.settle(group)
            self._adopt(group.changes[0], time_ns)

    def _adopt(self, number: int, time_ns: int) -> None:
        """Continue with the particles of one change (0 for none) alone."""
        self.ended += self._faults.drop_leading(time_ns)
        self.filter.adopt(number)
        self._pose.reset_surprisal()

    def _changes_since(self, onset: Onset) -> list[FaultChange]:
        """Return the changes that may have happened since the last reply that confirmed the pose."""
        start_ns = self._search.start_ns(onset)
        settled = {fault.name: fault for fault in self._faults.settled_since(start_ns)}
        changes = [FaultChange(Lifted(), True), FaultChange(Displaced(), True)]
        changes += [FaultChange(fault, False) for fault in settled.values()]
        if self._had_wheel_fault(start_ns) or not self._pose.is_proven or self._was_lossy(onset.calm_ns):
            return changes
        starting = self._candidates.changes_since(onset.calm_ns, self._wheels.has_counters)
        return changes + [change for change in starting if change.hypothesis.name not in settled]
