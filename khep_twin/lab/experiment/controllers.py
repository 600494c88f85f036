"""Controller interface and the built-in controllers.

A controller is a function of a robot, called once a cycle, or a `Controller` with methods that are called
before, during and after a run. Errors in a user's function are reported with file and line.
"""

import inspect
import math
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import ControllerError, KhepTwinError, exception_text
from khep_twin.files.atomic import resolve, write_atomic
from khep_twin.files.text import escape_surrogates
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.experiment.users_folder import in_users_folder
from khep_twin.playpen import Playpen
from khep_twin.process.signals import is_interruption
from khep_twin.robots.model import Feature, RobotModel
from khep_twin.robots.registry import installed_models, model_refusal

Params = ParamSpec("Params")
ReturnType = TypeVar("ReturnType")

_ASSETS = Path(__file__).parents[2] / "assets"

AnyRobot: TypeAlias = Any
"""Robot of any model: an object of its host class, such as a `Khepera`."""


class Controller:
    """Base class of controllers; a subclass overrides the methods that it needs.

        class Counting(Controller):
            def start(self, robot):
                self.near = 0

            def cycle(self, robot):
                self.near += max(robot.proximity()) > 500

    One object is used for all runs of a series, so its attributes persist from run to run. Their values at
    the end of a run are saved with it, except those whose name starts with "_".

    Attributes:
        passes_time: Calls that let time pass in a cycle, for messages.
        defined_by: User's function or file that defines it, for messages and logs; None for its class.
    """

    passes_time: ClassVar[str] = "to ask the robot something, or robot.sleep"
    defined_by: "AnyFunction | ModuleType | None" = None

    @property
    def family(self) -> str:
        """Family of the robots that it drives; empty for any."""
        return ""

    def require_model(self, model: RobotModel) -> None:
        """Raise a `ControllerError` if it cannot drive robots of a model."""
        if self.family not in ("", model.family):
            expected = f"expected {model.family!r} for {model.dialect.robot_name}"
            raise ControllerError(f"{self.subject}: model = {self.family!r}; {expected}")

    @property
    def subject(self) -> str:
        """Name for messages."""
        return name_of(self)

    def start(self, robot: AnyRobot) -> None:
        """Run before the first cycle of each run."""

    def cycle(self, robot: AnyRobot) -> None:
        """Run one cycle; it must let time pass, as every command to the robot does."""
        raise NotImplementedError(f"{type(self).__name__} needs a cycle(self, robot)")

    def end(self, robot: AnyRobot) -> None:
        """Run after the last cycle of each run, with the motors stopped."""

    def stop(self, robot: AnyRobot) -> None:
        """Clean up the robot after the last run or an error."""


class FunctionController(Controller):
    """Controller that calls a function once a cycle; a mapping that it returns holds its variables."""

    def __init__(self, function: Callable[[AnyRobot], object]) -> None:
        self.defined_by = self.function = function
        self._returned: Mapping[str, object] = {}

    def require_model(self, model: RobotModel) -> None:
        """Raise a `ControllerError` for the built-in controller of a model without a vehicle."""
        if self.function is braitenberg:
            vehicle_of(model)

    def start(self, robot: AnyRobot) -> None:
        """Forget the variables of the previous run."""
        self._returned = {}

    def cycle(self, robot: AnyRobot) -> None:
        """Call the function."""
        returned = self.function(robot)
        if isinstance(returned, Mapping):
            self._returned = returned

    def returned(self) -> dict[str, object]:
        """Return the last mapping that the function returned."""
        return {escape_surrogates(str(name)): value for name, value in self._returned.items()}


class LoopingController(FunctionController):
    """Function that loops over the cycles of a run itself.

    Attributes:
        unpaced: True if its commands to a twin take no transmission time.
        playpen: Playpen opened by its file; None without.
        port_id: Number of the robot's port; None if the function refers to no other robot.
    """

    unpaced = False
    port_id: int | None = None
    playpen: Playpen | None = None

    def require_model(self, model: RobotModel) -> None:
        """Raise a `ControllerError` if the toolbox does not know the robot's commands."""
        if Feature.TOOLBOX not in model.features:
            raise ControllerError(f"{name_of(self)}: {model_refusal(model.name, Feature.TOOLBOX)}")

    def loop(
        self, robot: AnyRobot, cycles: int, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> int | None:
        """Run the cycles of one run.

        Args:
            robot: Robot to drive.
            cycles: Number of cycles.
            end_cycle: Called after each cycle; returns whether to continue.
            stop: Returns whether to stop early.

        Returns:
            Number of cycles; None for an aborted run.
        """
        raise NotImplementedError


AnyController = Controller | Callable[[AnyRobot], object]
AnyFunction = Callable[..., object]


def as_controller(controller: AnyController) -> Controller:
    """Return a controller as a `Controller`."""
    return controller if isinstance(controller, Controller) else FunctionController(controller)


def name_of(controller: AnyController) -> str:
    """Return the name under which a controller's file defines it."""
    definition = definition_of(controller)
    subject = type(controller) if isinstance(definition, ModuleType) else definition
    return str(getattr(subject, "__name__", type(controller).__name__))


def definition_of(controller: AnyController | AnyFunction) -> AnyFunction | ModuleType:
    """Return the function, class or file that defines a controller or one of its methods."""
    owner = getattr(controller, "__self__", controller)
    if not isinstance(owner, Controller):
        return owner
    return type(owner) if owner.defined_by is None else owner.defined_by


def call(function: Callable[Params, ReturnType], *args: Params.args, **kwargs: Params.kwargs) -> ReturnType:
    """Call a user's function or a controller's method and return its result.

    Raises:
        ControllerError: The call failed; the message has file and line.
    """
    try:
        return in_users_folder(function, *args, **kwargs)
    except KhepTwinError:
        raise
    except BaseException as error:
        if is_interruption(error):
            raise
        raise error_in_file(source_file(function), error) from error


@contextmanager
def stopped_at_end(controller: Controller, robot: HostRobot) -> Generator[None]:
    """Call a controller's `stop` at the end of the context, also after an error, which is raised again."""
    try:
        yield
    except BaseException:
        # A second error in `stop` would hide the first one.
        with suppress(KhepTwinError):
            call(controller.stop, robot)
        raise
    call(controller.stop, robot)


def source_file(controller: AnyController | AnyFunction) -> str:
    """Return the file that defines a controller or one of its methods; empty without a file."""
    try:
        return inspect.getsourcefile(definition_of(controller)) or ""
    except TypeError:  # a callable that is not defined in a file
        return ""


def error_in_file(file: str | Path, error: BaseException, prefix: str = "") -> ControllerError:
    """Return the error of a user's file, with the failing line in it and in a module of the same folder."""
    file_path = resolve(Path(file))
    frames = traceback.walk_tb(error.__traceback__)
    locations = [(resolve(Path(frame.f_code.co_filename)), line) for frame, line in frames]
    is_invalid = isinstance(error, SyntaxError)
    if isinstance(error, SyntaxError) and error.filename and error.lineno is not None:
        locations.append((resolve(Path(error.filename)), error.lineno))
    lines = [line for location, line in locations if location == file_path]
    line = f":{lines[-1]}" if lines else ""
    neighbours = [location for location in locations if location[0].parent == file_path.parent]
    # Python's text of a syntax error names its file.
    is_inner = bool(neighbours) and not is_invalid and neighbours[-1][0] != file_path
    inner = f" ({neighbours[-1][0].name}, line {neighbours[-1][1]})" if is_inner else ""
    return ControllerError(f"{file}{line}: {prefix}{exception_text(error)}{inner}")


def copy_variables(controller: Controller) -> dict[str, object]:
    """Return copies of a controller's variables: booleans, numbers, texts, arrays and lists of numbers.

    Integers beyond 64 bits become floats.
    """
    values = controller.returned() if isinstance(controller, FunctionController) else vars(controller)
    copies: dict[str, object] = {}
    for name, value in sorted(values.items()):
        if name.startswith("_"):
            continue
        if isinstance(value, str):
            copies[name] = escape_surrogates(value)
        elif isinstance(value, bool | int | float):
            copies[name] = _python_number(value)
        elif isinstance(value, np.generic | np.ndarray | list | tuple):
            array = _numeric_array(values[name])
            if array is not None:
                copies[name] = array.item() if array.ndim == 0 else array
    return copies


def write_template(model: RobotModel | None, file: Path, replace: bool = False) -> None:
    """Write a commented controller template for a model, or one in the Khepera Toolbox's form."""
    text = template_of(model) if model else (_ASSETS / "toolbox_template.py").read_text("utf-8")
    write_atomic(file, text.encode(), replace)


def template_of(model: RobotModel) -> str:
    """Return the first text of a controller of a model; without a template, it drives straight ahead."""
    if model.template:
        return (_ASSETS / model.template).read_text("utf-8")
    speed, unit = model.bars["speed"].full // 4, model.channels["speed"][0][1]
    return f"def controller(robot):\n    robot.set_setpoints({speed}, {speed})  # left, right [{unit}]\n"


def _python_number(value: bool | int | float) -> bool | int | float:
    """Return a number as a built-in type, e.g. a member of an enumeration."""
    if isinstance(value, bool | float):
        return bool(value) if isinstance(value, bool) else float(value)
    if -(2**63) <= value < 2**63:
        return int(value)
    try:
        return float(value)
    except OverflowError:
        return math.copysign(math.inf, value)


def _numeric_array(value: object) -> NDArray[np.generic] | None:
    """Return a copy as an array; None if it does not consist of numbers."""
    try:
        array = np.array(value)
    except ValueError:  # rows of several lengths
        return None
    return array if array.dtype.kind in "biuf" else None


def braitenberg(robot: HostRobot) -> None:
    """Drive and avoid obstacles, as the Braitenberg vehicle of the robot's model does."""
    vehicle = vehicle_of(robot.model)
    proximity = robot.read_registers(range(*robot.model.episode_interface.proximity))
    robot.set_setpoints(*vehicle(proximity))


def vehicle_of(model: RobotModel) -> Callable[[Sequence[int]], tuple[int, int]]:
    """Return the function of a model's Braitenberg vehicle.

    Raises:
        ControllerError: It has no vehicle.
    """
    if model.vehicle is None:
        titles = " or ".join(other.title for other in installed_models().values() if other.vehicle)
        raise ControllerError(f"braitenberg: model = {model.name!r} has no vehicle; expected a {titles}")
    return model.vehicle


BUILT_IN: Mapping[str, Callable[[AnyRobot], object]] = {"braitenberg": braitenberg}
"""Built-in controllers by their names in `khep-twin run`."""
