"""Controllers and other functions of users, looked up by name in Python files and network files."""

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
from khep_twin.files.atomic import open_regular, resolve
from khep_twin.files.text import check_encoding
from khep_twin.files.toml_files import names
from khep_twin.lab.experiment.controller_source import ReadOnceLoader
from khep_twin.lab.experiment.controllers import (
    BUILT_IN,
    AnyController,
    AnyFunction,
    Controller,
    LoopingController,
    call,
    definition_of,
    error_in_file,
    name_of,
    source_file,
)
from khep_twin.lab.experiment.periodic_controllers import NetworkController, PeriodicController
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.lab.experiment.users_folder import in_users_folder, reset_users_folder
from khep_twin.process.invocation import command
from khep_twin.process.signals import is_interruption

Candidate = type[Controller] | PeriodicController | AnyFunction
CandidateType = TypeVar("CandidateType", bound=Candidate)


def find_controller(
    name: str, adapt: Callable[[AnyController], AnyController] = lambda controller: controller
) -> AnyController:
    """Find a controller by its built-in name, or as FILE.py, FILE.py:NAME or a network's FILE.npz.

    Without NAME, the file's `controller` is used, or its only public function or subclass of `Controller`, or
    its only instance of `TaskController` or `NetworkController`.
    `adapt` converts a function of another form to a controller, and returns other functions unchanged.

    Raises:
        ControllerError: There is no such controller, or its file fails.
    """
    reset_users_folder()
    if name in BUILT_IN:
        return BUILT_IN[name]
    if name.endswith(SUFFIX):
        return NetworkController(Network.load(name), Path(name).name)
    path, attribute = _split_name(name, f"no such controller; expected {_expected_names(name)}")
    module = _load_module(path)
    candidates = _find_candidates(module)
    controllers = {k: v for k, v in candidates.items() if isinstance(v, type | PeriodicController)}
    if not attribute and len(controllers) == 1 and "controller" not in candidates:
        candidates = controllers  # functions beside a single class are its helpers
    attribute, match = _choose(path, attribute, module, candidates, _CONTROLLER)
    if isinstance(match, PeriodicController):
        match.defined_by = module
        return match
    if isinstance(match, type):
        return _instantiate(path, attribute, match)
    adapted = adapt(match)
    return adapted if adapted is not match else _check_parameter(path, attribute, match, "robot")


def find_driver(name: str) -> Driver | AnyFunction:
    """Find a controller for episodes: a built-in one, a network's FILE.npz, or a function.

    The function takes proximity and ambient light, then terms of the robot by their names, and is named as
    FILE.py or FILE.py:NAME. Without NAME, the file's `controller` is used, or its only public function.

    Raises:
        ControllerError: There is no such controller, or its file fails.
    """
    if name in BUILT_IN:
        return Braitenberg()
    if name.endswith(SUFFIX):
        return Network.load(name)
    path, attribute = _split_name(name)
    reset_users_folder()
    module = _load_module(path)
    attribute, function = _choose(path, attribute, module, _find_functions(module), _DRIVER)
    if (n_parameters := len(inspect.signature(function).parameters)) < 2:
        hint = f"; for one of a robot: {command('run', name)}" if n_parameters == 1 else ""
        problem = f"{path}: {attribute!r} takes {inspect.signature(function)}; expected {_DRIVER.parameters}"
        raise ControllerError(problem, hint)
    return function


def find_on_run_end(name: str, controller: AnyController) -> AnyFunction:
    """Find a function to call after each run, named as FILE.py or FILE.py:NAME.

    Without NAME, the file's `after` is used, or its only public function. If the same file also defines the
    controller of the runs, both share its variables.
    """
    path, attribute = _split_name(name)
    module = inspect.getmodule(definition_of(controller))
    if module is None or Path(module.__file__ or "") != path.absolute():
        module = _load_module(path)
    attribute, function = _choose(path, attribute, module, _find_functions(module), _RUN_END)
    if isinstance(controller, LoopingController):
        return _check_returns(path, attribute, function, "after each run")
    return _check_parameter(path, attribute, function, "run")


def call_on_run_end(function: AnyFunction, run: SeriesRun) -> object:
    """Call a user's function after a run, with the run or with variables of the run by parameter name.

    Raises:
        ControllerError: The function failed, or has other parameters.
    """
    parameters = inspect.signature(function).parameters.values()
    names = [parameter.name for parameter in parameters if parameter.kind is not parameter.KEYWORD_ONLY]
    missing = [name for name in names if name not in run.variables]
    if len(names) == 1 and missing:
        return call(function, run)
    if missing:
        known_names = ", ".join(run.variables) or "none"
        raise ControllerError(
            f"{source_file(function)}: {name_of(function)!r} takes {missing[0]}; expected a run, or its "
            f"variables by name: {known_names}"
        )
    return call(function, *(run.variables[name] for name in names))


def _split_name(
    argument: str, problem: str = "no such function; expected FILE.py or FILE.py:NAME"
) -> tuple[Path, str]:
    """Split FILE.py[:NAME] into path and name; raise a `ControllerError` if it is not a Python file."""
    path, _, name = argument.partition(":")
    if not path.endswith(".py"):
        raise ControllerError(f"{argument}: {problem}")
    return Path(path), name


@dataclass(frozen=True, slots=True)
class _Kind:
    """Kind of object to look up in a user's file.

    Attributes:
        default: Default name.
        parameters: Parameters, in words.
        example: Minimal example.
    """

    default: str
    parameters: str
    example: str


_CONTROLLER = _Kind(
    "controller",
    "a robot, and no such subclass of Controller",
    "def controller(robot):\n    robot.set_speed(5, 5)",
)
_DRIVER = _Kind(
    "controller", "proximity and ambient light", "def controller(proximity, ambient):\n    return 5, 5"
)
_RUN_END = _Kind("after", "a run", "def after(run):\n    print(run.metrics)")


def _choose(
    path: Path, name: str, module: ModuleType, candidates: Mapping[str, CandidateType], kind: _Kind
) -> tuple[str, CandidateType]:
    """Return the name and the object: by the name in a user's file, else the default or the only one."""
    only = next(iter(candidates)) if len(candidates) == 1 else kind.default
    choice = name or (kind.default if kind.default in candidates else only)
    if choice in candidates:
        return choice, candidates[choice]
    problem = f"{path}: no function {choice!r} that takes {kind.parameters}"
    if candidates:
        suggestion = "" if name else f"expected one of these, such as {path}:{next(iter(candidates))} "
        raise ControllerError(f"{problem}; {suggestion}{choices(choice, candidates)}")
    contents = ", ".join(_public_names(module)) or "nothing"
    option = "a class of khep_twin.Controller, or " if kind is _CONTROLLER and "class " in contents else ""
    raise ControllerError(f"{problem}; in it: {contents}; expected {option}two lines such as\n{kind.example}")


def _public_names(module: ModuleType) -> list[str]:
    """Return the public names that a file defines; classes and functions are marked as such."""
    public = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    objects = {name: value for name, value in public.items() if not isinstance(value, ModuleType)}
    kinds = {name: "class " for name, value in objects.items() if isinstance(value, type)}
    kinds |= {name: "function " for name, value in objects.items() if inspect.isfunction(value)}
    return [
        f"{kinds.get(name, '')}{name}"
        for name, value in objects.items()
        if name not in kinds or value.__module__ == module.__name__
    ]


_FILE_FORMS = "FILE.py, FILE.py:NAME, FILE.npz"


def _expected_names(name: str) -> str:
    """Return how to name a controller on the command line, for a `name` that is not one."""
    if name.endswith(".toml") or name in names("playpens"):
        return f"{_FILE_FORMS} or a built-in name, and for a playpen --playpen {name}"
    return f"{_FILE_FORMS} or a built-in name; {choices(name, BUILT_IN)}"


def _find_functions(module: ModuleType) -> dict[str, AnyFunction]:
    return {name: value for name, value in _find_candidates(module).items() if inspect.isfunction(value)}


def _check_parameter(path: Path, name: str, function: AnyFunction, expected: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` unless it is plain with one parameter."""
    if len(inspect.signature(function).parameters) != 1:
        signature = inspect.signature(function)
        is_driver = expected == "robot" and len(signature.parameters) == 2
        hint = f"; for one of readings: {command('rollout', f'{path}:{name}')}" if is_driver else ""
        raise ControllerError(f"{path}: {name!r} takes {signature}; expected one {expected}", hint)
    return _check_returns(path, name, function, "each cycle" if expected == "robot" else "after each run")


def _check_returns(path: Path, name: str, function: AnyFunction, occasion: str) -> AnyFunction:
    """Return a user's function; raise a `ControllerError` for a generator or coroutine."""
    if inspect.isgeneratorfunction(function) or inspect.iscoroutinefunction(function):
        raise ControllerError(f"{path}: {name!r} is no plain function; expected one that returns {occasion}")
    return function


def _instantiate(path: Path, name: str, controller_class: type[Controller]) -> Controller:
    """Return an instance of a user's class."""
    try:
        return in_users_folder(controller_class)
    except BaseException as error:
        if is_interruption(error):
            raise
        raise error_in_file(path, error, f"{name}() failed: ") from error


def _find_candidates(module: ModuleType) -> dict[str, Candidate]:
    """Return a file's public functions, controller classes and periodic controllers, without imports."""
    public = {name: value for name, value in vars(module).items() if not name.startswith("_")}

    def is_candidate(value: object) -> bool:
        if isinstance(value, PeriodicController):
            return True
        is_function = inspect.isfunction(value)
        is_local = getattr(value, "__module__", None) == module.__name__
        return is_local and (is_function or (isinstance(value, type) and issubclass(value, Controller)))

    return {name: value for name, value in public.items() if is_candidate(value)}


def _load_module(path: Path) -> ModuleType:
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
    # Files with the same name in different folders become different modules.
    folder_hash = sha256(os.fsencode(path.absolute())).hexdigest()[:8]
    name = f"khep_twin_controller_{folder_hash}_{path.stem}"
    # An absolute name stays valid if the controller changes the folder.
    loader = ReadOnceLoader(name, str(path.absolute()))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    if spec is None or spec.loader is None:
        raise ControllerError(f"{path}: cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # A program can import modules from its folder, as if Python ran it.
    folder = str(resolve(path.parent))
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        in_users_folder(spec.loader.exec_module, module)
    except BaseException as error:
        # A user's file may fail in any way; report location and reason.
        if is_interruption(error):
            raise
        raise error_in_file(path, error) from error
    return module
