"""Controllers: what they are, and those that ship with the package.

A controller is a function of a robot, called once a cycle, or a `Controller` with places for what is to be
done before, between and after.
"""

import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.files.atomic import write_whole
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen


class Controller:
    """A controller with places for what is done around its cycles; a subclass fills those that it needs.

        class Counting(Controller):
            def start(self, robot):
                self.near = 0

            def cycle(self, robot):
                self.near += max(robot.proximity()) > 500

    One object is there for a whole series, so what it learns in a run it knows in the next one. What its
    attributes hold at a run's end is kept with the run, but for those whose name begins with "_".

    Attributes:
        passes_time: what a cycle is expected to do to let time pass, for messages.
    """

    passes_time: ClassVar[str] = "to ask the robot something, or robot.sleep"

    def start(self, robot: Khepera) -> None:
        """Called before the first cycle of each run."""

    def cycle(self, robot: Khepera) -> None:
        """Called again and again; it has to let time pass, as every command to the robot does."""
        raise NotImplementedError(f"{type(self).__name__} needs a cycle(self, robot)")

    def end(self, robot: Khepera) -> None:
        """Called after the last cycle of each run; the motors stand."""

    def stop(self, robot: Khepera) -> None:
        """Called when this robot is done with, after the last run or trouble, to leave it in order."""


class FunctionController(Controller):
    """A function as a controller; a mapping that it returns has its variables.

    Attributes:
        function: called once a cycle.
    """

    def __init__(self, function: Callable[[Khepera], Any]) -> None:
        self.function = function
        self._told: Mapping[str, Any] = {}

    def start(self, robot: Khepera) -> None:
        """Forgets what was told in another run."""
        self._told = {}

    def cycle(self, robot: Khepera) -> None:
        """Calls the function."""
        told = self.function(robot)
        if isinstance(told, Mapping):
            self._told = told

    def told(self) -> dict[str, Any]:
        """What the function has returned last."""
        return {str(name): value for name, value in self._told.items()}


class LoopingController(FunctionController):
    """A function that goes through the cycles of a run by itself.

    Attributes:
        unpaced: whether its commands to a twin take no time on the line.
        playpen: that its file has open, None for no playpen of its own.
        port_id: number of the robot's port, None for one that means no other robot.
    """

    unpaced = False
    port_id: int | None = None
    playpen: Playpen | None = None

    def loop(
        self, robot: Khepera, cycles: int, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> int | None:
        """Go through the cycles of one run.

        Args:
            robot: what is driven.
            cycles: how many.
            end_cycle: is called after each cycle; tells whether to go on.
            stop: tells whether to end early.

        Returns:
            The number of cycles, None for a run that was broken off.
        """
        raise NotImplementedError


AnyController = Controller | Callable[[Khepera], Any]


def as_controller(controller: AnyController) -> Controller:
    """A controller with its places."""
    return controller if isinstance(controller, Controller) else FunctionController(controller)


def name_of(controller: AnyController) -> str:
    """What a controller is called in its file."""
    return str(getattr(defining(controller), "__name__", type(controller).__name__))


def defining(controller: Any) -> Any:
    """The function or class that defines a controller or one of its places."""
    owner = getattr(controller, "__self__", controller)
    if isinstance(owner, FunctionController):
        return owner.function
    return type(owner) if isinstance(owner, Controller) else owner


def variables(controller: Controller) -> dict[str, Any]:
    """What a controller holds: truths, numbers, texts, and arrays and lists of numbers, as copies.

    Whole numbers beyond 64 bits become floats.
    """
    held = controller.told() if isinstance(controller, FunctionController) else vars(controller)
    found: dict[str, Any] = {}
    for name, value in sorted(held.items()):
        if name.startswith("_"):
            continue
        if isinstance(value, str):
            # What no file takes, such as half of a pair of surrogates, is told by its code.
            found[name] = value.encode("utf-8", "backslashreplace").decode("utf-8")
        elif isinstance(value, bool | int | float):
            found[name] = _plain(value)
        elif isinstance(value, np.generic | np.ndarray | list | tuple):
            array = _numbers(value)
            if array is not None:
                found[name] = array.item() if array.ndim == 0 else array
    return found


def write_template(kind: Literal["controller", "toolbox"], file: Path) -> None:
    """Write a commented controller to begin with, as a class or in the Khepera Toolbox's form.

    Raises:
        KhepTwinError: it cannot be written.
    """
    write_whole(file, (files("khep_twin") / "assets" / f"{kind}_template.py").read_bytes())


def _plain(value: bool | int | float) -> bool | int | float:
    """A single number without what else its type may be, such as a member of an enumeration."""
    if isinstance(value, bool | float):
        return bool(value) if isinstance(value, bool) else float(value)
    if -(2**63) <= value < 2**63:
        return int(value)
    try:
        return float(value)
    except OverflowError:
        return math.copysign(math.inf, value)


def _numbers(value: Any) -> NDArray[Any] | None:
    """A copy as an array; None for what is none of numbers."""
    try:
        array: NDArray[Any] = np.array(value)
    except ValueError:  # rows of several lengths
        return None
    return array if array.dtype.kind in "biuf" else None


def braitenberg(robot: Khepera) -> None:
    """Wanders and avoids obstacles: speeds = proximity x weights / 400 + 10."""
    proximity = robot.proximity()
    left, right = (
        sum(weights[side] * count for weights, count in zip(DEMO_WEIGHTS, proximity, strict=True))
        for side in (0, 1)
    )
    robot.set_speed(
        round(left / DEMO_DIVISOR) + DEMO_SPEED_PULSES, round(right / DEMO_DIVISOR) + DEMO_SPEED_PULSES
    )


BUILT_IN: Mapping[str, Callable[[Khepera], Any]] = {"braitenberg": braitenberg}
"""By the name that `khep-twin run` knows them by."""
