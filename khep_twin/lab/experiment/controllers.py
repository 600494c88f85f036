"""Controller interface and the built-in controllers.

A controller is a function of a robot, called once a cycle, or a `Controller` with methods that are called
before, during and after a run. An error of a user's function tells file and line.
"""

import inspect
import math
import traceback
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from importlib.resources import files
from operator import mul
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.errors import ControllerError, KhepTwinError, in_a_line
from khep_twin.files.atomic import resolved, write_whole
from khep_twin.files.text import encodable
from khep_twin.host import Khepera
from khep_twin.lab.experiment.users_folder import in_users_folder
from khep_twin.playpen import Playpen
from khep_twin.signals import is_interruption

P = ParamSpec("P")
Returned = TypeVar("Returned")


class Controller:
    """Base class of controllers; a subclass overrides the methods that it needs.

        class Counting(Controller):
            def start(self, robot):
                self.near = 0

            def cycle(self, robot):
                self.near += max(robot.proximity()) > 500

    One object serves a whole series, so its attributes carry over from run to run. Their values at a run's
    end are kept with the run, except those whose name begins with "_".

    Attributes:
        passes_time: Calls that let time pass in a cycle, for messages.
        defined_by: User's function or file that it consists of, for messages and logs; None for its class.
    """

    passes_time: ClassVar[str] = "to ask the robot something, or robot.sleep"
    defined_by: "AnyFunction | ModuleType | None" = None

    def start(self, robot: Khepera) -> None:
        """Run before the first cycle of each run."""

    def cycle(self, robot: Khepera) -> None:
        """Run one cycle; it must let time pass, as every command to the robot does."""
        raise NotImplementedError(f"{type(self).__name__} needs a cycle(self, robot)")

    def end(self, robot: Khepera) -> None:
        """Run after the last cycle of each run, with the motors stopped."""

    def stop(self, robot: Khepera) -> None:
        """Clean up the robot after the last run or an error."""


class FunctionController(Controller):
    """A controller made of a function called once a cycle; a mapping that it returns has its variables."""

    def __init__(self, function: Callable[[Khepera], object]) -> None:
        self.defined_by = self.function = function
        self._told: Mapping[str, object] = {}

    def start(self, robot: Khepera) -> None:
        """Forget the variables of the previous run."""
        self._told = {}

    def cycle(self, robot: Khepera) -> None:
        """Call the function."""
        told = self.function(robot)
        if isinstance(told, Mapping):
            self._told = told

    def told(self) -> dict[str, object]:
        """Return the mapping that the function returned last."""
        return {encodable(str(name)): value for name, value in self._told.items()}


class LoopingController(FunctionController):
    """A function that runs the cycles of a run by itself.

    Attributes:
        unpaced: True if its commands to a twin take no time on the line.
        playpen: Playpen opened by its file, None for none.
        port_id: Number of the robot's port, None if it refers to no other robot.
    """

    unpaced = False
    port_id: int | None = None
    playpen: Playpen | None = None

    def loop(
        self, robot: Khepera, cycles: int, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> int | None:
        """Run the cycles of one run.

        Args:
            robot: Robot to drive.
            cycles: Number of cycles.
            end_cycle: Called after each cycle; returns whether to go on.
            stop: Returns whether to end early.

        Returns:
            Number of cycles, None for an aborted run.
        """
        raise NotImplementedError


AnyController = Controller | Callable[[Khepera], object]
AnyFunction = Callable[..., object]


def as_controller(controller: AnyController) -> Controller:
    """Return a controller as a `Controller`."""
    return controller if isinstance(controller, Controller) else FunctionController(controller)


def name_of(controller: AnyController) -> str:
    """Return the name of a controller in its file."""
    defined = defining(controller)
    named = type(controller) if isinstance(defined, ModuleType) else defined
    return str(getattr(named, "__name__", type(controller).__name__))


def defining(controller: AnyController | AnyFunction) -> AnyFunction | ModuleType:
    """Return the function, class or file that defines a controller or one of its methods."""
    owner = getattr(controller, "__self__", controller)
    if not isinstance(owner, Controller):
        return owner
    return type(owner) if owner.defined_by is None else owner.defined_by


def call(place: Callable[P, Returned], *given: P.args, **named: P.kwargs) -> Returned:
    """Call a user's function or a controller's method and return what it returns.

    Raises:
        ControllerError: It failed, with file and line.
    """
    try:
        return in_users_folder(place, *given, **named)
    except KhepTwinError:
        raise
    except BaseException as error:
        if is_interruption(error):
            raise
        raise failed(source_file(place), error) from error


@contextmanager
def stopped_at_end(controller: Controller, robot: Khepera) -> Generator[None]:
    """Call a controller's `stop` at the end of the context, also after an error, which goes on."""
    try:
        yield
    except BaseException:
        # A second error while the controller stops would only hide the first one.
        with suppress(KhepTwinError):
            call(controller.stop, robot)
        raise
    call(controller.stop, robot)


def source_file(controller: AnyController | AnyFunction) -> str:
    """Return the file that defines a controller or one of its methods; empty if none does."""
    try:
        return inspect.getsourcefile(defining(controller)) or ""
    except TypeError:  # a callable that is not defined in a file
        return ""


def failed(file: str | Path, error: BaseException, what: str = "") -> ControllerError:
    """Return the error about a user's file that has failed, with the line in it, and in a file beside it."""
    there = resolved(Path(file))
    frames = traceback.walk_tb(error.__traceback__)
    places = [(resolved(Path(frame.f_code.co_filename)), line) for frame, line in frames]
    is_invalid = isinstance(error, SyntaxError)
    if isinstance(error, SyntaxError) and error.filename and error.lineno is not None:
        places.append((resolved(Path(error.filename)), error.lineno))
    lines = [line for place, line in places if place == there]
    line = f":{lines[-1]}" if lines else ""
    beside = [each for each in places if each[0].parent == there.parent]
    # Python itself names the file of a syntax error.
    inner = "" if is_invalid or not beside or beside[-1][0] == there else _place(*beside[-1])
    return ControllerError(f"{file}{line}: {what}{in_a_line(error)}{inner}")


def _place(path: Path, line: int) -> str:
    return f" ({path.name}, line {line})"


def variables(controller: Controller) -> dict[str, object]:
    """Return copies of a controller's variables: booleans, numbers, texts, arrays and lists of numbers.

    Integers beyond 64 bits become floats.
    """
    held = controller.told() if isinstance(controller, FunctionController) else vars(controller)
    found: dict[str, object] = {}
    for name, value in sorted(held.items()):
        if name.startswith("_"):
            continue
        if isinstance(value, str):
            found[name] = encodable(value)
        elif isinstance(value, bool | int | float):
            found[name] = _plain(value)
        elif isinstance(value, np.generic | np.ndarray | list | tuple):
            array = _numbers(held[name])
            if array is not None:
                found[name] = array.item() if array.ndim == 0 else array
    return found


def write_template(kind: Literal["controller", "toolbox"], file: Path, replace: bool = False) -> None:
    """Write a commented controller template, as a class or in the Khepera Toolbox's form."""
    write_whole(file, (files("khep_twin") / "assets" / f"{kind}_template.py").read_bytes(), replace)


def _plain(value: bool | int | float) -> bool | int | float:
    """Return a number as a plain type, e.g. of an enumeration's member."""
    if isinstance(value, bool | float):
        return bool(value) if isinstance(value, bool) else float(value)
    if -(2**63) <= value < 2**63:
        return int(value)
    try:
        return float(value)
    except OverflowError:
        return math.copysign(math.inf, value)


def _numbers(value: object) -> NDArray[np.generic] | None:
    """Return a copy as an array, None if it does not hold numbers."""
    try:
        array = np.array(value)
    except ValueError:  # rows of several lengths
        return None
    return array if array.dtype.kind in "biuf" else None


def braitenberg(robot: Khepera) -> None:
    """Drive and avoid obstacles: speeds = proximity x weights / 400 + 10."""
    proximity = robot.proximity()
    left, right = (sum(map(mul, weights, proximity)) for weights in zip(*DEMO_WEIGHTS, strict=True))
    robot.set_speed(
        round(left / DEMO_DIVISOR) + DEMO_SPEED_PULSES, round(right / DEMO_DIVISOR) + DEMO_SPEED_PULSES
    )


BUILT_IN: Mapping[str, Callable[[Khepera], object]] = {"braitenberg": braitenberg}
"""Built-in controllers by their names in `khep-twin run`."""
