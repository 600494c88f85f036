"""Controllers and other functions in a user's files, found by name: programs, and networks."""

import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from khep_twin.episodes.controllers import Braitenberg, Driver, Network
from khep_twin.episodes.network_file import SUFFIX
from khep_twin.errors import ControllerError, choices
from khep_twin.files.atomic import open_regular, resolved
from khep_twin.files.text import check_encoding
from khep_twin.files.toml_files import names
from khep_twin.invocation import command
from khep_twin.lab.experiment.controller_source import ReadOnceLoader
from khep_twin.lab.experiment.controllers import (
    BUILT_IN,
    AnyController,
    AnyFunction,
    Controller,
    LoopingController,
    call,
    defining,
    failed,
    name_of,
    source_file,
)
from khep_twin.lab.experiment.periodic_controllers import NetworkController, PeriodicController
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.lab.experiment.users_folder import begin_here, in_users_folder
from khep_twin.signals import is_interruption

Offer = type[Controller] | PeriodicController | AnyFunction
Offered = TypeVar("Offered", bound=Offer)


def find_controller(
    name: str, adapt: Callable[[AnyController], AnyController] = lambda controller: controller
) -> AnyController:
    """Find a controller by its built-in name, or as FILE.py, FILE.py:NAME or a network's FILE.npz.

    Without NAME, the file's `controller` is used, or its only public function or subclass of `Controller`, or
    the only `TaskController` or `NetworkController` that it makes.
    `adapt` makes a controller of a function of another form, and returns others unchanged.

    Raises:
        ControllerError: There is no such controller, or its file fails.
    """
    begin_here()
    if name in BUILT_IN:
        return BUILT_IN[name]
    if name.endswith(SUFFIX):
        return NetworkController(Network.load(name), Path(name).name)
    path, wanted = _file_and_name(name, f"no such controller; expected {_wish(name)}")
    module = _module_of(path)
    offers = _offers_of(module)
    whole = {each: offer for each, offer in offers.items() if isinstance(offer, type | PeriodicController)}
    if not wanted and len(whole) == 1 and "controller" not in offers:
        offers = whole  # beside a single class, functions are its tools
    wanted, found = _chosen(path, wanted, module, offers, _CONTROLLER)
    if isinstance(found, PeriodicController):
        found.defined_by = module
        return found
    if isinstance(found, type):
        return _made(path, wanted, found)
    adapted = adapt(found)
    return adapted if adapted is not found else _plain(path, wanted, found, "robot")


def find_driver(name: str) -> Driver | AnyFunction:
    """Find a controller of episodes: a built-in one, a network's FILE.npz, or a function.

    The function is one of proximity and ambient light, as FILE.py or FILE.py:NAME. Without NAME, the file's
    `controller` is used, or its only public function.

    Raises:
        ControllerError: There is no such controller, or its file fails.
    """
    if name in BUILT_IN:
        return Braitenberg()
    if name.endswith(SUFFIX):
        return Network.load(name)
    path, wanted = _file_and_name(name)
    begin_here()
    module = _module_of(path)
    wanted, found = _chosen(path, wanted, module, _functions_of(_offers_of(module)), _RULE)
    if (count := len(inspect.signature(found).parameters)) != 2:
        other = f"; for one of a robot: {command('run', name)}" if count == 1 else ""
        takes = f"{path}: {wanted!r} takes {inspect.signature(found)}; expected {_RULE.taking}"
        raise ControllerError(takes, other)
    return found


def find_on_run_end(name: str, controller: AnyController) -> AnyFunction:
    """Find a function that is called with each run, as FILE.py or FILE.py:NAME.

    Without NAME, the file's `after` is used, or its only public function. If the same file defines the
    controller of the runs, too, they share its variables.
    """
    path, wanted = _file_and_name(name)
    module = inspect.getmodule(defining(controller))
    if module is None or Path(module.__file__ or "") != path.absolute():
        module = _module_of(path)
    wanted, found = _chosen(path, wanted, module, _functions_of(_offers_of(module)), _AFTER)
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


@dataclass(frozen=True, slots=True)
class _Wanted:
    """Kind of object that is wanted of a user's file.

    Attributes:
        usual: Its usual name.
        taking: Its parameters, in words.
        example: Smallest example.
    """

    usual: str
    taking: str
    example: str


_CONTROLLER = _Wanted(
    "controller",
    "a robot, and no such subclass of Controller",
    "def controller(robot):\n    robot.set_speed(5, 5)",
)
_RULE = _Wanted(
    "controller",
    "proximity and ambient light",
    "def controller(proximity, ambient):\n    return 5, 5",
)
_AFTER = _Wanted("after", "a run", "def after(run):\n    print(run.metrics)")


def _chosen(
    path: Path, name: str, module: ModuleType, offers: Mapping[str, Offered], wanted: _Wanted
) -> tuple[str, Offered]:
    """Return an object of a user's file by its name, else the usual one or the only one, and its name."""
    chosen = name or (wanted.usual if wanted.usual in offers or len(offers) != 1 else next(iter(offers)))
    if chosen in offers:
        return chosen, offers[chosen]
    missing = f"{path}: no function {chosen!r} that takes {wanted.taking}"
    if offers:
        which = "" if name else f"expected one of these, such as {path}:{next(iter(offers))} "
        raise ControllerError(f"{missing}; {which}{choices(chosen, offers)}")
    there = ", ".join(_contents(module)) or "nothing"
    base = "a class of khep_twin.Controller, or " if wanted is _CONTROLLER and "class " in there else ""
    raise ControllerError(f"{missing}; in it: {there}; expected {base}two lines such as\n{wanted.example}")


def _contents(module: ModuleType) -> list[str]:
    """Return the public names that a file defines, and the kinds of those that are no variables."""
    found = {name: each for name, each in vars(module).items() if not name.startswith("_")}
    own = {name: each for name, each in found.items() if not isinstance(each, ModuleType)}
    kinds = {name: "class " for name, each in own.items() if isinstance(each, type)}
    kinds |= {name: "function " for name, each in own.items() if inspect.isfunction(each)}
    return [
        f"{kinds.get(name, '')}{name}"
        for name, each in own.items()
        if name not in kinds or each.__module__ == module.__name__
    ]


def _wish(name: str) -> str:
    """Return what a controller is called on the command line, where `name` is none."""
    if name.endswith(".toml") or name in names("playpens"):
        return f"{_FILES} or a built-in name, and for a playpen --playpen {name}"
    return f"{_FILES} or a built-in name; {choices(name, BUILT_IN)}"


_FILES = "FILE.py, FILE.py:NAME, FILE.npz"


def _functions_of(offers: Mapping[str, Offer]) -> dict[str, AnyFunction]:
    return {name: offer for name, offer in offers.items() if inspect.isfunction(offer)}


def _plain(path: Path, name: str, function: AnyFunction, taking: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` unless it has one parameter and returns."""
    if len(inspect.signature(function).parameters) != 1:
        takes = inspect.signature(function)
        is_rule = taking == "robot" and len(takes.parameters) == 2
        other = f"; for one of readings: {command('rollout', f'{path}:{name}')}" if is_rule else ""
        raise ControllerError(f"{path}: {name!r} takes {takes}; expected one {taking}", other)
    return _returning(path, name, function, "each cycle" if taking == "robot" else "after each run")


def _returning(path: Path, name: str, function: AnyFunction, when: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` for a generator or coroutine."""
    if inspect.isgeneratorfunction(function) or inspect.iscoroutinefunction(function):
        raise ControllerError(f"{path}: {name!r} is no plain function; expected one that returns {when}")
    return function


def _made(path: Path, name: str, kind: type[Controller]) -> Controller:
    """Return an object of a user's class."""
    try:
        return in_users_folder(kind)
    except BaseException as error:
        if is_interruption(error):
            raise
        raise failed(path, error, f"{name}() failed: ") from error


def _offers_of(module: ModuleType) -> dict[str, Offer]:
    """Return the public functions and controllers that a file defines itself, or makes of policies."""
    public = {name: offer for name, offer in vars(module).items() if not name.startswith("_")}

    def fits(offer: object) -> bool:
        if isinstance(offer, PeriodicController):
            return True
        is_function = inspect.isfunction(offer)
        is_own = getattr(offer, "__module__", None) == module.__name__
        return is_own and (is_function or (isinstance(offer, type) and issubclass(offer, Controller)))

    return {name: offer for name, offer in public.items() if fits(offer)}


def _module_of(path: Path) -> ModuleType:
    """Run a user's file as a module and return it."""
    try:
        with open_regular(path) as file:
            check_encoding(file.read(2))
    except FileNotFoundError:
        remedy = f"; to make one: {command('new', 'controller', path)}"
        raise ControllerError(f"{path}: no such file", remedy) from None
    except (OSError, ValueError) as error:
        raise ControllerError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from None
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
    folder = str(resolved(path.parent))
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        in_users_folder(spec.loader.exec_module, module)
    except BaseException as error:
        # A user's file may fail in any way; report location and reason.
        if is_interruption(error):
            raise
        raise failed(path, error) from error
    return module
