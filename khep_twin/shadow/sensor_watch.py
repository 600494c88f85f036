"""Watch of each sensor by its readings: a stuck sensor repeats its last reading, a dead one reads 0.

    sound -- log odds of repetitions over 24 --> stuck or dead -- another reading --> sound

A sound sensor has noise. The probability that it repeats a reading is learned from its readings before the
last change and from other sensors, separately for quiet readings, with nothing in reach, and others. A sound
sensor blinded by a lamp or near the limit of its range repeats readings: there only unexpected ones count.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.actions import ProximityReply
from khep_twin.shadow.sensor_model import UNLIT, Booleans, Floats

ALARM_LOG_ODDS = 24.0
"""Logarithm of the odds above which a sensor counts as stuck."""

_PRIOR = 4.0, 8.0
"""Prior counts: repetitions, and readings."""

_PRIOR_READINGS = 20.0
"""Number of readings of one sensor as which those of all other sensors count (assumed)."""

_PRIOR_LOG_ODDS = 8.0
"""Logarithm of the odds against a stuck sensor (assumed)."""

_SATURATED, _READABLE = 0.85, 0.7
"""Part of the range above which light changes readings little, and usable part below which lamps blind it
(assumed): a sound sensor repeats readings there."""

_USUAL_SURPRISAL, _SURPRISAL_FACTOR, _MAX_EVIDENCE = 0.3, 2.0, 1.5
"""In these ranges: surprisal not counted, factor of the rest, largest log odds per reply (assumed)."""


class SensorWatch:
    """Watch of the sensors of a robot.

    Args:
        n_sensors: Number of its sensors.
        quiet: Highest reading with nothing in reach [counts].
        limit: Highest reading [counts].
        has_lamps: Whether there are lamps.
    """

    def __init__(self, n_sensors: int, quiet: float, limit: int, has_lamps: bool) -> None:
        self._quiet = quiet
        self._limit = limit
        self._has_lamps = has_lamps
        self._repeats = np.tile(np.array(_PRIOR), (2, n_sensors, 1))
        self._unfinished_repeats = np.zeros_like(self._repeats)
        """Repetitions and readings since the last change of each sensor's reading."""
        self._last: NDArray[np.int64] | None = None
        self._log_odds = np.zeros(n_sensors)
        self._since_ns = [0] * n_sensors
        self._alarms: dict[int, Alarm] = {}

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    @property
    def is_sound(self) -> Booleans:
        """True for each sensor that is neither stuck nor dead (s,)."""
        return np.array([sensor not in self._alarms for sensor in range(len(self._log_odds))])

    def update(self, action: ProximityReply, usable_range: Floats, surprisal: Floats) -> tuple[Alarm, ...]:
        """Take a reply to N, with the usable part of each sensor's range (s,); return the alarms that end."""
        previous, self._last = self._last, action.readings
        ended: list[Alarm] = []
        if previous is None:
            return ()
        for sensor, (last, now) in enumerate(zip(previous.tolist(), action.readings.tolist(), strict=True)):
            if now != last:
                self._repeats[:, sensor] += self._unfinished_repeats[:, sensor]
                self._unfinished_repeats[:, sensor] = 0
                self._log_odds[sensor] = 0
                self._since_ns[sensor] = action.time_ns
                if alarm := self._alarms.pop(sensor, None):
                    ended.append(replace(alarm, ended_ns=action.time_ns))
            sensor_range = usable_range[sensor]
            if sensor_range < _READABLE or last > _SATURATED * sensor_range * self._limit:
                # If others have as much surprisal, the robot is elsewhere.
                excess = surprisal[sensor] - np.delete(surprisal, sensor).max() - _USUAL_SURPRISAL
                evidence = min(_SURPRISAL_FACTOR * excess, _MAX_EVIDENCE) if now == last else 0.0
            else:
                reading_kind = int(last > self._quiet)
                evidence = -math.log(self._repeat_probability(reading_kind, sensor)) if now == last else 0.0
                self._unfinished_repeats[reading_kind, sensor] += now == last, 1
                if last == 0:
                    # It may get more light of lamps than in the twins, the likelier the more it has there.
                    evidence *= min((sensor_range - _READABLE) / (UNLIT - _READABLE), 1) ** 2
            self._log_odds[sensor] = max(self._log_odds[sensor] + evidence, 0)
        # Several that read 0 together are blinded by a lamp, which is farther in the twins.
        is_dark = (action.readings == 0) & (self._log_odds > ALARM_LOG_ODDS / 2)
        is_blinded = is_dark & (is_dark.sum() > 1)
        # Several that repeat bright readings, for about the same time, are at the limit under a lamp.
        lasts_ns, is_bright = action.time_ns - np.array(self._since_ns), action.readings > self._quiet
        is_similar = is_bright[:, None] & is_bright & (2 * lasts_ns >= lasts_ns[:, None])
        is_blinded |= is_similar.sum(axis=1) > 1
        is_blinded &= self._has_lamps
        for sensor, now in enumerate(action.readings.tolist()):
            log_odds, since_ns = self._log_odds[sensor], self._since_ns[sensor]
            if log_odds > ALARM_LOG_ODDS and sensor not in self._alarms and not is_blinded[sensor]:
                fault = f"dead sensor {sensor}" if now == 0 else f"stuck sensor {sensor}"
                sureness = 1 / (1 + math.exp(_PRIOR_LOG_ODDS - log_odds))
                self._alarms[sensor] = Alarm(fault, "proximity", since_ns, action.time_ns, sureness)
        return tuple(ended)

    def _repeat_probability(self, reading_kind: int, sensor: int) -> float:
        """Return the probability that a sound sensor repeats a quiet (0) or another reading (1)."""
        all_readings = self._repeats[reading_kind] + self._unfinished_repeats[reading_kind]
        repeats, n_readings = np.delete(all_readings, sensor, axis=0).sum(axis=0).tolist()
        prior = repeats / n_readings
        repeats, n_readings = self._repeats[reading_kind, sensor].tolist()
        return max(prior, (repeats + _PRIOR_READINGS * prior) / (n_readings + _PRIOR_READINGS))
