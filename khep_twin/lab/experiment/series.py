"""Series of runs of one controller, on a robot or on twins, with the metrics of each run.

    from khep_twin.lab.experiment.series import OneRobot, run_series
    from khep_twin.lab.experiment.series_run import Plan

    with Khepera("khep://obstacles") as robot:
        for run in run_series(braitenberg, OneRobot(robot), Plan(runs=20, cycles=500)):
            print(run.number, run.metrics["fitness"])

On one robot, on any port, each run starts where the robot stands. On new twins, each run has a separate start
and seed, so that it does not depend on the others.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace

from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.lab.experiment.controllers import (
    AnyController,
    Controller,
    as_controller,
    copy_variables,
    stopped_at_end,
)
from khep_twin.lab.experiment.experiment import Outcome, run
from khep_twin.lab.experiment.measures import GroundTruthMetrics, HostMetrics
from khep_twin.lab.experiment.series_run import Plan, SeriesRun
from khep_twin.lab.experiment.start_poses import StartPose
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.renamed import renamed_arguments

_STOP_CHECK_S = 0.1
"""Interval at which a pause calls `stop` [s]."""


@dataclass(frozen=True, slots=True)
class Session:
    """A robot and its runs.

    Attributes:
        numbers: Numbers of the runs.
        robot_context: Context manager that yields the robot.
        start: Start pose of each run; None to start where the robot stands.
    """

    numbers: range
    robot_context: AbstractContextManager[HostRobot]
    start: StartPose | None = None


class OneRobot:
    """One robot for all runs, each from where it stands; `record` starts the log of a twin."""

    def __init__(self, robot: HostRobot, record: Callable[[Twin], None] | None = None) -> None:
        self._robot = robot
        self._record = record

    def first_run(self, n_saved: int, controller: AnyController) -> int:
        """Return the next run; for a twin in this process 1, as it repeats the saved runs."""
        return n_saved + 1 if twin_of(self._robot) is None else 1

    def sessions(self, numbers: range) -> Iterator[Session]:
        """Yield one session with all runs."""
        twin = twin_of(self._robot)
        if self._record is not None and twin is not None:
            self._record(twin)
        yield Session(numbers, nullcontext(self._robot))

    def hold(self) -> None:
        """Stop the robot's motors, from another thread."""
        self._robot.hold()


class FreshTwins:
    """A new twin for each run, in this process.

    Args:
        playpen: Playpen of all twins.
        options: Options of the twins; run n has the seed `options.seed` + n - 1.
        starts: Start poses, used in turn.
        record: Called to start the log of a run's twin.

    Raises:
        ControllerError: There is no start pose.
    """

    def __init__(
        self,
        playpen: Playpen,
        options: TwinOptions,
        starts: Sequence[StartPose],
        record: Callable[[Twin, int], None] | None = None,
    ) -> None:
        if not starts:
            raise ControllerError("a series of new twins needs a start")
        self._playpen = playpen
        self._options = options
        self._starts = starts
        self._record = record
        self._robot: HostRobot | None = None

    def first_run(self, n_saved: int, controller: AnyController) -> int:
        """Return the last saved run, which is repeated as a check; 1 for a `Controller`, which may learn."""
        return 1 if isinstance(controller, Controller) else max(1, n_saved)

    def sessions(self, numbers: range) -> Iterator[Session]:
        """Yield a session with a new twin for each run."""
        for number in numbers:
            start = self._starts[(number - 1) % len(self._starts)]
            yield Session(range(number, number + 1), self._twin(number, start), start)

    def hold(self) -> None:
        """Stop the motors of the running twin, from another thread."""
        if self._robot is not None:
            self._robot.hold()

    @contextmanager
    def _twin(self, number: int, start: StartPose) -> Generator[HostRobot]:
        options = replace(self._options, seed=self._options.seed + number - 1)
        twin = open_twin(at_start(self._playpen, options.robot or 0, start), options)
        if self._record is not None:
            self._record(twin, number)
        with open_robot(twin.robot_model, Serial.of(twin, timeout=1.0)) as self._robot:
            yield self._robot


RobotSource = OneRobot | FreshTwins
"""Source of the robots of a series."""


@renamed_arguments(before="before_run", broken_off="on_abort")
def run_series(
    controller: AnyController,
    source: RobotSource,
    plan: Plan,
    *,
    first: int = 1,
    before_run: Callable[[int], None] | None = None,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
    on_abort: Callable[[SeriesRun], None] | None = None,
) -> Generator[SeriesRun]:
    """Run a controller repeatedly; yield each complete run.

    Args:
        controller: Controller of the robot.
        source: Source of the robots.
        plan: Number and length of the runs.
        first: Number of the first run, for a resumed series.
        before_run: Called with each run's number before it, after the pause, e.g. to place a robot manually.
        progress: Called after each cycle with the completed share of the series, 0 to 1.
        stop: Called before each cycle; returns whether to stop early. An aborted run is not yielded.
        on_abort: Called with the incomplete run that `stop` aborted.

    Raises:
        ControllerError: The controller failed, or lets no time pass.
        KhepTwinError: The port failed.
    """
    controller, should_stop = as_controller(controller), stop or (lambda: False)
    for session in source.sessions(range(first, plan.runs + 1)):
        if should_stop():
            return
        with session.robot_context as robot, stopped_at_end(controller, robot):
            for number in session.numbers:
                if number > session.numbers[0]:
                    _pause(robot, plan.pause, should_stop)
                if before_run is not None:
                    before_run(number)
                if should_stop():
                    break
                completed = _run_one(
                    controller, robot, session.start, number, plan, progress, should_stop, on_abort
                )
                if completed is None:
                    break
                yield completed


def _run_one(
    controller: Controller,
    robot: HostRobot,
    start: StartPose | None,
    number: int,
    plan: Plan,
    progress: Callable[[float], None] | None,
    stop: Callable[[], bool],
    on_abort: Callable[[SeriesRun], None] | None,
) -> SeriesRun | None:
    """Return one run; None for an aborted run, which is passed to `on_abort`."""
    host_metrics, twin = HostMetrics(robot.model) if robot.model.interface else None, twin_of(robot)
    ground_truth = None if twin is None else GroundTruthMetrics(twin.world, twin.robot.index)
    start_time, n_cycles = robot.time, 0

    def end_cycle() -> None:
        nonlocal n_cycles
        if host_metrics is not None:
            host_metrics.end_cycle()
        n_cycles += 1

    def make_series_run(outcome: Outcome) -> SeriesRun:
        metrics = {} if host_metrics is None else host_metrics.metrics()
        metrics |= {} if ground_truth is None else ground_truth.metrics()
        variables = copy_variables(controller)
        # A twin in this process waits for its host.
        cycle_times = (outcome.cycle_time, outcome.expected_cycle_time) if twin is None else ()
        return SeriesRun(number, start, outcome.cycles, outcome.duration, metrics, variables, *cycle_times)

    _log_event(twin, f"run {number} begins")
    robot.listen(host_metrics)
    try:
        try:
            outcome = run(
                controller,
                robot,
                cycles=plan.cycles,
                seconds=plan.seconds,
                progress=None if progress is None else lambda part: progress((number - 1 + part) / plan.runs),
                stop=stop,
                after_cycle=end_cycle,
            )
        finally:
            robot.listen(None)
            if ground_truth is not None:
                ground_truth.end()
    except KhepTwinError:
        # The error may be due to `stop` within a cycle.
        if on_abort is not None and stop():
            on_abort(make_series_run(Outcome(n_cycles, robot.time - start_time, complete=False)))
        raise
    _log_event(twin, f"run {number} ends" if outcome.complete else f"run {number} is broken off")
    if outcome.complete:
        return make_series_run(outcome)
    if on_abort is not None:
        on_abort(make_series_run(outcome))
    return None


def _pause(robot: HostRobot, duration: float, stop: Callable[[], bool]) -> None:
    """Wait for a duration in the port's time [s], or until `stop` returns True."""
    remaining = duration
    while remaining > 0 and not stop():
        robot.sleep(min(remaining, _STOP_CHECK_S))
        remaining -= _STOP_CHECK_S


def _log_event(twin: Twin | None, text: str) -> None:
    if twin is not None:
        twin.world.log_event(twin.robot.index, text)


def twin_of(robot: HostRobot) -> Twin | None:
    """Return the twin in this process behind a robot's port; None for any other port."""
    return getattr(robot.port, "twin", None)
