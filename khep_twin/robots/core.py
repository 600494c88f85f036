"""Part of a robot's model that the stepping core runs: its state, and functions that are compilable.

A model gives a `Core`. The stepping core calls a robot's functions by the functions of this module, which
choose them by the class of the robot's state: in plain code by a table, in compiled code by an overload that
`simulation.compiled` registers. So a scene compiles what its models have, and nothing else.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from khep_twin.compilable import compilable
from khep_twin.robots.model import RobotModel


@compilable
def _start_at_once(robot: Any, simulated: Any, inputs: Any) -> bool:
    """Do nothing, as the state before the start is that of a run."""
    return False


@compilable
def _measure_no_supply(robot: Any, simulated: Any, time_ns: int) -> bool:
    """Do nothing, as the supply is constant."""
    return False


@compilable
def _evaluate_nothing(robot: Any, simulated: Any, inputs: Any, part: int) -> None:
    """Do nothing, as no measurement is recorded."""


class Core(NamedTuple):
    """Core of a model.

    All functions but `make_state` and `scan` are `compilable`; their arguments are those of the function of
    the same name in this module.

    Attributes:
        name: Name of the family of models that it runs.
        state: Class of a robot's state, a named tuple of numbers and arrays, or of named tuples of them. It
            has at least `pose` (index of the pose), `radius` [m] and `noise` (key of the random draws, (2,)).
        make_state: Function that returns the state before a start, for a model, indices of the robot, its
            calibration, its entry of the playpen, and the number of its first moment.
        changing: Fields of the state that change during a run.
        modules: Names of the modules that are compiled for it.
        sense: Runs the sensors in a step.
        tick: Runs the control period of 10 ms.
        scan: Measures with all sensors now; always plain.
        start: Starts the run, after the scan before time 0; by default it does nothing.
        measure_supply: Measures the supply; by default it is constant.
        evaluate: Evaluates a recorded measurement.
        n_moments: Number of moments that the robot records for later measurements, see `scene.save_moment`.
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


CORES: dict[type[Any], Core] = {}
"""Cores by the class of their state."""


def register(core: Core) -> Core:
    """Add a core to `CORES`; return it."""
    CORES[core.state] = core
    return core


def core_of(model: RobotModel) -> Core:
    """Return the core of a model."""
    return model.load("core", Core)


def sense(robot: Any, simulated: Any, inputs: Any, start: int) -> None:
    """Run the sensors of a robot in a step.

    Args:
        robot: State of the robot.
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        start: Number of the step's first conversion (`Timing.conversions`) since the start of the run.
    """
    CORES[type(robot)].sense(robot, simulated, inputs, start)


def tick(robot: Any, simulated: Any, inputs: Any, time_ns: int) -> bool:
    """Run a robot's control period at a time [ns]; return True if code outside the core must act now."""
    return CORES[type(robot)].tick(robot, simulated, inputs, time_ns)


def measure_supply(robot: Any, simulated: Any, time_ns: int) -> bool:
    """Measure a robot's supply at a time [ns]; return True if its processor has stopped just now."""
    return CORES[type(robot)].measure_supply(robot, simulated, time_ns)


def start(robot: Any, simulated: Any, inputs: Any) -> bool:
    """Start a robot's run at time 0; return True if its processor lacks voltage."""
    return CORES[type(robot)].start(robot, simulated, inputs)


def evaluate(robot: Any, simulated: Any, inputs: Any, part: int) -> None:
    """Evaluate a measurement that a robot has recorded, in the scene at its moment.

    Args:
        robot: State of the robot.
        simulated: Scene at that moment.
        inputs: Lamps at that moment, and random draws.
        part: Number of the measurement, which the model defines.
    """
    CORES[type(robot)].evaluate(robot, simulated, inputs, part)


DUTIES = (sense, tick, measure_supply, start, evaluate)
"""Functions that choose a model's function of the same name."""
