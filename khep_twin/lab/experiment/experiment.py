"""Runs of a controller on a robot for a number of cycles or seconds."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import (
    AnyController,
    LoopingController,
    as_controller,
    call,
    name_of,
    source_file,
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run.

    Attributes:
        cycles: Number of calls of the controller.
        duration: Duration of the run in the port's own time [s].
        complete: True unless the run was ended early.
    """

    cycles: int
    duration: float
    complete: bool = True


def run(
    controller: AnyController,
    robot: Khepera,
    *,
    cycles: int | None = None,
    seconds: float | None = None,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
    after_cycle: Callable[[], None] | None = None,
) -> Outcome:
    """Start a controller, call it once a cycle, then stop the motors and end the controller.

    Args:
        controller: Controller of the robot.
        robot: Robot to drive.
        cycles: Number of calls after which to end.
        seconds: Time after which to end, in the port's own time [s].
        progress: Called after each cycle with the completed part of the run, 0 to 1.
        stop: Called before each cycle; returns whether to end early.
        after_cycle: Called after each cycle.

    Raises:
        ValueError: Neither cycles nor seconds are given, or one is not above 0.
        ControllerError: The controller failed, or lets no time pass.
    """
    if cycles is None and seconds is None:
        raise ValueError("no cycles and no seconds; expected one of them")
    if (cycles is not None and cycles < 1) or (seconds is not None and not seconds > 0):
        raise ValueError(f"cycles = {cycles}, seconds = {seconds}; expected numbers above 0")
    algorithm, asked = as_controller(controller), stop or (lambda: False)
    start = before = robot.time
    done, part = 0, 0.0

    def end_cycle() -> bool:
        """Count a cycle and return whether another one follows."""
        nonlocal before, done, part
        now = robot.time
        if now == before:
            place = f"{source_file(controller)}: {name_of(controller)}"
            raise ControllerError(f"{place}: a cycle lets no time pass; expected {algorithm.passes_time}")
        before = now
        done += 1
        if after_cycle is not None:
            after_cycle()
        by_cycles = done / cycles if cycles else 0.0
        by_time = (robot.time - start) / seconds if seconds else 0.0
        part = max(by_cycles, by_time)
        if progress is not None:
            progress(min(part, 1.0))
        return part < 1 and not asked()

    try:
        call(algorithm.start, robot)
        if isinstance(algorithm, LoopingController):
            if cycles is None or seconds is not None:
                raise ControllerError(
                    f"{name_of(controller)}: counts its cycles; expected cycles, no seconds"
                )
            counted = call(algorithm.loop, robot, cycles, end_cycle, asked)
            done, part = (done, part) if counted is None else (counted, 1.0)
        else:
            going = not asked()
            while going:
                call(algorithm.cycle, robot)
                going = end_cycle()
        duration = robot.time - start
        robot.set_speed(0, 0)
        call(algorithm.end, robot)
    except BaseException:
        # A second error while the motors are stopped would only hide the first one.
        with suppress(KhepTwinError):
            robot.set_speed(0, 0)
        raise
    return Outcome(done, duration, part >= 1)
