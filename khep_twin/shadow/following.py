"""Following a robot's line with a shadow: silence on the line, and alarms that start and end.

A silence advances the shadow in whole steps of `STEP_NS`. The same bytes at the same times thus give the same
updates, whether they are read from a log or from the line.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import Alarm, PoseState, StateTimes
from khep_twin.shadow.recording import LineChunk
from khep_twin.shadow.shadow import Shadow
from khep_twin.shadow.update import Update

STEP_NS = NS_PER_S // 5
"""Steps of a silence, at which the pose is estimated without a reply [ns] (assumed)."""


class AlarmChange(NamedTuple):
    """Alarm that has started, or ended if its end is set, and the time of the reply that showed it [ns]."""

    time_ns: int
    alarm: Alarm


class Follower:
    """A shadow that follows a line.

    Attributes:
        last_update: Last update; None before the first.
        states: Times in each state so far.
        replies: Number of replies with values that were used.
    """

    def __init__(self, shadow: Shadow) -> None:
        self._shadow = shadow
        self._advanced_ns = 0
        self._alarms = LastingAlarms()
        self._is_lost: bool | None = None
        self.last_update: Update | None = None
        self.states = StateTimes()
        self.replies = 0

    def feed(self, chunk: LineChunk) -> Iterator[Update]:
        """Yield the updates by the silence before a chunk, then those by its bytes, if any."""
        yield from self.wait(chunk.time_ns)
        for update in self._shadow.feed(*chunk) if chunk.data else ():
            self.replies += 1
            yield self._record(update)

    def wait(self, time_ns: int) -> Iterator[Update]:
        """Yield the updates of a silence up to a time [ns]."""
        while (next_ns := self._advanced_ns + STEP_NS) <= time_ns:
            self._advanced_ns = next_ns
            for update in self._shadow.wait(next_ns):
                yield self._record(update)

    def changes(self, update: Update) -> Iterator[AlarmChange]:
        """Return the alarms that end or start with an update."""
        return self._alarms.changes(update.time_ns, update.alarms, update.ended)

    def loss_change(self, update: Update) -> bool | None:
        """Return True if a followed robot becomes lost, False if a lost one is found, None otherwise."""
        was_lost = self._is_lost
        if update.state is not PoseState.UNSURE:
            self._is_lost = update.state is PoseState.LOST
        elif was_lost is None:
            self._is_lost = False
        return None if was_lost is None or self._is_lost is was_lost else self._is_lost

    def _record(self, update: Update) -> Update:
        self.last_update = update
        self.states.add(update.time_ns, update.state)
        return update


class LastingAlarms:
    """Alarms that last; the fault and the time of an alarm identify it."""

    def __init__(self) -> None:
        self._lasting: dict[tuple[str, int], Alarm] = {}

    def changes(self, time_ns: int, alarms: Sequence[Alarm], ended: Sequence[Alarm]) -> Iterator[AlarmChange]:
        """Yield the alarms that end or start with an update; one that does both starts first.

        `alarms` last after it, `ended` end with it.
        """
        ended_by_key, lasting = _index_alarms(ended), _index_alarms(alarms)
        for key, alarm in ended_by_key.items():
            if key not in self._lasting:
                yield AlarmChange(time_ns, replace(alarm, ended_ns=None))
        for key, alarm in {**self._lasting, **ended_by_key}.items():
            if key not in lasting:
                yield AlarmChange(time_ns, replace(alarm, ended_ns=alarm.ended_ns or time_ns))
        for key, alarm in lasting.items():
            if key not in self._lasting:
                yield AlarmChange(time_ns, alarm)
        self._lasting = lasting


def _index_alarms(alarms: Sequence[Alarm]) -> dict[tuple[str, int], Alarm]:
    return {(alarm.fault, alarm.raised_ns): alarm for alarm in alarms}
