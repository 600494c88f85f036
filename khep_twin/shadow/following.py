"""Following a robot's line with a shadow: pauses, and alarms that begin and end.

A line that is silent advances the shadow at whole steps of `STEP_NS`, so that the same bytes at the same
times give the same updates, whether they come from a log or as they cross the line.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import Alarm, PoseState, StateTimes
from khep_twin.shadow.recording import Heard
from khep_twin.shadow.shadow import Shadow
from khep_twin.shadow.update import Update

STEP_NS = NS_PER_S // 5
"""Step of the silence after which the pose is estimated without a reply [ns] (assumed)."""


class AlarmChange(NamedTuple):
    """Alarm that has begun, or ended at its end, and the time of the reply that showed it [ns]."""

    time_ns: int
    alarm: Alarm


class Follower:
    """A shadow that is fed a line.

    Attributes:
        last: Last update; None before the first.
        states: Times in each state so far.
        replies: Number of replies with values that were used.
    """

    def __init__(self, shadow: Shadow) -> None:
        self._shadow = shadow
        self._waited_ns = 0
        self._alarms = LastingAlarms()
        self._lost: bool | None = None
        self.last: Update | None = None
        self.states = StateTimes()
        self.replies = 0

    def feed(self, heard: Heard) -> Iterator[Update]:
        """Yield the updates up to bytes and by them; no bytes tell that none came until then."""
        yield from self.wait(heard.time_ns)
        for update in self._shadow.feed(*heard) if heard.data else ():
            self.replies += 1
            yield self._noted(update)

    def wait(self, time_ns: int) -> Iterator[Update]:
        """Yield the updates of a silence up to a time [ns]."""
        while (next_ns := self._waited_ns + STEP_NS) <= time_ns:
            self._waited_ns = next_ns
            for update in self._shadow.wait(next_ns):
                yield self._noted(update)

    def changes(self, update: Update) -> Iterator[AlarmChange]:
        """Return the alarms that have ended or begun with an update."""
        return self._alarms.changes(update.time_ns, update.alarms, update.ended)

    def turn(self, update: Update) -> bool | None:
        """Return True where the robot is lost with an update, False where it is found; None elsewhere.

        One that is lost is found where it is followed. One that is lost from the start on was not followed.
        """
        before = self._lost
        if update.state is not PoseState.UNSURE:
            self._lost = update.state is PoseState.LOST
        elif before is None:
            self._lost = False
        return None if before is None or self._lost is before else self._lost

    def _noted(self, update: Update) -> Update:
        self.last = update
        self.states.add(update.time_ns, update.state)
        return update


class LastingAlarms:
    """Alarms that last; a fault and the time of its alarm identify one."""

    def __init__(self) -> None:
        self._lasting: dict[tuple[str, int], Alarm] = {}

    def changes(self, time_ns: int, alarms: Sequence[Alarm], ended: Sequence[Alarm]) -> Iterator[AlarmChange]:
        """Yield the alarms that end or begin with an update; one that does both begins first.

        `alarms` last after it, `ended` have ended with it.
        """
        over, lasting = _by_key(ended), _by_key(alarms)
        for key, alarm in over.items():
            if key not in self._lasting:
                yield AlarmChange(time_ns, replace(alarm, ended_ns=None))
        for key, alarm in {**self._lasting, **over}.items():
            if key not in lasting:
                yield AlarmChange(time_ns, replace(alarm, ended_ns=alarm.ended_ns or time_ns))
        for key, alarm in lasting.items():
            if key not in self._lasting:
                yield AlarmChange(time_ns, alarm)
        self._lasting = lasting


def _by_key(alarms: Sequence[Alarm]) -> dict[tuple[str, int], Alarm]:
    return {(alarm.fault, alarm.raised_ns): alarm for alarm in alarms}
