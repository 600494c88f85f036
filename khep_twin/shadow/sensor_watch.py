"""Watch of each sensor on its own: a stuck one repeats its last reading, a dead one reads 0.

A sound sensor has noise. The probability that it repeats a reading is learned from what it read before its
reading changed last, and from all others, apart for quiet ones, with nothing in reach, and others. Blinded by
a lamp or near the limit of its range, a sound one repeats itself, too: there only readings that the twins do
not expect count.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.actions import Seen
from khep_twin.shadow.sensor_model import UNLIT
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]

RAISED = 24.0
"""Logarithm of the odds from which on a sensor counts as stuck."""

_PRIOR = 4.0, 8.0
"""Repetitions, of so many readings, that are taken as seen before the first."""


class SensorWatch:
    """Watch of the sensors of a robot.

    Args:
        quiet: Highest reading with nothing in reach [counts].
        limit: Highest reading [counts].
        lit: Whether there are lamps.
    """

    def __init__(self, quiet: float, limit: int, lit: bool) -> None:
        self._quiet, self._limit, self._lit = quiet, limit, lit
        self._repeats = np.tile(np.array(_PRIOR), (2, N_SENSORS, 1))
        self._run = np.zeros_like(self._repeats)
        """Repetitions, of so many readings, since each sensor's reading changed last."""
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
        """True for each sensor neither stuck nor dead (8,)."""
        return np.array([sensor not in self._alarms for sensor in range(N_SENSORS)])

    def see(self, action: Seen, range_left: Floats, surprise: Floats) -> tuple[Alarm, ...]:
        """Take a reply to N; return the alarms that it ends.

        `range_left` is the part of each sensor's range that the lamps leave (8,), `surprise` what each
        reading is less likely than an expected one (8,), in logarithms.
        """
        before, self._last = self._last, action.readings
        ended: list[Alarm] = []
        if before is None:
            return ()
        for sensor, (last, now) in enumerate(zip(before.tolist(), action.readings.tolist(), strict=True)):
            if now != last:
                self._repeats[:, sensor] += self._run[:, sensor]
                self._run[:, sensor] = 0
                self._odds[sensor] = 0
                self._since_ns[sensor] = action.time_ns
                if alarm := self._alarms.pop(sensor, None):
                    ended.append(replace(alarm, ended_ns=action.time_ns))
            left = range_left[sensor]
            if left < _READABLE or last > _NEAR_LIMIT * left * self._limit:
                # Where others surprise as much, the robot is elsewhere.
                beyond = surprise[sensor] - np.delete(surprise, sensor).max() - _USUAL
                told = min(_TOLD * beyond, _MOST) if now == last else 0.0
            else:
                kind = int(last > self._quiet)
                told = -math.log(self._chance(kind, sensor)) if now == last else 0.0
                self._run[kind, sensor] += now == last, 1
                if last == 0:
                    # It may be lit more than the twins believe, the likelier the more they do.
                    told *= min((left - _READABLE) / (UNLIT - _READABLE), 1) ** 2
            self._odds[sensor] = max(self._odds[sensor] + told, 0)
        # Several that read 0 at once are blinded by a lamp, which the twins believe to be farther.
        dark = (action.readings == 0) & (self._odds > RAISED / 2)
        blinded = dark & (dark.sum() > 1)
        # Several that repeat bright readings, about as long, are at the end of the range that a lamp leaves.
        lasts_ns, bright = action.time_ns - np.array(self._since_ns), action.readings > self._quiet
        blinded |= (bright[:, None] & bright & (2 * lasts_ns >= lasts_ns[:, None])).sum(axis=1) > 1
        blinded &= self._lit
        for sensor, now in enumerate(action.readings.tolist()):
            if self._odds[sensor] > RAISED and sensor not in self._alarms and not blinded[sensor]:
                fault = f"dead sensor {sensor}" if now == 0 else f"stuck sensor {sensor}"
                since_ns, sureness = self._since_ns[sensor], 1 / (1 + math.exp(_RARE - self._odds[sensor]))
                self._alarms[sensor] = Alarm(fault, "proximity", since_ns, action.time_ns, sureness)
        return tuple(ended)

    def _chance(self, kind: int, sensor: int) -> float:
        """Return the probability that a sound sensor repeats a quiet (0) or another reading (1)."""
        all_readings = self._repeats[kind] + self._run[kind]
        repeats, among = np.delete(all_readings, sensor, axis=0).sum(axis=0).tolist()
        own, of = self._repeats[kind, sensor].tolist()
        others = repeats / among
        return max(others, (own + _OTHERS * others) / (of + _OTHERS))


_OTHERS = 20.0
"""Readings of its own as which all others count (assumed)."""

_RARE = 8.0
"""Logarithm of the odds against a stuck sensor (assumed)."""

_NEAR_LIMIT = 0.85
"""Part of the range from which on a sound sensor repeats itself: there light counts little."""

_READABLE = 0.7
"""Part of the range below which lamps blind a sensor, which then repeats itself, too (assumed)."""

_USUAL, _TOLD, _MOST = 0.3, 2.0, 1.5
"""Surprise that is usual there, and what more of it adds to the odds, at the most (assumed)."""
