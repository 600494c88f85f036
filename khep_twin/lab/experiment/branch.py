"""Runs branched off a logged one: the same up to a moment, and from there on with something changed.

The new log begins with the messages of its parent up to the last snapshot before the moment; the rest up to
the moment is run again and recorded. Without a change the recorded hosts go on, and the run is the parent's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.controllers import AnyController, as_controller, stopped_at_end
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.run_statistics import Floats
from khep_twin.log.recorded import BranchPoint
from khep_twin.ports.branching import Described, branch_off
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.replay import Setup
from khep_twin.ports.resume import ResumedRun, run_end_ns
from khep_twin.ports.twin import Twin
from khep_twin.sensing import calibration
from khep_twin.world import Observer, World


@dataclass(frozen=True, slots=True)
class BranchPlan:
    """Plan of a branch.

    Attributes:
        log: Log of the parent.
        change: Moment, and what is different from then on.
        controller: Controller that takes over; None for the recorded hosts.
        robot: Index of its robot; None for the one that was on the parent's line.
        seconds: Time to go on for [s]; None up to the parent's end.
        cycles: Cycles of the controller to go on for; None for a time.
    """

    log: Path
    change: BranchPoint
    controller: AnyController | None = None
    robot: int | None = None
    seconds: float | None = None
    cycles: int | None = None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Trajectory from the moment on: times (n,) [s], x, y [m], heading [rad] (n, n_robots, 3)."""

    times_s: Floats
    poses: Floats


def branch(
    plan: BranchPlan,
    path: Path,
    *,
    on_failure: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Trajectory:
    """Run a branch and write its log; return the trajectory from the moment on.

    Args:
        plan: Plan of the branch.
        path: Path of the new log.
        on_failure: Function that takes the line about a log that cannot be written any more; None to end.
        progress: Function that takes the part of the time from the moment on that is done, 0 to 1.
        stop: Function that returns whether to end early.

    Raises:
        LogError: The parent's log lacks what that needs, or the new one cannot be written.
        KhepTwinError: The change, or the controller, cannot be used.
    """
    if plan.cycles is not None:
        end_ns = None
    elif plan.seconds is not None:
        end_ns = plan.change.at_ns + round(plan.seconds * NS_PER_S)
    else:
        end_ns = run_end_ns(plan.log)
    source = plan.controller and source_of(plan.controller)
    more = Described(source.facts, source.attachments) if source else Described()
    same = plan.controller is None and not plan.change.text
    resumed = branch_off(plan.log, plan.change, path, more, on_failure, same=same)
    observed = _Observed(resumed.twin.world)
    # As of any run that fails, the log has what came before.
    with resumed.twin:
        if plan.controller is None:
            last_ns = end_ns or plan.change.at_ns
            resumed.run_to(last_ns, progress, stop)
            resumed.hosts.repeat(lambda time_ns: time_ns <= last_ns)
        else:
            _take_over(resumed, plan, plan.controller, end_ns, progress, stop)
    return observed.trajectory()


def calibrations(log: Path, name: str, robot: int | None) -> dict[str, str]:
    """Return the text of a calibration for a robot, or for those on the line of a log."""
    setup = Setup.of(log)
    wanted = setup.options.robot if robot is None else robot
    text = calibration.read(name)[1]
    return {each: text for index, each in enumerate(setup.label.robots) if wanted in (None, index)}


def _take_over(
    resumed: ResumedRun,
    plan: BranchPlan,
    controller: AnyController,
    end_ns: int | None,
    progress: Callable[[float], None] | None,
    stop: Callable[[], bool] | None,
) -> None:
    """Let a controller take over its robot; the recorded hosts of others go on."""
    twin = resumed.twin
    index = twin.robot.index if plan.robot is None else plan.robot
    if not 0 <= index < len(twin.world.robots):
        raise LogError(f"{plan.log}: robot = {index}; expected 0 to {len(twin.world.robots) - 1}")
    resumed.hosts.replace(index)
    view = Twin(twin.world, (twin.world.robots[index],), twin.options, resumed.hosts)
    seconds = None if end_ns is None else max((end_ns - twin.world.time_ns) / NS_PER_S, 0.0) or _ENDLESS_S
    algorithm = as_controller(controller)
    with Khepera(Serial.of(view, timeout=1.0)) as robot, stopped_at_end(algorithm, robot):
        run(algorithm, robot, cycles=plan.cycles, seconds=seconds, progress=progress, stop=stop)


_ENDLESS_S = 60.0
"""Time that a controller goes on for at the end of its parent [s], as `khep-twin run` does."""


class _Observed(Observer):
    """Observer of the robots' poses; it is none of the run's and ends with it."""

    def __init__(self, world: World) -> None:
        self._times_ns: list[int] = []
        self._poses: list[list[tuple[float, float, float]]] = []
        world.add_observer(self)

    def sample(self, world: World) -> None:
        """Note the poses."""
        self._times_ns.append(world.time_ns)
        self._poses.append(world.poses)

    def trajectory(self) -> Trajectory:
        """Return the trajectory so far."""
        return Trajectory(np.array(self._times_ns) / NS_PER_S, np.array(self._poses))
