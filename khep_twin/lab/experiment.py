"""Experiments: a controller, a robot, and for how long."""

import importlib.util
import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from khep_twin.errors import ControllerError, KhepTwinError, choices
from khep_twin.host import Khepera
from khep_twin.lab.controllers import BUILT_IN, Controller


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        cycles: how often the controller was called.
        duration: how long the run took in the port's own time [s].
    """

    cycles: int
    duration: float


def run(
    controller: Controller,
    robot: Khepera,
    *,
    cycles: int | None = None,
    seconds: float | None = None,
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Outcome:
    """Calls a controller once a cycle, then stops the motors.

    Args:
        controller: what drives the robot.
        robot: what is driven.
        cycles: end after so many calls.
        seconds: end after this time, in the port's own time [s].
        progress: is told after each cycle which part of the run is done, 0 to 1.
        stop: is asked before each cycle whether to end early.

    Raises:
        ValueError: neither cycles nor seconds are given, or one is not above 0.
        ControllerError: the controller failed, or lets no time pass.
    """
    if cycles is None and seconds is None:
        raise ValueError("a run needs an end: cycles or seconds")
    if (cycles is not None and cycles < 1) or (seconds is not None and not seconds > 0):
        raise ValueError(f"cycles {cycles} and seconds {seconds} must be above 0")
    start = robot.time
    done = 0
    part = 0.0
    try:
        while part < 1 and not (stop is not None and stop()):
            before = robot.time
            _cycle(controller, robot)
            if robot.time == before:
                raise ControllerError(
                    f"{_place(controller)}: a cycle lets no time pass; right is to ask the robot something, "
                    "or robot.sleep"
                )
            done += 1
            by_cycles = done / cycles if cycles else 0.0
            by_time = (robot.time - start) / seconds if seconds else 0.0
            part = max(by_cycles, by_time)
            if progress is not None:
                progress(min(part, 1.0))
    except BaseException:
        # What went wrong is told; that the motors cannot be stopped any more would only hide it.
        with suppress(KhepTwinError):
            robot.set_speed(0, 0)
        raise
    robot.set_speed(0, 0)
    return Outcome(done, robot.time - start)


def _cycle(controller: Controller, robot: Khepera) -> None:
    """Calls the controller once; what fails in it is told by place, as one line."""
    try:
        controller(robot)
    except KhepTwinError:
        raise
    except (Exception, SystemExit) as error:
        file = Path(inspect.getsourcefile(controller) or "")
        raise ControllerError(f"{file}{_line_in(error, file)}: {type(error).__name__}: {error}") from error


def _place(controller: Controller) -> str:
    return f"{inspect.getsourcefile(controller)}: {controller.__name__}"


def find_controller(name: str) -> Controller:
    """A controller by its built-in name, or as FILE.py or FILE.py:FUNCTION.

    Without FUNCTION, the file's function `controller` is taken, or its only public one.

    Raises:
        ControllerError: there is no such controller, or its file fails.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]
    path_text, _, function = name.partition(":")
    path = Path(path_text)
    if path.suffix != ".py":
        raise ControllerError(
            f"{name}: no such controller; right is FILE.py, FILE.py:FUNCTION or a built-in name; "
            f"{choices(name, BUILT_IN)}"
        )
    functions = _functions_of(path)
    if not function:
        function = "controller" if "controller" in functions or len(functions) != 1 else next(iter(functions))
    found = functions.get(function)
    if found is None:
        raise ControllerError(
            f"{path}: no function {function!r} that takes a robot; {choices(function, functions)}"
        )
    if inspect.isgeneratorfunction(found) or inspect.iscoroutinefunction(found):
        raise ControllerError(
            f"{path}: {function!r} is no plain function; right is one that returns each cycle"
        )
    if len(inspect.signature(found).parameters) != 1:
        raise ControllerError(f"{path}: {function!r} takes {inspect.signature(found)}; right is one robot")
    return found


def _functions_of(path: Path) -> dict[str, Any]:
    """The public functions that a file defines itself."""
    if not path.is_file():
        raise ControllerError(f"{path}: no such file")
    spec = importlib.util.spec_from_file_location(f"khep_twin_controller_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ControllerError(f"{path}: cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # What lies beside a program can be imported by it, as when Python runs it.
    folder = str(path.parent.resolve())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        # A user's file may fail in any way; the place and the reason are told.
        line = _line_in(error, path)
        raise ControllerError(f"{path}{line}: {type(error).__name__}: {error}") from error
    return {
        name: function
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }


def _line_in(error: BaseException, path: Path) -> str:
    """Where in the file an error arose, as ":LINE"."""
    if isinstance(error, SyntaxError):
        return f":{error.lineno}"
    trace, line = error.__traceback__, ""
    while trace is not None:
        if Path(trace.tb_frame.f_code.co_filename).resolve() == path.resolve():
            line = f":{trace.tb_lineno}"
        trace = trace.tb_next
    return line
