"""Branches of a logged run: identical to it up to the branch point, and changed from there.

The new log starts with the parent's messages up to the last snapshot before the branch point. The rest up to
the branch point is simulated again. Recorded hosts continue, so a branch without a change equals its parent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.host.host_robot import open_robot
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.controllers import AnyController, as_controller, stopped_at_end
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.run_statistics import Floats
from khep_twin.log.recorded import BranchPoint
from khep_twin.observers import Observer
from khep_twin.ports.branching import LogDetails, branch_off
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.replay import Setup
from khep_twin.ports.resume import ResumedRun, run_end_ns
from khep_twin.ports.twin import Twin
from khep_twin.sensing import calibration
from khep_twin.world import World

DEFAULT_DURATION_S = 60.0
"""Duration of a controller's run that starts at its parent's end [s], as in `khep-twin run`."""


@dataclass(frozen=True, slots=True)
class BranchPlan:
    """Plan of a branch.

    Attributes:
        log: Log of the parent.
        change: Time of the branch point, and the change made there.
        controller: Controller that replaces the recorded host; None for the recorded hosts.
        robot: Index of its robot; None for the robot on the parent's serial line.
        seconds: Duration after the branch point [s]; None up to the parent's end.
        cycles: Number of the controller's cycles; None to limit the duration instead.
    """

    log: Path
    change: BranchPoint
    controller: AnyController | None = None
    robot: int | None = None
    seconds: float | None = None
    cycles: int | None = None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Trajectory after the branch point: times (n,) [s], x, y [m], heading [rad] (n, n_robots, 3)."""

    times_s: Floats
    poses: Floats


def branch(
    plan: BranchPlan,
    path: Path,
    *,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Trajectory:
    """Run a branch and write its log; return the trajectory after the branch point.

    Args:
        plan: Plan of the branch.
        path: Path of the new log.
        progress: Called with the completed share of the time after the branch point, 0 to 1.
        stop: Returns whether to stop early.

    Raises:
        LogError: The parent's log lacks data that a branch needs, or the new log cannot be written.
        KhepTwinError: The change or the controller cannot be used.
    """
    if plan.cycles is not None:
        end_ns = None
    elif plan.seconds is not None:
        end_ns = plan.change.at_ns + round(plan.seconds * NS_PER_S)
    else:
        end_ns = run_end_ns(plan.log)
    source = plan.controller and source_of(plan.controller)
    description = LogDetails(source.facts, source.attachments) if source else LogDetails()
    is_unchanged = plan.controller is None and not plan.change.text
    resumed = branch_off(plan.log, plan.change, path, description, None, is_unchanged=is_unchanged)
    recorder = _PoseRecorder(resumed.twin.world)
    # As for any run that fails, the log is complete up to the error.
    with resumed.twin:
        if plan.controller is None:
            last_ns = end_ns or plan.change.at_ns
            resumed.run_to(last_ns, progress, stop)
            resumed.hosts.repeat(lambda time_ns: time_ns <= last_ns)
        else:
            _run_controller(resumed, plan, plan.controller, end_ns, progress, stop)
    return Trajectory(np.array(recorder.times_ns) / NS_PER_S, np.array(recorder.poses))


def calibration_texts(log: Path, name: str, robot: int | None) -> dict[str, str]:
    """Return a calibration's text by robot name, for one robot or those on the log's serial lines."""
    setup = Setup.of(log)
    robot_index = setup.options.robot if robot is None else robot
    text = calibration.read(name)[1]
    return {key: text for index, key in enumerate(setup.label.robots) if robot_index in (None, index)}


def _run_controller(
    resumed: ResumedRun,
    plan: BranchPlan,
    controller: AnyController,
    end_ns: int | None,
    progress: Callable[[float], None] | None,
    stop: Callable[[], bool] | None,
) -> None:
    """Run a controller on its robot; the recorded hosts of the other robots continue."""
    twin = resumed.twin
    robot_index = twin.robot.index if plan.robot is None else plan.robot
    if not 0 <= robot_index < len(twin.world.robots):
        raise LogError(f"{plan.log}: robot = {robot_index}; expected 0 to {len(twin.world.robots) - 1}")
    resumed.hosts.drop_host(robot_index)
    twin = Twin(twin.world, (twin.world.robots[robot_index],), twin.options, resumed.hosts)
    seconds = (
        None if end_ns is None else max((end_ns - twin.world.time_ns) / NS_PER_S, 0) or DEFAULT_DURATION_S
    )
    controller = as_controller(controller)
    with open_robot(twin.robot_model, Serial.of(twin, 1.0)) as robot, stopped_at_end(controller, robot):
        run(controller, robot, cycles=plan.cycles, seconds=seconds, progress=progress, stop=stop)


class _PoseRecorder(Observer):
    """Observer that records the robots' poses in memory."""

    def __init__(self, world: World) -> None:
        self.times_ns: list[int] = []
        self.poses: list[list[tuple[float, float, float]]] = []
        world.add_observer(self)

    def sample(self, world: World) -> None:
        """Record the poses."""
        self.times_ns.append(world.time_ns)
        self.poses.append(world.poses)
