"""Watch of the wheels by the counters that H reads: those that turn less than they are told to."""

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.wheel_faults import StandingWheel, WeakMotor

Floats = NDArray[np.float64]

_WINDOW_NS = 1_000_000_000
"""Time over which pulses are summed [ns]."""

_LEAST = 25.0
"""Pulses that sound wheels turn within it, for anything to be told (assumed)."""

_STANDS, _WEAK, _SOUND = 0.05, 0.8, 0.9
"""Parts of these pulses up to which a wheel stands, up to which its motor is weak, and from which on it is
sound (assumed)."""


class WheelWatch:
    """Watch of a robot's wheels."""

    def __init__(self) -> None:
        self._told: deque[tuple[int, Floats, Floats]] = deque()
        self._alarms: dict[int, Alarm] = {}

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    def forget(self) -> None:
        """Forget the pulses so far, as the time of a reply is not certain."""
        self._told.clear()

    def count(self, time_ns: int, turned: Floats, expected: Floats) -> tuple[Alarm, ...]:
        """Take the pulses that counters have gone on since the reply before, and those of sound wheels (2,).

        Return the alarms that end by it.
        """
        self._told.append((time_ns, turned * np.sign(expected), np.abs(expected)))
        while self._told[0][0] < time_ns - _WINDOW_NS:
            self._told.popleft()
        ended: list[Alarm] = []
        since_ns = self._told[0][0]
        for side in range(2):
            whole = sum(float(each[side]) for _, _, each in self._told)
            if whole < _LEAST:
                continue
            part = sum(float(each[side]) for _, each, _ in self._told) / whole
            alarm = self._alarms.get(side)
            if alarm is not None and part > _SOUND:
                ended.append(replace(self._alarms.pop(side), ended_ns=time_ns))
            elif part < _WEAK and time_ns - since_ns > _WINDOW_NS // 2:
                fault = StandingWheel(side).name if part < _STANDS else WeakMotor(side).name
                # A wheel that comes to a stand looks weak at first.
                if alarm is None or fault == StandingWheel(side).name != alarm.fault:
                    begun_ns = since_ns if alarm is None else alarm.since_ns
                    if alarm is not None:
                        ended.append(replace(alarm, ended_ns=time_ns))
                    self._alarms[side] = Alarm(fault, "wheels", begun_ns, time_ns, 0.98)
        return tuple(ended)
