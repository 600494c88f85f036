"""Watch of the wheels by the counters that H reads: whether they turn less than commanded."""

from collections import deque
from dataclasses import replace

import numpy as np

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.actions import LATE_NS, CounterReply
from khep_twin.shadow.particles import Floats
from khep_twin.shadow.wheel_faults import StandingWheel, WeakMotor

_WINDOW_NS = 1_000_000_000
"""Time over which pulses are summed [ns]."""

_MIN_TRAVEL = 0.002
"""Least travel of a sound wheel in the window, for a decision [m] (assumed)."""

_STANDING_BELOW, _WEAK_BELOW, _SOUND_ABOVE = 0.05, 0.8, 0.9
"""Limits of the share of expected pulses of a wheel that stands, is weak, or is sound (assumed)."""


_MAX_LAG, _SETTLED = 0.1, 0.2
"""Lag of motors [s] above which pulses only count while the expected ones change by less than this part from
reply to reply: motors of other robots have other lags (assumed)."""


class WheelWatch:
    """Watch of a robot's wheels, with a travel per pulse of its encoders [m], and a lag of its motors [s]."""

    def __init__(self, pulse_length: float, lag: float) -> None:
        self._min_pulses = _MIN_TRAVEL / pulse_length
        self._is_slow = lag > _MAX_LAG
        self._expected: Floats = np.zeros(2)
        self._pulses: deque[tuple[int, Floats, Floats]] = deque()
        self._alarms: dict[int, Alarm] = {}
        self._counters: Floats | None = None
        self._was_late = False

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    @property
    def has_counters(self) -> bool:
        """True if H was read since the start or the last restart."""
        return self._counters is not None

    def restart(self) -> None:
        """Handle a restart of the processor, which resets the counters."""
        self._counters = None

    def take_counters(self, reply: CounterReply, residual: Floats, is_free: bool = True) -> tuple[Alarm, ...]:
        """Update by a reply to H and its residual (2,) [pulses]; return the alarms that end.

        Wheels are not judged unless the robot is free of obstacles, which may hold it.
        """
        last, self._counters = self._counters, reply.counters.astype(np.float64)
        is_late = reply.late_ns - reply.time_ns >= LATE_NS
        was_late, self._was_late = self._was_late, is_late
        if is_late or was_late or not is_free:
            self._pulses.clear()  # The time of a reply, or the contact, is uncertain.
        elif last is not None:
            turned_pulses = reply.counters - last
            return self.update(reply.time_ns, turned_pulses, turned_pulses - residual)
        return ()

    def update(self, time_ns: int, turned: Floats, expected: Floats) -> tuple[Alarm, ...]:
        """Update by the pulses since the last reply and those expected (2,); return the alarms that end."""
        change, self._expected = np.abs(expected - self._expected), expected
        if self._is_slow and (change > _SETTLED * np.abs(expected)).any():
            return ()
        self._pulses.append((time_ns, turned * np.sign(expected), np.abs(expected)))
        while self._pulses[0][0] < time_ns - _WINDOW_NS:
            self._pulses.popleft()
        ended: list[Alarm] = []
        since_ns = self._pulses[0][0]
        for side in range(2):
            expected_sum = sum(float(pulses[side]) for _, _, pulses in self._pulses)
            if expected_sum < self._min_pulses:
                continue
            share = sum(float(pulses[side]) for _, pulses, _ in self._pulses) / expected_sum
            alarm = self._alarms.get(side)
            if alarm is not None and share > _SOUND_ABOVE:
                ended.append(replace(self._alarms.pop(side), ended_ns=time_ns))
            elif share < _WEAK_BELOW and time_ns - since_ns > _WINDOW_NS // 2:
                fault = StandingWheel(side).name if share < _STANDING_BELOW else WeakMotor(side).name
                # A wheel that comes to a stand looks weak at first.
                if alarm is None or fault == StandingWheel(side).name != alarm.fault:
                    start_ns = since_ns if alarm is None else alarm.since_ns
                    if alarm is not None:
                        ended.append(replace(alarm, ended_ns=time_ns))
                    self._alarms[side] = Alarm(fault, "wheels", start_ns, time_ns, 0.98)
        return tuple(ended)
