"""Watch of the faults that twins are compared with: which begins, has a name, is settled, and ends.

    nothing -- 20 % --> suspected -- 95 %, for a second --> alarm -- 5 s --> settled -- its end --> nothing

Faults that look alike, such as a weak motor and a slipping wheel of one side, count together: the sum of
their probabilities decides about the alarm, which has the name of the most probable one, or all names.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from khep_twin.log.shadow_channels import OR, Alarm, Suspicion
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.thresholds import THRESHOLDS

_LISTED = 0.1
"""Part of the probability of faults that look alike from which on a suspicion lists one of them (assumed)."""


class Alike(NamedTuple):
    """Faults that look alike and may have begun.

    Attributes:
        faults: Faults, the most probable first.
        numbers: Their numbers among a filter's changes.
        parts: Parts of their probability.
        probability: Probability that there is one of them.
        since_ns: Time since when [ns].
    """

    faults: tuple[Hypothesis, ...]
    numbers: tuple[int, ...]
    parts: tuple[float, ...]
    probability: float
    since_ns: int

    @property
    def key(self) -> str:
        """Name of all of them."""
        return self.faults[0].alike

    @property
    def names(self) -> tuple[str, ...]:
        """Names of those that are probable."""
        pairs = zip(self.faults, self.parts, strict=True)
        return tuple(fault.name for fault, part in pairs if part >= _LISTED)


class FaultWatch:
    """Watch of the faults of a robot.

    Attributes:
        settled: Faults that are taken for granted, with their alarms.
        leading: Faults that have an alarm, but are not settled, and the alarm; None for none.
        suspected: Faults that are suspected without an alarm, the most probable first.
    """

    def __init__(self) -> None:
        self.settled: list[tuple[Hypothesis, Alarm]] = []
        self.leading: tuple[Alike, Alarm] | None = None
        self.suspected: tuple[Suspicion, ...] = ()
        self._sure: tuple[int, int] | None = None
        """Time since when faults that look alike are so probable [ns], and number of replies since."""
        self._over: dict[Hypothesis, int] = {}
        """Settled faults that have ended, and when [ns]."""

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        leading = [] if self.leading is None else [self.leading[1]]
        return [alarm for _, alarm in self.settled] + leading

    def see(self, time_ns: int, tracker: ParticleFilter) -> Alike | None:
        """Take the probabilities after a reply; return the faults that are certain to be there now."""
        found = sorted(_alike(tracker), key=lambda each: -each.probability)
        leads = self.leading[0].key if self.leading is not None else ""
        self.suspected = tuple(
            Suspicion(each.names, each.faults[0].channel, each.since_ns, each.probability)
            for each in found
            if each.key != leads and each.faults[0].is_fault
        )
        if not found or found[0].probability <= THRESHOLDS.sure:
            self._sure = None
            return None
        since_ns, replies = self._sure or (time_ns, 0)
        self._sure = since_ns, replies + 1
        is_held = time_ns - since_ns >= THRESHOLDS.held_ns
        return found[0] if is_held and replies + 1 >= THRESHOLDS.replies else None

    def over(self, time_ns: int, tracker: ParticleFilter) -> tuple[int, tuple[Alarm, ...]]:
        """Return the number of the change by which a settled fault has certainly ended, and its alarms."""
        probabilities = tracker.probabilities
        number = int(np.argmax(probabilities))
        if not number or tracker.changes[number - 1].begins or probabilities[number] <= THRESHOLDS.sure:
            return 0, ()
        fault = tracker.changes[number - 1].hypothesis
        ended = tuple(replace(alarm, ended_ns=time_ns) for each, alarm in self.settled if each is fault)
        self._over[fault] = time_ns
        self.settled = [each for each in self.settled if each[0] is not fault]
        return number, ended

    def had(self, time_ns: int) -> list[Hypothesis]:
        """Return the settled faults that the robot had at a time or since [ns]."""
        over = [fault for fault, ended_ns in self._over.items() if ended_ns > time_ns]
        return [fault for fault, _ in self.settled] + over

    def has_gone(self, tracker: ParticleFilter) -> bool:
        """Return whether the leading faults explain the replies no more."""
        if self.leading is None:
            return False
        leads = self.leading[0].key
        rest = [each.begins and each.hypothesis.alike == leads for each in tracker.changes]
        return float(tracker.probabilities[1:][rest].sum()) < 1 - THRESHOLDS.sure

    def is_named(self, alike: Alike, time_ns: int) -> bool:
        """Return whether faults have been told apart, or cannot be in time."""
        return alike.parts[0] >= THRESHOLDS.named or time_ns - alike.since_ns >= THRESHOLDS.unnamed_ns

    def raise_alarm(self, alike: Alike, time_ns: int) -> None:
        """Raise the alarm of faults, and lead with it."""
        self.leading = alike, self.alarm(alike, time_ns)

    def alarm(self, alike: Alike, time_ns: int) -> Alarm:
        """Return the alarm of faults."""
        is_one = alike.parts[0] >= THRESHOLDS.named
        name = alike.faults[0].name if is_one else OR.join(alike.names)
        sureness = alike.probability * (alike.parts[0] if is_one else 1.0)
        return Alarm(name, alike.faults[0].channel, alike.since_ns, time_ns, min(sureness, THRESHOLDS.surest))

    def rename(self, alike: Alike) -> bool:
        """Give the alarm of several names the one that is certain now; return whether it has another name."""
        if self.leading is None or self.leading[1].fault in [fault.name for fault in alike.faults]:
            return False
        if alike.parts[0] < THRESHOLDS.named:
            return False
        sureness = min(alike.probability * alike.parts[0], THRESHOLDS.surest)
        alarm = replace(self.leading[1], fault=alike.faults[0].name, sureness=sureness)
        self.leading = alike, alarm
        return True

    def settle(self, alike: Alike) -> None:
        """Take the leading fault for granted."""
        if self.leading is not None:
            self.settled.append((alike.faults[0], self.leading[1]))
            self.leading = None

    def give_up(self, time_ns: int) -> tuple[Alarm, ...]:
        """Give up the leading faults; return their alarm, which ends."""
        if self.leading is None:
            return ()
        ended = replace(self.leading[1], ended_ns=time_ns)
        self.leading = None
        return (ended,)


def _alike(tracker: ParticleFilter) -> Iterator[Alike]:
    """Yield the faults that are suspected to have begun, those that look alike together."""
    probabilities: Sequence[float] = tracker.probabilities.tolist()
    numbers: dict[str, list[int]] = {}
    for number, change in enumerate(tracker.changes, 1):
        if change.begins and probabilities[number] > 0:
            numbers.setdefault(change.hypothesis.alike, []).append(number)
    for alike in numbers.values():
        alike.sort(key=lambda number: -probabilities[number])
        whole = sum(probabilities[number] for number in alike)
        if whole <= THRESHOLDS.suspected:
            continue
        yield Alike(
            tuple(tracker.changes[number - 1].hypothesis for number in alike),
            tuple(alike),
            tuple(probabilities[number] / whole for number in alike),
            whole,
            tracker.since_ns(alike[0]),
        )
