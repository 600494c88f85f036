"""Watch of each sensor on its own: a stuck one repeats its last reading, a dead one reads 0.

A sound sensor has noise. The probability that it repeats a reading is learned from all sensors, apart for
quiet ones, with nothing in reach, and others; at the limit of the range every reading is a repetition.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.actions import Seen
from khep_twin.shadow.alarms import Alarm
from khep_twin.units import N_SENSORS

RAISED = 24.0
"""Logarithm of the odds from which on a sensor counts as stuck."""

_PRIOR = 4.0, 8.0
"""Repetitions, of so many readings, that are taken as seen before the first."""


class SensorWatch:
    """Watch of the sensors of a robot.

    Args:
        quiet: Highest reading with nothing in reach [counts].
        limit: Highest reading [counts].

    Attributes:
        sound: Whether each sensor is neither stuck nor dead (8,).
        alarms: Alarms that last.
    """

    def __init__(self, quiet: float, limit: int) -> None:
        self._quiet, self._limit = quiet, limit
        self._repeats = np.tile(np.array(_PRIOR), (2, N_SENSORS, 1))
        self._last: NDArray[np.int64] | None = None
        self._odds = np.zeros(N_SENSORS)
        self._since_ns = [0] * N_SENSORS
        self._alarms: dict[int, Alarm] = {}

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    @property
    def sound(self) -> NDArray[np.bool_]:
        """Whether each sensor is neither stuck nor dead (8,)."""
        return np.array([sensor not in self._alarms for sensor in range(N_SENSORS)])

    def see(self, action: Seen, readable: NDArray[np.bool_]) -> tuple[Alarm, ...]:
        """Take a reply to N; return the alarms that it ends.

        Args:
            action: Reply.
            readable: Whether lamps leave enough of each sensor's range (8,).
        """
        before, self._last = self._last, action.readings
        ended: list[Alarm] = []
        if before is None:
            return ()
        for sensor, (last, now) in enumerate(zip(before.tolist(), action.readings.tolist(), strict=True)):
            if now != last:
                self._odds[sensor] = 0
                self._since_ns[sensor] = action.time_ns
                if alarm := self._alarms.pop(sensor, None):
                    ended.append(replace(alarm, ended_ns=action.time_ns))
            if last >= self._limit or not readable[sensor]:
                continue
            kind = int(last > self._quiet)
            others = np.delete(self._repeats[kind], sensor, axis=0).sum(axis=0)
            self._repeats[kind, sensor] += now == last, 1
            if now != last:
                continue
            self._odds[sensor] -= math.log(others[0] / others[1])
            if self._odds[sensor] > RAISED and sensor not in self._alarms:
                fault = f"dead sensor {sensor}" if now == 0 else f"stuck sensor {sensor}"
                since_ns, sureness = self._since_ns[sensor], 1 / (1 + math.exp(_RARE - self._odds[sensor]))
                self._alarms[sensor] = Alarm(fault, "proximity", since_ns, action.time_ns, sureness)
        return tuple(ended)


_RARE = 8.0
"""Logarithm of the odds against a stuck sensor (assumed)."""
