"""Runs of a controller on a robot for a number of cycles or seconds."""

import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from khep_twin.errors import ControllerError, KhepTwinError, choices, in_a_line
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controller_source import ReadOnceLoader
from khep_twin.lab.experiment.controllers import (
    BUILT_IN,
    AnyController,
    AnyFunction,
    Controller,
    LoopingController,
    as_controller,
    defining,
    name_of,
)
from khep_twin.signals import is_interruption

if TYPE_CHECKING:
    from khep_twin.lab.experiment.series import SeriesRun

P = ParamSpec("P")
Returned = TypeVar("Returned")
Offered = TypeVar("Offered", bound=type[Controller] | AnyFunction)


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
            place = f"{_source_file(controller)}: {name_of(controller)}"
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


def call(place: Callable[P, Returned], *given: P.args, **named: P.kwargs) -> Returned:
    """Call a user's function or a controller's method and return what it returns.

    Raises:
        ControllerError: It failed, with file and line.
    """
    try:
        return place(*given, **named)
    except KhepTwinError:
        raise
    except BaseException as error:
        if is_interruption(error):
            raise
        file = _source_file(place)
        raise ControllerError(f"{file}{_line_in(error, Path(file))}: {in_a_line(error)}") from error


def _source_file(controller: AnyController | AnyFunction) -> str:
    """Return the file that defines a controller or one of its methods; empty if none does."""
    try:
        return inspect.getsourcefile(defining(controller)) or ""
    except TypeError:  # a callable that is not defined in a file
        return ""


def find_controller(
    name: str, adapt: Callable[[AnyController], AnyController] = lambda controller: controller
) -> AnyController:
    """Find a controller by its built-in name, or as FILE.py or FILE.py:NAME.

    Without NAME, the file's `controller` is used, or its only public function or subclass of `Controller`.
    `adapt` makes a controller of a function of another form, and returns others unchanged.

    Raises:
        ControllerError: There is no such controller, or its file fails.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]
    wish = f"FILE.py, FILE.py:NAME or a built-in name; {choices(name, BUILT_IN)}"
    path, wanted = _file_and_name(name, f"no such controller; expected {wish}")
    offers = _offers_of(_module_of(path))
    classes = {each: offer for each, offer in offers.items() if isinstance(offer, type)}
    if not wanted and len(classes) == 1 and "controller" not in offers:
        offers = classes  # beside a single class, functions are its tools
    taking = "a robot, and no such subclass of Controller"
    wanted, found = _chosen(path, wanted, offers, "controller", taking)
    if isinstance(found, type):
        return _made(path, wanted, found)
    adapted = adapt(found)
    return adapted if adapted is not found else _plain(path, wanted, found, "robot")


def find_function(name: str, taking: str, n_parameters: int) -> AnyFunction:
    """Find a function of `n_parameters`, described by `taking`, as FILE.py or FILE.py:NAME.

    Without NAME, the file's `controller` is used, or its only public function.

    Raises:
        ControllerError: There is no such function, or its file fails.
    """
    path, wanted = _file_and_name(name)
    functions = _functions_of(_offers_of(_module_of(path)))
    wanted, found = _chosen(path, wanted, functions, "controller", taking)
    if len(inspect.signature(found).parameters) != n_parameters:
        raise ControllerError(f"{path}: {wanted!r} takes {inspect.signature(found)}; expected {taking}")
    return found


def find_on_run_end(name: str, controller: AnyController) -> AnyFunction:
    """Find a function that is called with each run, as FILE.py or FILE.py:NAME.

    Without NAME, the file's `after` is used, or its only public function. If the same file defines the
    controller of the runs, too, they share its variables.

    Raises:
        ControllerError: There is no such function, or its file fails.
    """
    path, wanted = _file_and_name(name)
    module = inspect.getmodule(defining(controller))
    same = module is not None and Path(module.__file__ or "") == path.absolute()
    functions = _functions_of(_offers_of(module if module is not None and same else _module_of(path)))
    wanted, found = _chosen(path, wanted, functions, "after", "a run")
    if isinstance(controller, LoopingController):
        return _returning(path, wanted, found, "after each run")
    return _plain(path, wanted, found, "run")


def call_on_run_end(function: AnyFunction, run: "SeriesRun") -> object:
    """Call a user's function after a run: with the run, or with those of its variables that it names.

    Raises:
        ControllerError: It failed, or has other parameters.
    """
    parameters = inspect.signature(function).parameters.values()
    wanted = [each.name for each in parameters if each.kind is not each.KEYWORD_ONLY]
    missing = [name for name in wanted if name not in run.variables]
    if len(wanted) == 1 and missing:
        return call(function, run)
    if missing:
        known = ", ".join(run.variables) or "none"
        raise ControllerError(
            f"{_source_file(function)}: {name_of(function)!r} takes {missing[0]}; expected a run, or its "
            f"variables by name: {known}"
        )
    return call(function, *(run.variables[name] for name in wanted))


def _file_and_name(
    typed: str, otherwise: str = "no such function; expected FILE.py or FILE.py:NAME"
) -> tuple[Path, str]:
    """Split FILE.py[:NAME] in its parts; raise a `ControllerError` if it is not a Python file."""
    path, _, name = typed.partition(":")
    if not path.endswith(".py"):
        raise ControllerError(f"{typed}: {otherwise}")
    return Path(path), name


def _chosen(
    path: Path, wanted: str, offers: Mapping[str, Offered], usual: str, taking: str
) -> tuple[str, Offered]:
    """Return an object of a user's file by its name, else the usual one or the only one, and its name."""
    if not wanted:
        wanted = usual if usual in offers or len(offers) != 1 else next(iter(offers))
    if wanted not in offers:
        raise ControllerError(
            f"{path}: no function {wanted!r} that takes {taking}; {choices(wanted, offers)}"
        )
    return wanted, offers[wanted]


def _functions_of(offers: Mapping[str, type[Controller] | AnyFunction]) -> dict[str, AnyFunction]:
    return {name: offer for name, offer in offers.items() if not isinstance(offer, type)}


def _plain(path: Path, name: str, function: AnyFunction, taking: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` unless it has one parameter and returns."""
    if len(inspect.signature(function).parameters) != 1:
        takes = inspect.signature(function)
        raise ControllerError(f"{path}: {name!r} takes {takes}; expected one {taking}")
    return _returning(path, name, function, "each cycle" if taking == "robot" else "after each run")


def _returning(path: Path, name: str, function: AnyFunction, when: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` for a generator or coroutine."""
    if inspect.isgeneratorfunction(function) or inspect.iscoroutinefunction(function):
        raise ControllerError(f"{path}: {name!r} is no plain function; expected one that returns {when}")
    return function


def _made(path: Path, name: str, kind: type[Controller]) -> Controller:
    """Return an object of a user's class."""
    try:
        return kind()
    except BaseException as error:
        if is_interruption(error):
            raise
        reason = in_a_line(error)
        raise ControllerError(f"{path}{_line_in(error, path)}: {name}() failed: {reason}") from error


def _offers_of(module: ModuleType) -> dict[str, type[Controller] | AnyFunction]:
    """Return the public functions and controllers that a file defines itself."""
    return {
        name: offer
        for name, offer in vars(module).items()
        if not name.startswith("_")
        and getattr(offer, "__module__", None) == module.__name__
        and (inspect.isfunction(offer) or (isinstance(offer, type) and issubclass(offer, Controller)))
    }


def _module_of(path: Path) -> ModuleType:
    """Run a user's file as a module and return it."""
    if not path.is_file():
        odd = "this is no regular file; expected the name of a file" if path.exists() else "no such file"
        raise ControllerError(f"{path}: {odd}")
    # Files of the same name in two folders are two modules.
    place = sha256(os.fsencode(path.absolute())).hexdigest()[:8]
    name = f"khep_twin_controller_{place}_{path.stem}"
    # An absolute name stays valid if the controller changes the folder.
    loader = ReadOnceLoader(name, str(path.absolute()))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    if spec is None or spec.loader is None:
        raise ControllerError(f"{path}: cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # A program can import modules beside it, as when Python runs it.
    folder = str(path.parent.resolve())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        # A user's file may fail in any way; report location and reason.
        if is_interruption(error):
            raise
        raise ControllerError(f"{path}{_line_in(error, path)}: {in_a_line(error)}") from error
    return module


def _line_in(error: BaseException, path: Path) -> str:
    """Return the line of a file in which an error arose, as ":LINE"."""
    if isinstance(error, SyntaxError):
        return "" if error.lineno is None else f":{error.lineno}"  # none in a binary file
    frames = traceback.walk_tb(error.__traceback__)
    there = path.resolve()
    lines = [line for frame, line in frames if Path(frame.f_code.co_filename).resolve() == there]
    return f":{lines[-1]}" if lines else ""
