"""Calls of a user's functions, whose errors tell file and line."""

import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from khep_twin.errors import ControllerError, KhepTwinError, in_a_line
from khep_twin.lab.experiment.controllers import AnyController, AnyFunction, defining, name_of
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.signals import is_interruption

P = ParamSpec("P")
Returned = TypeVar("Returned")


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
        file = source_file(place)
        raise ControllerError(f"{file}{line_in(error, Path(file))}: {in_a_line(error)}") from error


def call_on_run_end(function: AnyFunction, run: SeriesRun) -> object:
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
            f"{source_file(function)}: {name_of(function)!r} takes {missing[0]}; expected a run, or its "
            f"variables by name: {known}"
        )
    return call(function, *(run.variables[name] for name in wanted))


def source_file(controller: AnyController | AnyFunction) -> str:
    """Return the file that defines a controller or one of its methods; empty if none does."""
    try:
        return inspect.getsourcefile(defining(controller)) or ""
    except TypeError:  # a callable that is not defined in a file
        return ""


def line_in(error: BaseException, path: Path) -> str:
    """Return the line of a file in which an error arose, as ":LINE"."""
    if isinstance(error, SyntaxError):
        return "" if error.lineno is None else f":{error.lineno}"  # none in a binary file
    frames = traceback.walk_tb(error.__traceback__)
    there = path.resolve()
    lines = [line for frame, line in frames if Path(frame.f_code.co_filename).resolve() == there]
    return f":{lines[-1]}" if lines else ""
