"""Alarms of a shadow that begin and end with its updates."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from khep_twin.log.shadow_channels import Alarm as Alarm


class AlarmChange(NamedTuple):
    """Alarm that has begun or ended.

    Attributes:
        time_ns: Time of the reply that showed it [ns].
        alarm: Alarm, with its end if it has ended.
    """

    time_ns: int
    alarm: Alarm


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
