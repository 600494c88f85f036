"""Runs of a controller on a robot for a number of cycles or seconds."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.experiment.controllers import (
    AnyController,
    LoopingController,
    as_controller,
    call,
    name_of,
    source_file,
)
from khep_twin.lab.experiment.periodic_controllers import PeriodicController


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run.

    Attributes:
        cycles: Number of calls of the controller.
        duration: Duration of the run in the port's time [s].
        complete: True unless the run was stopped early.
        cycle_time: Mean time of a cycle; of a controller without a period, that of its exchanges [s].
        expected_cycle_time: Period of the controller, or the time of the bytes if that is longer [s].
    """

    cycles: int
    duration: float
    complete: bool = True
    cycle_time: float = 0.0
    expected_cycle_time: float = 0.0


def run(
    controller: AnyController,
    robot: HostRobot,
    *,
    cycles: int | None = None,
    seconds: float | None = None,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
    after_cycle: Callable[[], None] | None = None,
) -> Outcome:
    """Start a controller, call it once a cycle, then stop the motors and call the controller's `end`.

    Args:
        controller: Controller of the robot.
        robot: Robot to drive.
        cycles: Number of calls of the controller.
        seconds: Duration in the port's time [s]; the run ends at the first limit that it reaches.
        progress: Called after each cycle with the completed share of the run, 0 to 1.
        stop: Called before each cycle; returns whether to stop early.
        after_cycle: Called after each cycle.

    Raises:
        ValueError: Neither cycles nor seconds are given, or one is not above 0.
        ControllerError: The controller failed, or lets no time pass.
        PortError: The port failed, or has no time for seconds.
    """
    if cycles is None and seconds is None:
        raise ValueError("no cycles and no seconds; expected one of them")
    if (cycles is not None and cycles < 1) or (seconds is not None and not seconds > 0):
        raise ValueError(f"cycles = {cycles}, seconds = {seconds}; expected numbers above 0")
    if seconds is not None:
        robot.check_clock(f"a run of {seconds:g} s instead of cycles")
    controller = as_controller(controller)
    controller.require_model(robot.model)
    should_stop = stop or (lambda: False)
    start = previous_time = robot.time
    n_cycles, completed = 0, 0.0

    def end_cycle() -> bool:
        """Count a cycle; return whether to continue."""
        nonlocal previous_time, n_cycles, completed
        now = robot.time
        if now == previous_time:
            subject = f"{source_file(controller)}: {name_of(controller)}"
            raise ControllerError(f"{subject}: a cycle lets no time pass; expected {controller.passes_time}")
        previous_time = now
        n_cycles += 1
        if after_cycle is not None:
            after_cycle()
        cycle_share = n_cycles / cycles if cycles else 0.0
        time_share = (robot.time - start) / seconds if seconds else 0.0
        completed = max(cycle_share, time_share)
        if progress is not None:
            progress(min(completed, 1.0))
        return completed < 1 and not should_stop()

    try:
        call(controller.start, robot)
        first_cycle, start_times = robot.time, robot.line_times
        if isinstance(controller, LoopingController):
            if cycles is None or seconds is not None:
                raise ControllerError(
                    f"{name_of(controller)}: counts its cycles; expected cycles, no seconds"
                )
            loop_cycles = call(controller.loop, robot, cycles, end_cycle, should_stop)
            n_cycles, completed = (n_cycles, completed) if loop_cycles is None else (loop_cycles, 1.0)
        else:
            is_running = not should_stop()
            while is_running:
                call(controller.cycle, robot)
                is_running = end_cycle()
        end, times = robot.time, robot.line_times
        robot.stop()
        call(controller.end, robot)
    except BaseException:
        # A second error of this command would hide the first one.
        with suppress(KhepTwinError):
            robot.stop()
        raise
    period = controller.period if isinstance(controller, PeriodicController) else 0.0
    line_time, byte_time = times.exchanges - start_times.exchanges, times.bytes - start_times.bytes
    cycle_time = (end - first_cycle if period else line_time) / max(n_cycles, 1)
    expected_cycle_time = max(period, byte_time / max(n_cycles, 1))
    return Outcome(n_cycles, end - start, completed >= 1, cycle_time, expected_cycle_time)
