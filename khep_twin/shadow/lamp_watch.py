"""Watch of the lamps by the ambient light that O reads: whether they are off, or moved.

    none -- 20 % --> suspected -- 95 %, for a second --> alarm -- 5 s --> believed -- its end is 95 % --> none

Each reply weights the hypotheses of `lamp_beliefs` by their likelihoods (`light_model`).
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import Alarm, Suspicion
from khep_twin.playpen import Playpen
from khep_twin.shadow.lamp_beliefs import MOVED, NOMINAL, OFF, LampBeliefs, normal_offsets
from khep_twin.shadow.light_model import LightModel
from khep_twin.shadow.particles import Floats, Particles
from khep_twin.shadow.persistence import SENSOR_RADIUS, novelty_of
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.thresholds import THRESHOLDS

_N_POSES = 8
"""Poses for which light is computed."""

_POSE_NOISE = 0.012, 0.012, math.radians(3)
"""Standard deviation of poses besides that of the particles [m, m, rad] (assumed)."""

_MAX_LOG_RATIO = 4.0
"""Largest log likelihood ratio of one reply (assumed)."""

_LARGE_CHANGE = 150
"""Change of a reading that is new information even where the robot stands [counts] (assumed)."""

_PERSISTENCE = 0.01
"""Travel of a sensor over which errors of a lamp's light persist [m] (assumed)."""

_POSE_PERSISTENCE = 0.02
"""Travel of the robot over which an error of the pose persists [m] (assumed)."""

_NAMES = {OFF: "off", MOVED: "moved"}

_OFFSETS = normal_offsets(_N_POSES)
_POSE_OFFSETS: Floats = np.column_stack([_OFFSETS, np.roll(_OFFSETS, 3, axis=0)[:, 0]])
"""Offsets of poses, in standard deviations (_N_POSES, 3)."""


class _Evidence(NamedTuple):
    """Times since when a fault is possible, and certain [ns], and number of replies since it is certain."""

    since_ns: int
    sure_ns: int
    n_replies: int


class LampWatch:
    """Watch of a playpen's lamps; alternating lamps are not watched.

    Args:
        playpen: Playpen.
        twins: Twins of its robot.

    Attributes:
        expected: Expected ambient readings of the last reply (s,) [counts]; NaN for alternating lamps.
        suspected: Faults that are suspected without an alarm, the most probable first.
    """

    def __init__(self, playpen: Playpen, twins: Twins) -> None:
        self._names = [] if twins.lamps_are_unknown else twins.lamps.names
        self._model = LightModel(twins)
        self._beliefs = LampBeliefs(playpen, twins) if self._names else None
        self.expected = self._model.expected(np.full(twins.n_sensors, math.nan if twins.lamps.names else 0.0))
        self.suspected: tuple[Suspicion, ...] = ()
        self._evidence: dict[tuple[int, int], _Evidence] = {}
        self._alarms: dict[tuple[int, int], Alarm] = {}
        self._last_reply: tuple[NDArray[np.int64], Floats] = np.zeros(twins.n_sensors, np.int64), np.zeros(3)
        self._last_ns = 0
        self._pose_log_weights: Floats = np.zeros((_N_POSES, 1))
        """Log weights of the poses for each hypothesis (n, m)."""

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that last."""
        return list(self._alarms.values())

    def update(self, time_ns: int, readings: NDArray[np.int64], particles: Particles) -> tuple[Alarm, ...]:
        """Update by a reply to O (s,) [counts] and the particles at its time; return the alarms that end."""
        beliefs, model = self._beliefs, self._model
        if beliefs is None:
            return ()
        twins, mean = _sample_poses(particles)
        all_light, variance = beliefs.light(twins, model)
        light = all_light[..., -1]
        self.expected = model.expected(light[0].mean(axis=0))
        novelty, distance = self._novelty(readings, mean)
        by_pose = model.log_likelihoods(readings, all_light, novelty * model.novelty(light), variance)
        log_likelihoods = self._log_likelihoods(by_pose, distance)
        log_ratios = np.maximum(log_likelihoods - log_likelihoods.max(), -_MAX_LOG_RATIO)
        beliefs.update((time_ns - self._last_ns) / NS_PER_S, np.exp(log_ratios))
        self._last_ns = time_ns
        if (beliefs.state == NOMINAL).all():
            model.learn(readings, light, beliefs.probability, novelty)
        return self._decide(time_ns, beliefs)

    def _decide(self, time_ns: int, beliefs: LampBeliefs) -> tuple[Alarm, ...]:
        """Raise and end alarms; set settled faults and certain returns to nominal as believed."""
        changed, marginal = beliefs.probabilities
        ended: list[Alarm] = []
        suspected: list[Suspicion] = []
        for lamp, state in ((lamp, state) for lamp in range(len(marginal)) for state in _NAMES):
            key, probability = (lamp, state), float(marginal[lamp, state])
            since_ns = self._update_evidence(key, probability, time_ns)
            alarm = self._alarms.get(key)
            if alarm is not None and probability < 1 - THRESHOLDS.certain_above:
                ended.append(replace(self._alarms.pop(key), ended_ns=time_ns))
            elif alarm is None and probability > THRESHOLDS.suspect_above:
                suspected.append(Suspicion((self._fault_name(key),), "light", since_ns, probability))
        certain = np.argwhere(changed > THRESHOLDS.certain_above)
        for lamp, state in certain.tolist():
            alarm = self._alarms.get((lamp, state))
            is_settled = alarm is not None and time_ns - alarm.raised_ns > THRESHOLDS.settle_delay_ns
            if state == NOMINAL or is_settled:
                beliefs.set_belief(lamp, state)
        self.suspected = tuple(sorted(suspected, key=lambda suspicion: -suspicion.probability))
        return tuple(ended)

    def _update_evidence(self, key: tuple[int, int], probability: float, time_ns: int) -> int:
        """Update the evidence of a fault, raise its alarm if due; return since when it is possible [ns]."""
        previous = self._evidence.pop(key, _Evidence(time_ns, time_ns, 0))
        if probability < 1 - THRESHOLDS.certain_above:
            return time_ns
        is_sure = probability > THRESHOLDS.certain_above
        sure_ns, n_replies = (previous.sure_ns if is_sure else time_ns), (previous.n_replies + 1) * is_sure
        evidence = self._evidence[key] = _Evidence(previous.since_ns, sure_ns, n_replies)
        is_held = time_ns - sure_ns >= THRESHOLDS.hold_ns and n_replies >= THRESHOLDS.min_replies
        if key not in self._alarms and is_held and time_ns - evidence.since_ns >= THRESHOLDS.alarm_delay_ns:
            sureness = min(probability, THRESHOLDS.max_sureness)
            self._alarms[key] = Alarm(self._fault_name(key), "light", evidence.since_ns, time_ns, sureness)
        return evidence.since_ns

    def _fault_name(self, key: tuple[int, int]) -> str:
        """Return the name of a fault, by its key: lamp and state."""
        return f"{self._names[key[0]]} {_NAMES[key[1]]}"

    def _log_likelihoods(self, by_pose: Floats, distance: float) -> Floats:
        """Return the log likelihoods of a reply by hypothesis (m,), from those by pose (n, m).

        As errors of the pose persist, poses have weights by all replies, which decay with the travel [m].
        """
        previous = self._pose_log_weights * math.exp(-distance / _POSE_PERSISTENCE)
        self._pose_log_weights = previous - _log_mean_exp(previous) + by_pose
        return _log_mean_exp(self._pose_log_weights)

    def _novelty(self, readings: NDArray[np.int64], pose: Floats) -> tuple[float, float]:
        """Return the novelty of readings at a pose, and the distance from the last pose [m]."""
        (last_readings, last_pose), self._last_reply = self._last_reply, (readings, pose)
        travel = np.abs(pose - last_pose)
        if np.abs(readings - last_readings).max() > _LARGE_CHANGE:
            return 1.0, float(travel[:2].sum())
        return novelty_of(float(travel @ (1, 1, SENSOR_RADIUS)), _PERSISTENCE), float(travel[:2].sum())


def _sample_poses(particles: Particles) -> tuple[Twins, Floats]:
    """Return twins at fixed offsets from the particles' mean pose, by their covariance, and the mean (3,)."""
    best_index = int(particles.log_weights.argmax())
    weights: Floats = np.exp(particles.log_weights - particles.log_weights[best_index])
    weights /= weights.sum()
    deviations = particles.twins.poses - particles.twins.poses[best_index]
    deviations[:, 2] = (deviations[:, 2] + math.pi) % math.tau - math.pi
    mean: Floats = weights @ deviations
    covariance: Floats = (deviations - mean).T @ ((deviations - mean) * weights[:, None])
    covariance += np.diag(np.square(_POSE_NOISE))
    mean += particles.twins.poses[best_index]
    twins = particles.twins.select(np.full(_N_POSES, best_index))
    twins.move(mean + _POSE_OFFSETS @ np.transpose(np.linalg.cholesky(covariance)))
    return twins, mean


def _log_mean_exp(log_values: Floats) -> Floats:
    """Return the logarithms of the means of numbers with these logarithms, by column (n, m) -> (m,)."""
    largest = log_values.max(axis=0)
    return largest + np.log(np.exp(log_values - largest).mean(axis=0))
