"""An oracle of faults: particle filters that know everything except the fault, one for each explanation.

They start at the true pose, within a millimetre and a degree, when the fault starts, or shortly before it is
noticeable. Wheels and sensors are those that a filter has learned until the fault. The filters know the
distance that the robot drives between replies. All particles of a filter have the fault of its explanation.
In trials of lifts one explanation is a lift at its true time to its true place. Its odds are divided by the
number of places that differ by a millimetre and a degree.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.shadow.actions import Action, ProximityReply, WheelCommand, apply_action
from khep_twin.shadow.candidates import Candidates
from khep_twin.shadow.displacements import Lifted
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.persistence import PERSISTENCE, SENSOR_RADIUS, novelty_of
from khep_twin.shadow.planar_bodies import TICK_NS
from khep_twin.shadow.recording import read_recording
from khep_twin.shadow.sensor_model import log_sum_exp
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.start import Spread, draw_particles
from khep_twin.shadow.thing_faults import Unexpected
from khep_twin.units import N_SENSORS, SCAN_NS
from stand_ins import hidden_changes
from stand_ins.recordings import Truth
from studies.fault_recordings import RecordedTrial
from studies.twin_runs import Floats, playpen_at_known_start, poses_at

SOUND = "sound"
"""Name of the explanation without a fault."""

POSE_SD = 1e-3, 1e-3, math.radians(1)
"""Standard deviations of the pose that the oracle knows [m, rad]."""

EARLIER_NS = NS_PER_S // 2
"""Longest time before the first noticeable reply at which filters start, for objects [ns]: earlier they are
out of reach, while the effect of a wheel adds up from the start of the fault."""

ADDED_NS = 400_000_000, 250_000_000, 100_000_000
"""Times before that reply at which an added object may have come into reach [ns]."""

ONSET_S = 1.0
"""Time in which a fault may have started, in addition to the time out of reach [s] (assumed)."""

PARTICLES = 600
"""Particles of each explanation."""

_N_SPEEDS = 4
"""Number of pairs of speeds in the description, the most frequent ones."""

USE: NDArray[np.bool_] = np.ones(N_SENSORS, np.bool_)


class Explanation(NamedTuple):
    """Explanation of the replies: a name, the logarithm of its prior odds, and its log evidence."""

    name: str
    prior: float
    evidence: float


class _Listener(Shadow):
    """A shadow that records actions without following them."""

    def __init__(self, playpen: Playpen) -> None:
        super().__init__(playpen, ShadowSettings(particles=1))
        self.actions: list[Action] = []

    def _follow(self, action: Action) -> Floats:
        self._reckoning.advance_to(action.time_ns)
        self.actions.append(action)
        return np.full(2, np.nan)


class _Informed(ParticleFilter):
    """A filter that knows the new part of each reply, by the reply's time [ns].

    Standing twins would weight replies less than driving ones, and could not be compared.
    """

    parts: Mapping[int, float]

    def _novelty(self, reply: ProximityReply) -> float:
        return self.parts[reply.time_ns]


class Oracle:
    """Filters of the explanations of one trial, which start at the true pose."""

    def __init__(self, trial: RecordedTrial, settings: ShadowSettings, end_ns: int) -> None:
        self._truth, self._seed, self._end_ns = trial.truth, settings.seed, end_ns
        self._noticeable_ns = int(trial.truth.noticeable_ns[0])
        changed_ns = int(trial.truth.changed_ns[0])
        begin_ns, self._lifted_ns = changed_ns, None
        if any(isinstance(change, hidden_changes.Lifted) for change in trial.trial.changes):
            # The sample at that time is the one after the lift.
            begin_ns, self._lifted_ns = changed_ns - SCAN_NS, changed_ns
        elif trial.trial.changes:
            begin_ns = max(begin_ns, self._noticeable_ns - EARLIER_NS)
        playpen = playpen_at_known_start(trial.room, trial.truth)
        listener = _Listener(playpen)
        for chunk in read_recording(trial.path).chunks:
            if chunk.time_ns <= end_ns:
                listener.feed(*chunk)
        self._setup = EpisodeSetup(playpen, planar=True)
        self._near = Candidates(self._setup)
        self._actions = [action for action in listener.actions if action.time_ns > begin_ns]
        self._parts = new_parts(
            self._truth, [action for action in listener.actions if isinstance(action, ProximityReply)]
        )
        earlier_actions = listener.actions[: -len(self._actions)]
        self._start = self._track_sound(earlier_actions, changed_ns, begin_ns, settings.particles)

    def _track_sound(
        self, actions: Sequence[Action], changed_ns: int, begin_ns: int, count: int
    ) -> Particles:
        """Return particles at the true pose, with wheels and sensors as learned before the fault."""
        rng = stream(self._seed, "oracle")
        x, y, heading = self._truth.start.tolist()
        spread = Spread(POSE_SD[0], POSE_SD[2])
        particles = draw_particles(self._setup, [(x, y, heading)], spread, count, rng)
        tracker = ParticleFilter(self._setup, particles, rng, count)
        for action in actions:
            if action.time_ns <= changed_ns:
                tracker.follow(action, USE)
            else:
                apply_action(action, tracker.particles)
                self._place_particles(tracker.particles, action.time_ns, rng)
            if isinstance(action, ProximityReply):
                self._near.record_encounters(action.time_ns, tracker)
        particles = tracker.particles.resample(PARTICLES, 0.5)
        particles.twins.advance_to(begin_ns)
        self._place_particles(particles, begin_ns, rng)
        return particles

    def _place_particles(self, particles: Particles, time_ns: int, rng: np.random.Generator) -> None:
        """Place particles at the robot's pose; their motion is not changed."""
        (pose,) = poses_at(self._truth, np.array([time_ns]))
        particles.twins.move(pose + POSE_SD * rng.standard_normal((len(particles), 3)))

    def explanations(self) -> list[Explanation]:
        """Return all explanations of the replies."""
        root = _Branch(self._start, 0.0, self._actions)
        sound, branches = self._tracker(root, SOUND), list[_Branch]()
        begins_ns = [self._noticeable_ns - lead_ns for lead_ns in ADDED_NS]
        evidences = [(0, 0.0)]
        for number, action in enumerate(self._actions):
            while begins_ns and action.time_ns > begins_ns[0]:
                del begins_ns[0]
                particles = sound.particles.resample(PARTICLES, 0.5)
                branches.append(_Branch(particles, sound.evidence, self._actions[number:]))
            sound.follow(action, USE)
            if isinstance(action, ProximityReply):
                self._near.record_encounters(action.time_ns, sound)
                evidences.append((action.time_ns, sound.evidence))
        explanations = [Explanation(SOUND, 0.0, self._evidence_at_end(evidences))]
        for change in self._near.changes_since(self._noticeable_ns, has_counters=False):
            start_branches = branches if isinstance(change.hypothesis, Unexpected) else [root]
            logs = np.array([self._evidence(change.hypothesis, branch) for branch in start_branches])
            prior = math.log(change.rate * (ONSET_S + change.unseen_s))
            evidence = log_sum_exp(logs) - math.log(len(logs))
            explanations.append(Explanation(change.hypothesis.name, prior, evidence))
        if self._lifted_ns is not None:
            earlier = [evidence for time_ns, evidence in evidences if time_ns <= self._lifted_ns]
            explanations.append(self._lifted(self._lifted_ns, earlier[-1]))
        return explanations

    def _lifted(self, time_ns: int, evidence: float) -> Explanation:
        """Return a lift to the true place at a time [ns], with the evidence of replies before it.

        The sum over all places would have at least this evidence.
        """
        fault, particles = Lifted(), self._start.resample(PARTICLES, 0.5)
        particles.twins.advance_to(time_ns)
        self._place_particles(particles, time_ns, stream(self._seed, "oracle", fault.name, "place"))
        particles.twins.reset_poses(particles.twins.poses)  # at rest
        branch = _Branch(
            particles, evidence, [action for action in self._actions if action.time_ns > time_ns]
        )
        arena = self._setup.playpen.arena
        places = arena.width_mm * arena.height_mm * 1e-6 * math.tau / (math.tau**1.5 * math.prod(POSE_SD))
        return Explanation(
            fault.name, -fault.log_odds_against - math.log(places), self._evidence(fault, branch)
        )

    def _evidence(self, hypothesis: Hypothesis, branch: "_Branch") -> float:
        """Return the evidence at the end for a fault that starts at the branch."""
        tracker = self._tracker(branch, hypothesis.name)
        rng = stream(self._seed, "oracle", hypothesis.name, "values")
        hypothesis.begin(tracker.particles, rng)
        evidences = [(0, branch.evidence)]
        for action in branch.actions:
            particles = tracker.particles
            tracker.follow(action, USE)
            if tracker.particles is not particles:
                hypothesis.jitter(tracker.particles, rng)
            if isinstance(action, ProximityReply):
                evidences.append((action.time_ns, branch.evidence + tracker.evidence))
        return self._evidence_at_end(evidences)

    def _evidence_at_end(self, evidences: Sequence[tuple[int, float]]) -> float:
        """Return evidence by time [ns] at the end, between two replies."""
        times, values = zip(*evidences, strict=True)
        return float(np.interp(self._end_ns, times, values))

    def _tracker(self, branch: "_Branch", name: str) -> _Informed:
        particles = branch.particles.resample(PARTICLES, 0.5)
        tracker = _Informed(self._setup, particles, stream(self._seed, "oracle", name), PARTICLES)
        tracker.parts = self._parts
        return tracker

    @property
    def speeds(self) -> str:
        """Speeds that the host has set most often since the start, with their numbers."""
        counts = Counter(
            (action.left, action.right) for action in self._actions if isinstance(action, WheelCommand)
        )
        return ", ".join(
            f"{number} x {left} {right}" for (left, right), number in counts.most_common(_N_SPEEDS)
        )


class _Branch(NamedTuple):
    """Twins of a sound robot at which a fault may start, their evidence, and the remaining actions."""

    particles: Particles
    evidence: float
    actions: Sequence[Action]


def new_parts(truth: Truth, replies: Sequence[ProximityReply]) -> dict[int, float]:
    """Return the new parts of replies to N by their times [ns], from the robot's true path."""
    steps = np.abs(np.diff(truth.poses[:, :2], axis=0)).sum(axis=1)
    steps += SENSOR_RADIUS * np.abs(np.diff(np.unwrap(truth.poses[:, 2])))
    distances = np.concatenate([[0.0], np.cumsum(steps)])
    parts: dict[int, float] = {}
    last_distance = 0.0
    for reply in replies:
        uncertain_ns = TICK_NS + max(reply.late_ns - reply.time_ns, 0)
        ends = reply.time_ns - uncertain_ns, reply.time_ns
        earlier, distance = np.interp(ends, truth.times_ns, distances).tolist()
        parts[reply.time_ns] = novelty_of(distance - last_distance, PERSISTENCE, distance - earlier)
        last_distance = distance
    return parts
