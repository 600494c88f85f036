"""Watch of the lamps by the ambient light that O reads: those that are off, or elsewhere."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.particle_filter import SENSOR_RADIUS, part_new
from khep_twin.shadow.particles import Particles

Floats = NDArray[np.float64]

RAISED, ENDED = 10.0, 6.0
"""Logarithms of the odds from which on an alarm is raised, and ends."""

_FEW = 40
"""Particles whose light is computed."""

_MODEL = 0.2
"""Relative deviation of a lamp's light from the model's (assumed)."""

_BRIGHT = 60.0
"""Light of a lamp that tells something, at the least [counts]."""

_MOST_TOLD = 4.0
"""Most that one reply tells, in logarithms (assumed)."""

_CHANGED = 150
"""Change of a reading that tells all that it can, wherever the robot is [counts] (assumed)."""

_PERSISTENCE = 0.01
"""Way of a sensor over which errors of a lamp's light persist [m] (assumed)."""

_MOST = 0.05
"""Part of the readings that nothing explains (assumed)."""


class LampWatch:
    """Watch of a playpen's lamps.

    Attributes:
        names: Their names.
        expected: Ambient readings expected at the last reply (8,) [counts].
    """

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self._odds = np.zeros((len(names), 2))
        self._since_ns = [0] * len(names)
        self._alarms: dict[int, Alarm] = {}
        self.expected: Floats = np.full(8, np.nan)
        self._last: tuple[NDArray[np.int64], Floats] = np.zeros(8, np.int64), np.zeros(3)

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    def see(self, time_ns: int, readings: NDArray[np.int64], particles: Particles) -> tuple[Alarm, ...]:
        """Take a reply to O (8,) [counts], with particles of its time; return the alarms that end by it."""
        few = particles.drawn(_FEW, 0.5)
        new = self._new(readings, few.planes.poses.mean(axis=0))
        ambient = few.planes.ambient
        dark, floor, noise = (float(ambient[name]) for name in ("dark", "floor", "noise"))
        light = few.planes.lamplight(1.0)
        whole = light.sum(axis=2)
        self.expected = np.maximum(dark - whole.mean(axis=0), floor)
        ended: list[Alarm] = []
        for lamp, name in enumerate(self.names):
            own = light[:, :, lamp]
            lit = _log(readings, whole, dark, floor, noise)
            off = _log(readings, whole - own, dark, floor, noise)
            # Any reading is as probable as another; those at the floor are counted together.
            clipped = readings <= floor + _CLIPPED * noise
            elsewhere = np.log(np.where(clipped, _CLIPPED * noise, 1) / (dark - floor))
            bright = own.mean(axis=0) > _BRIGHT
            # A lamp that was moved lights what it did not, and leaves what it did.
            seen = bright | (readings < self.expected - 4 * noise - _BRIGHT)
            if not seen.any():
                continue
            step = np.array([(off - lit)[seen].sum(), np.maximum(elsewhere - lit, -3.0)[seen].sum()])
            step = new * np.clip(step, -_MOST_TOLD, _MOST_TOLD)
            if bright.sum() == 0:
                step[0] = min(step[0], 0)
            alarm = self._alarms.get(lamp)
            if alarm is None:
                self._odds[lamp] = np.maximum(self._odds[lamp] + step, 0)
                if not self._odds[lamp].any():
                    self._since_ns[lamp] = time_ns
                kind = int(np.argmax(self._odds[lamp]))
                if self._odds[lamp, kind] > RAISED:
                    fault = f"{name} {('off', 'moved')[kind]}"
                    self._alarms[lamp] = Alarm(fault, "light", self._since_ns[lamp], time_ns, 0.99)
                    self._odds[lamp] = 0
            else:
                kind = int(alarm.fault.endswith("moved"))
                self._odds[lamp] = np.maximum(self._odds[lamp] - step, 0)
                if self._odds[lamp, kind] > ENDED:
                    ended.append(replace(self._alarms.pop(lamp), ended_ns=time_ns))
                    self._odds[lamp] = 0
        return tuple(ended)

    def _new(self, readings: NDArray[np.int64], pose: Floats) -> float:
        """Return the part of readings that tells anything new, at a pose."""
        (before, last), self._last = self._last, (readings, pose)
        if np.abs(readings - before).max() > _CHANGED:
            return 1.0
        way = float(np.abs(pose - last) @ (1, 1, SENSOR_RADIUS))
        return part_new(way, _PERSISTENCE)


_CLIPPED = 3.0
"""Deviations of the noise within which a reading is taken for one at the floor."""


def _log(readings: NDArray[np.int64], light: Floats, dark: float, floor: float, noise: float) -> Floats:
    """Return the log likelihood of each reading, over all particles (8,)."""
    deviation = np.sqrt(noise * noise + (_MODEL * light) ** 2 + 4)
    edge = floor + _CLIPPED * noise
    clipped = readings <= edge
    z = (np.where(clipped, edge, readings) - (dark - light)) / deviation
    inside = np.exp(-0.5 * z * z) / (deviation * math.sqrt(math.tau))
    inside = np.where(clipped, _below(z), inside)
    return np.log(((1 - _MOST) * inside + _MOST / 500).mean(axis=0))


def _below(z: Floats) -> Floats:
    """Return the probability of a normal number below z, to 0.01."""
    return 1 / (1 + np.exp(-np.clip(1.702 * z, -500, 500)))
