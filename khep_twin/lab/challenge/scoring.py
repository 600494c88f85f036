"""Scores of a controller file, run in this process: a new twin and a new controller for each run.

A run is exactly as long as the challenge says, in simulated time: what a controller does then is refused, so
that a program that never returns is scored, too. The score is the mean over the runs, less the penalties.
Python's and numpy's global random numbers begin at the run's seed.
"""

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain, cycle
from pathlib import Path

import numpy as np

from khep_twin.clock import to_ns
from khep_twin.errors import ChallengeError, ControllerError, KhepTwinError, StoppedError
from khep_twin.host import Khepera
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile, movable_objects
from khep_twin.lab.challenge.task_metrics import TaskMetrics
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import forget_modules_beside, source_of
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan, SeriesRun, own_files
from khep_twin.lab.experiment.start_poses import StartPose
from khep_twin.playpen.starts import at_start
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.sensing.lamps import Lamps
from khep_twin.world import World

_LONG_S = 40.0
"""Simulated time from which on compiled code saves more than its loading takes [s] (measured)."""


@dataclass(frozen=True, slots=True)
class Score:
    """Score of a controller in a challenge.

    Attributes:
        value: Mean over the runs.
        runs: Score of each run.
        metrics: Mean of each metric over the runs.
    """

    value: float
    runs: tuple[float, ...]
    metrics: Mapping[str, float] = field(default_factory=dict[str, float])


def score(file: ChallengeFile, controller: str, runs: int, seed: int, log: Path | None = None) -> Score:
    """Return the score of a controller file, the same in any process.

    Args:
        file: Challenge.
        controller: Controller, FILE.py, FILE.py:NAME or a network's FILE.npz, or a built-in one.
        runs: Number of runs; run n has the seed `seed` + n - 1.
        seed: Seed of the first run.
        log: Log to record; with several runs each has its own, NAME-001.mcap and so on.

    Raises:
        ControllerError: The controller failed, or did not ask for what the score is computed from.
        KhepTwinError: A log cannot be written.
    """
    logs = [None] * runs if log is None else own_files(log, runs)
    measured = [
        _run(file, controller, runs, start, seed + index, own)
        for index, (start, own) in enumerate(zip(cycle(file.start_poses(runs, seed)), logs, strict=False))
    ]
    values = tuple(_value(file, controller, run, metrics) for run, metrics in enumerate(measured, 1))
    # Of a sensor that was not read in some runs, they are those of the others.
    found = {name: [each[name] for each in measured if name in each] for name in chain(*measured)}
    means = {name: math.fsum(each) / len(each) for name, each in found.items()}
    return Score(math.fsum(values) / runs, values, means)


def is_worth_compiling(challenge: Challenge, runs: int) -> bool:
    """Return whether the runs are so long that compiled code saves more time than its loading takes."""
    return runs * challenge.seconds >= _LONG_S


class LimitedTime:
    """Simulated time that ends at a limit, a `TimeSource`; letting more pass raises an error.

    Attributes:
        limit_ns: Time of the world at which it ends [ns]; None for no limit.
    """

    def __init__(self, world: World, limit_ns: int) -> None:
        self._world = world
        self.limit_ns: int | None = limit_ns

    def is_over(self) -> bool:
        """Return whether the limit is reached."""
        return self.limit_ns is not None and self._world.time_ns >= self.limit_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns`, or to the limit.

        Raises:
            StoppedError: The limit was before `time_ns`.
        """
        limit_ns = time_ns if self.limit_ns is None else self.limit_ns
        self._world.advance_to(min(time_ns, limit_ns))
        if time_ns > limit_ns:
            self.attend()

    def attend(self) -> None:
        """Refuse commands after the limit.

        Raises:
            StoppedError: The limit is reached.
        """
        if self.is_over():
            raise StoppedError("the time of the challenge is over")


def _run(
    file: ChallengeFile, controller: str, runs: int, start: StartPose, seed: int, log: Path | None
) -> dict[str, float]:
    """Return the metrics of one run."""
    challenge = file.challenge
    if controller not in BUILT_IN:
        forget_modules_beside(Path(controller.partition(":")[0]).absolute())  # of the run before
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what a learner's program may use)
    found = find_controller(controller)
    twin = open_twin(at_start(file.playpen, 0, start), TwinOptions(seed))
    time = LimitedTime(twin.world, to_ns(challenge.seconds))
    twin.time_source = time
    if twin.world.code.switch_at is not None and is_worth_compiling(challenge, runs):
        twin.world.code.switch_at = 0
    names = [item.name for item in movable_objects(file.playpen)]
    goals = _goals(challenge, twin.world.lamps)
    movable = None if challenge.object is None else names.index(challenge.object)
    task = TaskMetrics(twin.world, twin.robot.index, goals, movable)

    def record(opened: Twin) -> None:
        if log is not None:
            source = source_of(found)
            facts = {**source.facts, "challenge": challenge.name}
            opened.record(log, facts=facts, attachments=source.attachments)

    kept: list[SeriesRun] = []
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        plan = Plan(seconds=challenge.seconds)
        source = OneRobot(robot, record)
        try:
            kept += run_series(found, source, plan, stop=time.is_over, broken_off=kept.append)
        except KhepTwinError:
            # After the limit, an error is the refusal itself, or what a controller made of it.
            if not kept or not time.is_over():
                raise
        finally:
            time.limit_ns = None
    return {**kept[0].metrics, **task.metrics(challenge.seconds)}


def _goals(challenge: Challenge, lamps: Lamps) -> list[tuple[float, float, float]]:
    """Return the goals of a run: x, y, radius [m]."""
    on = {name for name, power in zip(lamps.names, lamps.powers, strict=True) if power}
    goals = [goal for goal in challenge.goals if goal.lamp is None or goal.lamp in on]
    if challenge.goals and not goals:
        text = f"a run begins with the lamps {', '.join(sorted(on)) or '-'} on, and has no goal"
        raise ChallengeError(text, file=challenge.name, expected="a [[goal]] for each lamp")
    return [(goal.x_mm / 1e3, goal.y_mm / 1e3, goal.radius_mm / 1e3) for goal in goals]


def _value(file: ChallengeFile, controller: str, run: int, metrics: Mapping[str, float]) -> float:
    """Return the score of a run.

    Raises:
        ControllerError: The run has no such metric.
    """
    challenge = file.challenge
    for name in (challenge.metric, *(penalty.metric for penalty in challenge.penalties)):
        if name not in metrics:
            wanted = "a program that asks the robot for what it is computed from"
            raise ControllerError(f"{controller}: run {run} has no {name}; expected {wanted}")
    sign = -1 if challenge.better == "higher" else 1
    lost = math.fsum(penalty.each * metrics[penalty.metric] for penalty in challenge.penalties)
    return metrics[challenge.metric] + sign * lost
