"""Scores of a controller file, run in this process: a new twin and a new controller for each run.

A run lasts exactly the challenge's simulated time. Later commands of the controller are refused, so that a
program that never returns also has a score. A run's score is its metric less the penalties if higher is
better, plus them if lower is better. The score is the mean over the runs. The global random number generators
of Python and numpy are seeded with the run's seed.
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
from khep_twin.host.host_robot import open_robot
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile, movable_objects
from khep_twin.lab.challenge.task_metrics import TaskMetrics
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import forget_modules_beside, source_of
from khep_twin.lab.experiment.controllers import BUILT_IN, as_controller
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan, SeriesRun, run_files
from khep_twin.lab.experiment.start_poses import StartPose
from khep_twin.playpen.starts import at_start
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.sensing.lamps import Lamps
from khep_twin.world import World

_COMPILE_FROM_S = 40.0
"""Simulated time above which compiled code saves more time than its loading takes [s] (measured)."""


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
        log: Log to record; several runs have separate logs, NAME-001.mcap and so on.

    Raises:
        ControllerError: The controller failed, or did not read the sensors from which the score is computed.
        KhepTwinError: A log cannot be written.
    """
    logs = [None] * runs if log is None else run_files(log, runs)
    measurements = [
        _measure_run(file, controller, runs, start, seed + index, run_log)
        for index, (start, run_log) in enumerate(zip(cycle(file.start_poses(runs, seed)), logs, strict=False))
    ]
    values = tuple(_run_score(file, controller, run, metrics) for run, metrics in enumerate(measurements, 1))
    # The mean of a metric is over the runs that have it.
    columns = {name: [row[name] for row in measurements if name in row] for name in chain(*measurements)}
    means = {name: math.fsum(column) / len(column) for name, column in columns.items()}
    return Score(math.fsum(values) / runs, values, means)


def is_worth_compiling(challenge: Challenge, runs: int) -> bool:
    """Return whether compiled code saves more time in these runs than its loading takes."""
    return runs * challenge.seconds >= _COMPILE_FROM_S


class LimitedTime:
    """`TimeSource` with a limit of the simulated time; to advance beyond it raises an error.

    Attributes:
        limit_ns: Limit of the world's time [ns]; None for no limit.
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


def _measure_run(
    file: ChallengeFile, controller: str, runs: int, start: StartPose, seed: int, log: Path | None
) -> dict[str, float]:
    """Return the metrics of one run."""
    challenge = file.challenge
    if controller not in BUILT_IN:
        forget_modules_beside(Path(controller.partition(":")[0]).absolute())  # of the previous run
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what a learner's program may use)
    program = find_controller(controller)
    twin = open_twin(at_start(file.playpen, 0, start), TwinOptions(seed))
    limited_time = LimitedTime(twin.world, to_ns(challenge.seconds))
    twin.time_source = limited_time
    as_controller(program).require_model(twin.robot_model)
    if twin.world.code.switch_step is not None and is_worth_compiling(challenge, runs):
        twin.world.code.switch_step = 0
    names = [item.name for item in movable_objects(file.playpen)]
    goals = _goals(challenge, twin.world.lamps)
    movable = None if challenge.object is None else names.index(challenge.object)
    task = TaskMetrics(twin.world, twin.robot.index, goals, movable)

    def record(opened: Twin) -> None:
        if log is not None:
            source = source_of(program)
            facts = {**source.facts, "challenge": challenge.name}
            opened.record(log, facts=facts, attachments=source.attachments)

    results: list[SeriesRun] = []
    with open_robot(twin.robot_model, Serial.of(twin, timeout=1.0)) as robot:
        plan = Plan(seconds=challenge.seconds)
        source = OneRobot(robot, record)
        try:
            results += run_series(program, source, plan, stop=limited_time.is_over, on_abort=results.append)
        except KhepTwinError:
            # After the limit, the error is the refusal, or the controller's reaction to it.
            if not results or not limited_time.is_over():
                raise
        finally:
            limited_time.limit_ns = None
    return {**results[0].metrics, **task.metrics(challenge.seconds)}


def _goals(challenge: Challenge, lamps: Lamps) -> list[tuple[float, float, float]]:
    """Return the goals of a run: x, y, radius [m]."""
    lit_lamps = {name for name, power in zip(lamps.names, lamps.powers, strict=True) if power}
    goals = [goal for goal in challenge.goals if goal.lamp is None or goal.lamp in lit_lamps]
    if challenge.goals and not goals:
        text = f"a run begins with the lamps {', '.join(sorted(lit_lamps)) or '-'} on, and has no goal"
        raise ChallengeError(text, file=challenge.name, expected="a [[goal]] for each lamp")
    return [(goal.x_mm / 1e3, goal.y_mm / 1e3, goal.radius_mm / 1e3) for goal in goals]


def _run_score(file: ChallengeFile, controller: str, run: int, metrics: Mapping[str, float]) -> float:
    """Return the score of a run.

    Raises:
        ControllerError: The run lacks a metric of the score.
    """
    challenge = file.challenge
    for name in (challenge.metric, *(penalty.metric for penalty in challenge.penalties)):
        if name not in metrics:
            expected = "a program that asks the robot for what it is computed from"
            raise ControllerError(f"{controller}: run {run} has no {name}; expected {expected}")
    sign = -1 if challenge.better == "higher" else 1
    penalty_sum = math.fsum(penalty.each * metrics[penalty.metric] for penalty in challenge.penalties)
    return metrics[challenge.metric] + sign * penalty_sum
