"""Watch of the lamps by the ambient light that O reads: those that are off, or elsewhere.

Each reply weighs the hypotheses of `lamp_beliefs` by their likelihood (`light_model`). A fault has an alarm
once it is certain; after a while it is believed from then on, and others may begin.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import Alarm, Suspicion
from khep_twin.playpen import Playpen
from khep_twin.shadow.lamp_beliefs import MOVED, OFF, TOLD, LampBeliefs, offsets
from khep_twin.shadow.light_model import LightModel
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.persistence import SENSOR_RADIUS, part_new
from khep_twin.shadow.planes import Planes
from khep_twin.shadow.thresholds import THRESHOLDS

Floats = NDArray[np.float64]

_FEW = 8
"""Particles whose light is computed."""

_UNSURE = 0.012, 0.012, math.radians(3)
"""Deviation of poses beyond that of the particles [m, m, rad] (assumed)."""

_MOST_TOLD = 4.0
"""Most that one reply tells, in logarithms (assumed)."""

_CHANGED = 150
"""Change of a reading that tells all that it can, wherever the robot is [counts] (assumed)."""

_PERSISTENCE = 0.01
"""Way of a sensor over which errors of a lamp's light persist [m] (assumed)."""

_POSE_PERSISTENCE = 0.02
"""Way of the robot over which an error of the pose persists [m] (assumed)."""

_NAMES = {OFF: "off", MOVED: "moved"}


class _Rising(NamedTuple):
    """Time since when a fault is not improbable, since when it is sure [ns], and replies since then."""

    since_ns: int
    sure_ns: int
    replies: int


class LampWatch:
    """Watch of a playpen's lamps; those that shine in turns are not watched.

    Args:
        playpen: Playpen.
        planes: Twins of its robot.

    Attributes:
        expected: Ambient readings expected at the last reply (8,) [counts]; NaN before, and where lamps
            shine in turns.
        suspected: Faults that are suspected without an alarm, the most probable first.
    """

    def __init__(self, playpen: Playpen, planes: Planes) -> None:
        self._names = [] if planes.lamps_are_unknown else planes.lamps.names
        self._model = LightModel(planes)
        self._beliefs = LampBeliefs(playpen, planes) if self._names else None
        self.expected = self._model.expected(np.full(8, math.nan if planes.lamps.names else 0.0))
        self.suspected: tuple[Suspicion, ...] = ()
        self._rising: dict[tuple[int, int], _Rising] = {}
        self._alarms: dict[tuple[int, int], Alarm] = {}
        self._last: tuple[NDArray[np.int64], Floats] = np.zeros(8, np.int64), np.zeros(3)
        self._last_ns = 0
        self._at: Floats = np.zeros((_FEW, 1))
        """Logarithms of how probable each of few poses is by each hypothesis (n, m)."""

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    def see(self, time_ns: int, readings: NDArray[np.int64], particles: Particles) -> tuple[Alarm, ...]:
        """Take a reply to O (8,) [counts], with particles of its time; return the alarms that end by it."""
        beliefs, model = self._beliefs, self._model
        if beliefs is None:
            return ()
        planes, mean = _spread(particles)
        every, vague = beliefs.light(planes, model)
        light = every[..., -1]
        self.expected = model.expected(light[0].mean(axis=0))
        new, way = self._new(readings, mean)
        told = self._told(model.logs(readings, every, new * model.new(light), vague), way)
        beliefs.take((time_ns - self._last_ns) / NS_PER_S, np.exp(np.maximum(told - told.max(), -_MOST_TOLD)))
        self._last_ns = time_ns
        if (beliefs.state == TOLD).all():
            model.learn(readings, light, beliefs.sure, new)
        return self._decide(time_ns, beliefs)

    def _decide(self, time_ns: int, beliefs: LampBeliefs) -> tuple[Alarm, ...]:
        """Raise and end alarms; believe what is certain."""
        alone, every = beliefs.probabilities
        ended: list[Alarm] = []
        suspected: list[Suspicion] = []
        for lamp, state in ((lamp, state) for lamp in range(len(every)) for state in _NAMES):
            key, chance = (lamp, state), float(every[lamp, state])
            since_ns = self._since_ns(key, chance, time_ns)
            alarm = self._alarms.get(key)
            if alarm is not None and chance < 1 - THRESHOLDS.sure:
                ended.append(replace(self._alarms.pop(key), ended_ns=time_ns))
            elif alarm is None and chance > THRESHOLDS.suspected:
                suspected.append(Suspicion((self._fault(key),), "light", since_ns, chance))
        certain = np.argwhere(alone > THRESHOLDS.sure)
        for lamp, state in certain.tolist():
            alarm = self._alarms.get((lamp, state))
            is_settled = alarm is not None and time_ns - alarm.raised_ns > THRESHOLDS.settled_ns
            if state == TOLD or is_settled:
                beliefs.believe(lamp, state)
        self.suspected = tuple(sorted(suspected, key=lambda each: -each.probability))
        return tuple(ended)

    def _since_ns(self, key: tuple[int, int], chance: float, time_ns: int) -> int:
        """Take the probability of a fault, raise its alarm; return since when it is not improbable [ns]."""
        before = self._rising.pop(key, _Rising(time_ns, time_ns, 0))
        if chance < 1 - THRESHOLDS.sure:
            return time_ns
        is_sure = chance > THRESHOLDS.sure
        now = _Rising(before.since_ns, before.sure_ns if is_sure else time_ns, (before.replies + 1) * is_sure)
        self._rising[key] = now
        is_held = time_ns - now.sure_ns >= THRESHOLDS.held_ns and now.replies >= THRESHOLDS.replies
        if key not in self._alarms and is_held and time_ns - now.since_ns >= THRESHOLDS.told_ns:
            sureness = min(chance, THRESHOLDS.surest)
            self._alarms[key] = Alarm(self._fault(key), "light", now.since_ns, time_ns, sureness)
        return now.since_ns

    def _fault(self, key: tuple[int, int]) -> str:
        """Return the name of a fault."""
        return f"{self._names[key[0]]} {_NAMES[key[1]]}"

    def _told(self, logs: Floats, way: float) -> Floats:
        """Return the log likelihood of a reply by each hypothesis (m,), from those at few poses (n, m).

        An error of the pose lasts: each hypothesis weighs the poses by all replies, and forgets them with the
        robot's way [m].
        """
        before = self._at * math.exp(-way / _POSE_PERSISTENCE)
        self._at = before - _log_of_means(before) + logs
        return _log_of_means(self._at)

    def _new(self, readings: NDArray[np.int64], pose: Floats) -> tuple[float, float]:
        """Return the part of readings that tells anything new at a pose, and the way there [m]."""
        (before, last), self._last = self._last, (readings, pose)
        way = np.abs(pose - last)
        if np.abs(readings - before).max() > _CHANGED:
            return 1.0, float(way[:2].sum())
        return part_new(float(way @ (1, 1, SENSOR_RADIUS)), _PERSISTENCE), float(way[:2].sum())


_APART: Floats = np.column_stack([offsets(_FEW), np.roll(offsets(_FEW), 3, axis=0)[:, 0]])
"""Offsets of poses, in standard deviations (_FEW, 3)."""


def _spread(particles: Particles) -> tuple[Planes, Floats]:
    """Return few twins at poses that particles may have, always spread in the same way, and the mean (3,)."""
    first = int(particles.logs.argmax())
    weights: Floats = np.exp(particles.logs - particles.logs[first])
    weights /= weights.sum()
    off = particles.planes.poses - particles.planes.poses[first]
    off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
    mean: Floats = weights @ off
    covariance: Floats = (off - mean).T @ ((off - mean) * weights[:, None]) + np.diag(np.square(_UNSURE))
    mean += particles.planes.poses[first]
    planes = particles.planes.taken(np.full(_FEW, first))
    planes.move(mean + _APART @ np.transpose(np.linalg.cholesky(covariance)))
    return planes, mean


def _log_of_means(logs: Floats) -> Floats:
    """Return the logarithms of the means of numbers with these logarithms, by column (n, m) -> (m,)."""
    most = logs.max(axis=0)
    return most + np.log(np.exp(logs - most).mean(axis=0))
