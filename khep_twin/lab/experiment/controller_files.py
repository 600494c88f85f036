"""Controllers and other functions in a user's files, found by name."""

import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from khep_twin.errors import ControllerError, choices, in_a_line
from khep_twin.lab.experiment.controller_source import ReadOnceLoader
from khep_twin.lab.experiment.controllers import (
    BUILT_IN,
    AnyController,
    AnyFunction,
    Controller,
    LoopingController,
    call,
    defining,
    line_in,
    name_of,
    source_file,
)
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.signals import is_interruption

Offered = TypeVar("Offered", bound=type[Controller] | AnyFunction)


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
    """
    path, wanted = _file_and_name(name)
    module = inspect.getmodule(defining(controller))
    same = module is not None and Path(module.__file__ or "") == path.absolute()
    functions = _functions_of(_offers_of(module if module is not None and same else _module_of(path)))
    wanted, found = _chosen(path, wanted, functions, "after", "a run")
    if isinstance(controller, LoopingController):
        return _returning(path, wanted, found, "after each run")
    return _plain(path, wanted, found, "run")


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
        raise ControllerError(f"{path}{line_in(error, path)}: {name}() failed: {reason}") from error


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
        raise ControllerError(f"{path}{line_in(error, path)}: {in_a_line(error)}") from error
    return module
