"""Watch of faults by the probabilities of the particles that have them: suspicion, alarm, settled fault.

    none -- 20 % --> suspected -- 95 %, for a second --> alarm -- 5 s --> settled -- its end is 95 % --> none

Faults that look alike in the replies, such as a weak motor and a slipping wheel, form an ambiguity group: the
sum of their probabilities decides about the alarm, which names one fault, or all if none stands out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from khep_twin.log.shadow_channels import FAULT_SEPARATOR, Alarm, Suspicion
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.line_watch import SHOWN_NS
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.thresholds import THRESHOLDS

_MIN_SHARE = 0.1
"""Share of a group's probability from which a suspicion lists a fault (assumed)."""


class AmbiguityGroup(NamedTuple):
    """Faults that look alike and may have started.

    Attributes:
        hypotheses: Faults, the most probable first.
        changes: Their numbers among a filter's changes.
        shares: Shares of the group's probability.
        probability: Probability that the robot has one of them.
        since_ns: Mean time at which the most probable fault started [ns].
    """

    hypotheses: tuple[Hypothesis, ...]
    changes: tuple[int, ...]
    shares: tuple[float, ...]
    probability: float
    since_ns: int

    @property
    def key(self) -> str:
        """Name of the group."""
        return self.hypotheses[0].group

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the probable faults."""
        pairs = zip(self.hypotheses, self.shares, strict=True)
        return tuple(fault.name for fault, share in pairs if share >= _MIN_SHARE)


class FaultWatch:
    """Watch of the faults of a robot.

    Attributes:
        settled: Faults that are taken for granted, with their alarms.
        leading: Group that has an alarm but is not settled, and the alarm; None for none.
        suspected: Faults that are suspected without an alarm, the most probable first.
    """

    def __init__(self) -> None:
        self.settled: list[tuple[Hypothesis, Alarm]] = []
        self.leading: tuple[AmbiguityGroup, Alarm] | None = None
        self.suspected: tuple[Suspicion, ...] = ()
        self._certain_since: tuple[int, int] | None = None
        """Time since when a group is certain [ns], and number of replies since."""
        self._ended_ns: dict[Hypothesis, int] = {}
        """Settled faults that have ended, and when [ns]."""
        self._events: list[Alarm] = []
        """Alarm of the last event without a duration, while it is shown."""

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        leading = [] if self.leading is None else [self.leading[1]]
        return [alarm for _, alarm in self.settled] + leading + self._events

    def update(self, time_ns: int, tracker: ParticleFilter) -> AmbiguityGroup | None:
        """Update suspicions by the probabilities after a reply; return the group that is certain, if any."""
        groups = sorted(_ambiguity_groups(tracker), key=lambda group: -group.probability)
        leading_key = self.leading[0].key if self.leading is not None else ""
        self.suspected = tuple(
            Suspicion(group.names, group.hypotheses[0].channel, group.since_ns, group.probability)
            for group in groups
            if group.key != leading_key and group.hypotheses[0].is_fault
        )
        if not groups or groups[0].probability <= THRESHOLDS.certain_above:
            self._certain_since = None
            return None
        since_ns, n_replies = self._certain_since or (time_ns, 0)
        self._certain_since = since_ns, n_replies + 1
        is_held = time_ns - since_ns >= THRESHOLDS.hold_ns
        return groups[0] if is_held and n_replies + 1 >= THRESHOLDS.min_replies else None

    def end_settled(self, time_ns: int, tracker: ParticleFilter) -> tuple[int, tuple[Alarm, ...]]:
        """Return the number of the change by which a settled fault has certainly ended, and its alarms."""
        probabilities = tracker.probabilities
        number = int(np.argmax(probabilities))
        is_end = number > 0 and not tracker.changes[number - 1].starts
        if not is_end or probabilities[number] <= THRESHOLDS.certain_above:
            return 0, ()
        fault = tracker.changes[number - 1].hypothesis
        ended = tuple(replace(alarm, ended_ns=time_ns) for other, alarm in self.settled if other is fault)
        self._ended_ns[fault] = time_ns
        self.settled = [pair for pair in self.settled if pair[0] is not fault]
        return number, ended

    def settled_since(self, time_ns: int) -> list[Hypothesis]:
        """Return the settled faults that the robot had at a time [ns] or since."""
        ended = [fault for fault, ended_ns in self._ended_ns.items() if ended_ns > time_ns]
        return [fault for fault, _ in self.settled] + ended

    def is_refuted(self, tracker: ParticleFilter) -> bool:
        """Return whether the leading group no longer explains the replies."""
        if self.leading is None:
            return False
        key = self.leading[0].key
        in_group = [change.starts and change.hypothesis.group == key for change in tracker.changes]
        return float(tracker.probabilities[1:][in_group].sum()) < 1 - THRESHOLDS.certain_above

    def is_distinguished(self, group: AmbiguityGroup, time_ns: int) -> bool:
        """Return whether one fault of a group is probable enough to name it, or the time for that is over."""
        is_overdue = time_ns - group.since_ns >= THRESHOLDS.name_delay_ns
        return group.shares[0] >= THRESHOLDS.name_above or is_overdue

    def raise_alarm(self, group: AmbiguityGroup, time_ns: int) -> None:
        """Raise the alarm of a group, which then leads."""
        self.leading = group, _alarm_of(group, time_ns)

    def show_event(self, group: AmbiguityGroup, time_ns: int) -> None:
        """Raise the alarm of an event without a duration."""
        self._events = [_alarm_of(group, time_ns)]

    def end_events(self, time_ns: int) -> tuple[Alarm, ...]:
        """End the alarms of events that were shown for long enough; return them."""
        expired = [alarm for alarm in self._events if time_ns - alarm.raised_ns > SHOWN_NS]
        self._events = [alarm for alarm in self._events if alarm not in expired]
        return tuple(replace(alarm, ended_ns=time_ns) for alarm in expired)

    def rename(self, group: AmbiguityGroup) -> bool:
        """Name the fault in an alarm with several names if it is certain now; return whether it is."""
        if self.leading is None or self.leading[1].fault in [fault.name for fault in group.hypotheses]:
            return False
        if group.shares[0] < THRESHOLDS.name_above:
            return False
        sureness = min(group.probability * group.shares[0], THRESHOLDS.max_sureness)
        self.leading = group, replace(self.leading[1], fault=group.hypotheses[0].name, sureness=sureness)
        return True

    def settle(self, group: AmbiguityGroup) -> None:
        """Take the leading fault for granted."""
        if self.leading is not None:
            self.settled.append((group.hypotheses[0], self.leading[1]))
            self.leading = None

    def drop_leading(self, time_ns: int) -> tuple[Alarm, ...]:
        """End the alarm of the leading group and return it; without one, return no alarms."""
        if self.leading is None:
            return ()
        ended = replace(self.leading[1], ended_ns=time_ns)
        self.leading = None
        return (ended,)


def _alarm_of(group: AmbiguityGroup, time_ns: int) -> Alarm:
    """Return the alarm of a group."""
    is_named = group.shares[0] >= THRESHOLDS.name_above
    name = group.hypotheses[0].name if is_named else FAULT_SEPARATOR.join(group.names)
    sureness = min(group.probability * (group.shares[0] if is_named else 1.0), THRESHOLDS.max_sureness)
    return Alarm(name, group.hypotheses[0].channel, group.since_ns, time_ns, sureness)


def _ambiguity_groups(tracker: ParticleFilter) -> Iterator[AmbiguityGroup]:
    """Yield the groups of faults that are suspected to have started."""
    probabilities: Sequence[float] = tracker.probabilities.tolist()
    groups: dict[str, list[int]] = {}
    for number, change in enumerate(tracker.changes, 1):
        if change.starts and probabilities[number] > 0:
            groups.setdefault(change.hypothesis.group, []).append(number)
    for numbers in groups.values():
        numbers.sort(key=lambda number: -probabilities[number])
        total = sum(probabilities[number] for number in numbers)
        if total > THRESHOLDS.suspect_above:
            yield AmbiguityGroup(
                tuple(tracker.changes[number - 1].hypothesis for number in numbers),
                tuple(numbers),
                tuple(probabilities[number] / total for number in numbers),
                total,
                tracker.since_ns(numbers[0]),
            )
