"""Part of a robot's model that the stepping core runs: its state, and functions that are compilable.

A model gives a `Core`. The stepping core calls a robot's functions by the functions of this module, which
choose them by the class of the robot's state: in plain code by a table, in compiled code by an overload that
`simulation.compiled` registers. So a scene compiles the functions of its models alone.
"""

import math
from collections.abc import Callable, Collection, Container
from typing import Any, NamedTuple

from khep_twin.compilable import compilable
from khep_twin.errors import RobotModelError
from khep_twin.playpen import RobotEntry
from khep_twin.robots.model import Interface, RobotModel
from khep_twin.sensing.buffers import RobotState as RobotState
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import BeamScene
from khep_twin.sensing.simulated import Simulated, StepInputs

Registers = Vector[int]
"""Registers of a robot (n_registers,)."""


@compilable
def _start_at_once(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> bool:
    """Do nothing, as the state before the start is that of a run."""
    return False


@compilable
def _measure_no_supply(robot: RobotState, simulated: Simulated, time_ns: int) -> bool:
    """Do nothing, as the supply is constant."""
    return False


@compilable
def _evaluate_nothing(robot: RobotState, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    """Do nothing, as no measurement is recorded."""


@compilable
def _keep_registers(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> None:
    """Do nothing, as the registers are always up to date."""


@compilable
def _set_setpoints(robot: RobotState, left: int, right: int) -> None:
    """Set the setpoints of the speeds."""
    interface = interface_of(robot)
    robot.registers[interface.setpoints[0]] = left
    robot.registers[interface.setpoints[1]] = right


@compilable
def _hear_nothing(robot: RobotState, scene: BeamScene, sensor: int) -> float:
    """Return infinity, as there is no ultrasonic sensor."""
    return math.inf


@compilable
def _is_always_powered(robot: RobotState) -> bool:
    """Return True, as the supply always suffices."""
    return True


@compilable
def wander_nowhere(robot: RobotState, registers: Registers) -> None:
    """Do nothing, as the robot has no vehicle."""


def _measure_all(record: Any, names: Collection[str]) -> None:
    """Do nothing, as all terms are measured."""


class Core(NamedTuple):
    """Core of a model.

    All functions but `make_state` and `scan` are `compilable`; their arguments are those of the function of
    the same name in this module.

    Attributes:
        name: Name of the family of models that it runs.
        state: Class of a robot's state, a named tuple of numbers and arrays, or of named tuples of them. It
            has at least `pose` (index of the pose), `radius` [m], `noise` (key of the random draws, (2,)),
            and for episodes `registers` (n_registers,) and `sensors`.
        make_state: Function that returns the state before a start, for a model, indices of the robot, its
            calibration, its entry of the playpen, and the number of its first moment.
        changing: Fields of the state that change during a run, buffers included.
        modules: Names of the modules that are compiled for it.
        sense: Runs the sensors in a step.
        tick: Runs the control period of 10 ms.
        scan: Measures with all sensors now; always plain.
        start: Starts the run, after the scan before time 0; by default it does nothing.
        measure_supply: Measures the supply; by default it is constant.
        evaluate: Evaluates a recorded measurement.
        n_moments: Number of moments that the robot records for later measurements, see `scene.save_moment`.
        interface: That of its models.
        request_terms: Lets a record measure the terms of these names in episodes; by default it always does.
        update_registers: Measures, and updates the registers; by default they are always up to date.
        set_speeds: Sets the speeds; by default the setpoints in the registers.
        is_powered: Returns whether the processor runs; by default always.
        wander: Sets the setpoints of a Braitenberg vehicle in registers; by default there is none.
        commands: Letters of the requests with two numbers, for the left and the right wheel.
        counter_commands: Letters of the requests that set the counters.
        command: Executes one of `commands`; a shadow needs it, and `program`.
        echo: Returns the distance by an ultrasonic sensor; by default there is none.
        program: Function that returns the program on its line, with `receive` and `reset`, for an entry of
            the playpen and a state, whose arrays it changes.
    """

    name: str
    state: type[Any]
    make_state: Callable[..., Any]
    changing: tuple[str, ...]
    modules: tuple[str, ...]
    sense: Callable[..., None]
    tick: Callable[..., bool]
    scan: Callable[..., None]
    start: Callable[..., bool] = _start_at_once
    measure_supply: Callable[..., bool] = _measure_no_supply
    evaluate: Callable[..., None] = _evaluate_nothing
    n_moments: int = 0
    interface: Interface | None = None
    request_terms: Callable[[Any, Collection[str]], None] = _measure_all
    update_registers: Callable[..., None] = _keep_registers
    set_speeds: Callable[..., None] = _set_setpoints
    is_powered: Callable[..., bool] = _is_always_powered
    wander: Callable[..., None] = wander_nowhere
    commands: str = "D"
    counter_commands: str = ""
    command: Callable[..., None] = _evaluate_nothing
    echo: Callable[..., float] = _hear_nothing
    program: Callable[[RobotEntry, RobotState], Any] | None = None

    @property
    def interface_of(self) -> Callable[[Any], Interface | None]:
        """Function that returns the interface for a state, a constant of compiled code."""
        interface = self.interface
        return lambda robot: interface


CORES: dict[type[Any], Core] = {}
"""Cores by the class of their state."""


def register(core: Core) -> Core:
    """Add a core to `CORES`; return it."""
    CORES[core.state] = core
    return core


def core_of(model: RobotModel) -> Core:
    """Return the core of a model."""
    return model.load("core", Core)


def make_state(model: RobotModel, *arguments: Any) -> RobotState:
    """Return the state of a robot before a start; the further arguments are those of `Core.make_state`.

    Raises:
        RobotModelError: Its number of registers is not that of the model's interface.
    """
    state = core_of(model).make_state(*arguments)
    if model.interface is not None and model.interface.n_registers != len(state.registers):
        raise RobotModelError(
            f"model {model.name}: interface.n_registers = {model.interface.n_registers}; expected "
            f"{len(state.registers)}, the number of registers in its core's state"
        )
    return state


def sense(robot: RobotState, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Run the sensors of a robot in a step.

    Args:
        robot: State of the robot.
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        start: Number of the step's first conversion (`Timing.conversions`) since the start of the run.
    """
    CORES[type(robot)].sense(robot, simulated, inputs, start)


def tick(robot: RobotState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run a robot's control period at a time [ns]; return True if code outside the core must act now."""
    return CORES[type(robot)].tick(robot, simulated, inputs, time_ns)


def measure_supply(robot: RobotState, simulated: Simulated, time_ns: int) -> bool:
    """Measure a robot's supply at a time [ns]; return True if its processor has stopped just now."""
    return CORES[type(robot)].measure_supply(robot, simulated, time_ns)


def start(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> bool:
    """Start a robot's run at time 0; return True if its processor lacks voltage."""
    return CORES[type(robot)].start(robot, simulated, inputs)


def evaluate(robot: RobotState, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    """Evaluate a measurement that a robot has recorded, in the scene at its moment.

    Args:
        robot: State of the robot.
        simulated: Scene at that moment.
        inputs: Lamps at that moment, and random draws.
        part: Number of the measurement, which the model defines.
    """
    CORES[type(robot)].evaluate(robot, simulated, inputs, part)


def interface_of(robot: RobotState) -> Any:
    """Return the registers for controllers of a robot, `Interface`."""
    return CORES[type(robot)].interface


def update_registers(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure, and update the registers of a robot."""
    CORES[type(robot)].update_registers(robot, simulated, inputs)


def set_speeds(robot: RobotState, left: int, right: int) -> None:
    """Set the speeds of a robot's wheels [register], as a command of its protocol does."""
    CORES[type(robot)].set_speeds(robot, left, right)


def is_powered(robot: RobotState) -> bool:
    """Return whether a robot's processor runs."""
    return CORES[type(robot)].is_powered(robot)


def wander(robot: RobotState, registers: Registers) -> None:
    """Set the setpoints of a robot's Braitenberg vehicle in registers."""
    CORES[type(robot)].wander(robot, registers)


def command(robot: RobotState, letter: int, left: int, right: int) -> None:
    """Execute a request of `Core.commands`, by the code of its letter, with any numbers."""
    CORES[type(robot)].command(robot, letter, left, right)


def echo(robot: RobotState, scene: BeamScene, sensor: int) -> float:
    """Return the distance by an ultrasonic sensor, without noise [m]; 0 too near, infinity for no echo."""
    return CORES[type(robot)].echo(robot, scene, sensor)


def marker_of(core: Core) -> str:
    """Return the name of the field that marks the records of a core's states in compiled code."""
    return f"is_{core.name}"


def core_of_fields(names: Container[str]) -> Core | None:
    """Return the core whose states' records have these fields, among them its marker; None for none."""
    return next((core for core in CORES.values() if marker_of(core) in names), None)


DUTIES = (
    *(sense, tick, measure_supply, start, evaluate),
    *(interface_of, update_registers, set_speeds, is_powered, wander, command, echo),
)
"""Functions that choose a model's function of the same name."""
