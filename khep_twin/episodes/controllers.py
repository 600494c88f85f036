"""Controllers of episodes without a serial line: constant speed, Braitenberg, networks, functions, policies.

All but a policy run inside the compiled loop. A policy is plain Python that is called for many robots.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.episodes import network_file, networks, stepping
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes, initial_events, line_times
from khep_twin.episodes.metrics import initial_sums
from khep_twin.episodes.stepping import N_SCALE
from khep_twin.errors import ControllerError
from khep_twin.files.paths import StrPath
from khep_twin.robots.core import Registers, core_of, wander_nowhere
from khep_twin.robots.model import RobotModel, Term
from khep_twin.robots.registry import default_model, find_family
from khep_twin.units import SCAN_NS

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ConstantSpeed:
    """No controller; both wheels start at a speed [register] and keep it, with any line.

    The `requests` of a controller are those that it sends to the robot in each cycle: see `line.REQUESTS`.
    """

    left: int = 0
    right: int = 0

    @property
    def requests(self) -> str:
        """Requests of a cycle: none."""
        return ""


@dataclass(frozen=True, slots=True)
class Braitenberg:
    """The Braitenberg vehicle of a Khepera's ROM: speed = proximity x weights / 400 + 10."""

    @property
    def requests(self) -> str:
        """Requests of a cycle."""
        return "N"


@dataclass(frozen=True, slots=True)
class Network:
    """A neural network from sensors to speeds; see `networks` for its equation and the order of its genes.

        network = Network(hidden=(5,))
        network.save("best.npz", genes, setup=setup, seed=1)
        rollout("obstacles", Network.load("best.npz"), range(8), 60.0)

    Attributes:
        hidden: Neurons of each hidden layer; none to connect sensors directly to motors.
        recurrent: Whether the first layer behind the sensors has feedback of its last values.
        ambient: Whether ambient light (0 dark to 1 bright) is an input behind proximity (0 to 1).
        terms: Names of further readings (`robots.model.Term`) that are inputs behind these, 0 to 1, or -1 to
            1 for those with a sign.
        commands: Names of terms of turrets that are outputs behind the speeds, from lowest to highest value.
        top_speed: Speed for an output of 1 [register], of a Khepera [pulses/10 ms]; 0 for that of metrics.
        model: Model of the robot, or its family, e.g. "khepera4".
        genes: Genome (n_genes,) for episodes whose options have none; empty for none.
        period_ns: Control period of training [ns], used by a host and by a rollout without a setup.
        light: Ambient counts that are inputs of 0 and 1 on a host (2,); a rollout uses those of its robot.
        playpen: Playpen of training; empty if unknown.
        seed: Seed of training; None if unknown.
    """

    hidden: tuple[int, ...] = ()
    recurrent: bool = False
    ambient: bool = False
    top_speed: float = 0.0
    terms: tuple[str, ...] = field(default=(), kw_only=True)
    commands: tuple[str, ...] = field(default=(), kw_only=True)
    model: str = field(default=default_model().family, kw_only=True)
    genes: Sequence[float] | Floats = field(default=(), repr=False, kw_only=True)
    period_ns: int = field(default=SCAN_NS, kw_only=True)
    light: tuple[float, float] = field(default=network_file.LIGHT, repr=False, kw_only=True)
    playpen: str = field(default="", kw_only=True)
    seed: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Store the genes as a tuple, which is comparable and immutable, and defaults of its model."""
        model = find_family(self.model)
        if not self.top_speed:
            object.__setattr__(self, "top_speed", model.episode_interface.top_speed)
        object.__setattr__(self, "model", model.family)
        object.__setattr__(self, "terms", tuple(term.name for term in model.find_terms(self.terms)))
        commands = model.find_terms(self.commands, commanded=True)
        object.__setattr__(self, "commands", tuple(term.name for term in commands))
        object.__setattr__(self, "genes", tuple(np.asarray(self.genes, np.float64).ravel().tolist()))

    @classmethod
    def load(cls, path: StrPath) -> Self:
        """Load a network with its genes from a file of `save`.

        Raises:
            ControllerError: The file cannot be read, is of another kind, or is damaged.
        """
        return cls(**network_file.read(Path(path))._asdict())

    def save(
        self,
        path: StrPath,
        genes: Sequence[float] | Floats | None = None,
        *,
        setup: EpisodeSetup | None = None,
        seed: int | None = None,
        replace: bool = False,
    ) -> None:
        """Write the network with its genes to an NPZ file, or to a program in C for the robot itself.

        The file may replace that of another network.

        Args:
            path: Name of the file, which ends in .npz, or in .c for a program.
            genes: Genome (n_genes,); by default that of the network.
            setup: Setup of the training episodes, for `period_ns`, `light` and `playpen`.
            seed: Seed of training; by default that of the network.
            replace: Whether to replace also a file that is not a network.

        Raises:
            ControllerError: The genes do not fit the network, or a file of another kind is there.
            KhepTwinError: The file cannot be written.
        """
        fields = {name: getattr(self, name) for name in network_file.NetworkContent._fields}
        if genes is not None:
            fields["genes"] = np.asarray(genes, np.float64).ravel().tolist()
        if setup is not None:
            ambient = setup.calibration.ambient
            fields["light"] = ambient.dark_counts, ambient.floor_counts
            fields["period_ns"], fields["playpen"] = setup.period_ns, setup.playpen.name
        if seed is not None:
            fields["seed"] = seed
        network_file.write(Path(path), network_file.NetworkContent(**fields), replace)

    @property
    def inputs(self) -> list[network_file.Input]:
        """Inputs in their order."""
        return network_file.describe_inputs(self.ambient, self.terms, self.light, self.model)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of inputs, neurons of each layer and outputs (left, right, commands)."""
        return len(self.inputs), *self.hidden, 2 + len(self.commands)

    @property
    def requests(self) -> str:
        """Requests of a cycle."""
        return "NO" if self.ambient else "N"

    @property
    def n_genes(self) -> int:
        """Length of the genome."""
        return networks.n_genes(self.sizes, self.recurrent)


@dataclass(frozen=True, slots=True)
class Function:
    """A function of a robot's proximity (n,), ambient (n,), memory, genes and readings of each term (n,).

    It returns left and right speed [register] and the values of its commands, which are rounded and clipped.
    It may change only its memory. The decorator `numba.njit` is optional: compiled episodes compile it.

    Attributes:
        decide: The function.
        n_memory: Length of its memory, which starts with zeros.
        requests: Requests of a cycle; "N" for a function that needs no light saves time on a line.
        terms: Names of further readings (`robots.model.Term`) that are its last arguments [register].
        commands: Names of terms of turrets whose values it returns behind the speeds.
    """

    decide: Callable[..., tuple[float, ...]]
    n_memory: int = 0
    requests: str = "NO"
    terms: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()


def _no_function(*readings: object) -> NoReturn:
    raise NotImplementedError("a policy without a function; expected its caller to give the speeds")


@dataclass(frozen=True, slots=True)
class Policy:
    """A function in plain Python that is called once per control period for many robots.

    Attributes:
        decide: Function of proximity (n, n_sensors), ambient (n, n_sensors), indices of the episodes (n,) and
            readings of each term (n, n_readings), with a row for each robot. It returns speeds [register] and
            values of its commands (n, 2 + n_commands); a row must not depend on other episodes. By default
            there is none: the caller of the `Episode` sets the speeds.
        requests: Requests of a cycle; "N" for a policy that needs no light saves time on a line.
        terms: Names of further readings (`robots.model.Term`) that are its last arguments [register].
        commands: Names of terms of turrets whose values it returns behind the speeds.
    """

    decide: Callable[..., ArrayLike] = _no_function
    requests: str = "NO"
    terms: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()


Driver = ConstantSpeed | Braitenberg | Network | Function | Policy


def terms_in(function: Callable[..., object], count: int) -> tuple[str, ...]:
    """Return the names of a function's parameters behind the first `count`, except those with a default."""
    try:
        parameters = [*inspect.signature(function).parameters.values()][count:]
    except ValueError:  # a function in C without a signature
        return ()
    kinds = Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD
    required = (parameter for parameter in parameters if parameter.default is Parameter.empty)
    return tuple(parameter.name for parameter in required if parameter.kind in kinds)


def terms_of(driver: Driver) -> tuple[str, ...]:
    """Return the names of the further readings that a controller asks for."""
    return driver.terms if isinstance(driver, Network | Function | Policy) else ()


def commands_of(driver: Driver) -> tuple[str, ...]:
    """Return the names of the terms of turrets that a controller sets."""
    return driver.commands if isinstance(driver, Network | Function | Policy) else ()


_EXPECTED_DRIVER = "expected a ConstantSpeed, Braitenberg, Network, Function or Policy"


def find_terms(driver: Driver, model: RobotModel) -> list[Term]:
    """Return the further readings that a controller asks for, those of turrets behind the robot's registers.

    Raises:
        ControllerError: It does not control robots of the model.
        RobotModelError: The model lacks the reading.
    """
    if isinstance(driver, Braitenberg) and core_of(model).wander is wander_nowhere:
        raise ControllerError(f"Braitenberg: a robot of model {model.name}; expected a Khepera")
    if isinstance(driver, Network) and driver.model != model.family:
        raise ControllerError(f"network of model {driver.model!r}; expected model = {model.family!r}")
    return model.place_terms(terms_of(driver))


def readings_of(driver: Driver, setup: EpisodeSetup) -> tuple[tuple[int, int], ...]:
    """Return the first register of proximity, ambient light and each term of a controller, and their ends."""
    interface, terms = setup.interface, find_terms(driver, setup.entry.robot_model)
    return interface.proximity, interface.ambient, *(term.registers for term in terms)


def board_shape(driver: Driver, setup: EpisodeSetup) -> tuple[int, int]:
    """Return the numbers of registers with readings of turrets, and of speeds with commands."""
    n_registers = max(setup.interface.n_registers, *map(max, readings_of(driver, setup)))
    return n_registers, 2 + len(commands_of(driver))


def make_controllers(
    driver: Driver,
    genes: Floats,
    home: Floats,
    line: LineTimes,
    setup: EpisodeSetup,
    compiled: bool,
) -> stepping.Controllers:
    """Return the controllers of an episode's robots as the stepping core uses them.

    Args:
        driver: Controller; a policy is left to the caller.
        genes: Weights of a network, or parameters of a function, for all robots (n_genes,) or for each
            (n_robots, n_genes).
        home: Home x, y, radius [m] and duration of the charge [s] (4,).
        line: Line between controllers and robots.
        setup: Setup of the episode.
        compiled: Whether compiled code runs the controllers, with a function by its address.

    Raises:
        ControllerError: The number of genes is wrong, numba cannot compile the function, the model lacks
            the controller, or the driver is of no known kind.
        RobotModelError: The model lacks a term.
    """
    n_robots = len(setup.playpen.robots)
    terms = find_terms(driver, setup.entry.robot_model)
    kind, function, sizes, recurrent, top_speed, n_memory = stepping.CONSTANT_SPEED, 0, (), False, 0.0, 0
    scales: list[tuple[float, ...]] = []
    if isinstance(driver, Network) and not genes.size:
        genes = np.array(driver.genes, np.float64)
    if genes.ndim == 2 and len(genes) != n_robots:
        raise ControllerError(f"genes for {len(genes)} robots; expected {n_robots}")
    readings = readings_of(driver, setup)
    n_registers, n_outputs = board_shape(driver, setup)
    weights = np.array(np.broadcast_to(genes, (n_robots, genes.shape[-1])), np.float64)
    match driver:
        case Braitenberg():
            kind = stepping.BRAITENBERG
        case Network():
            if weights.shape[1] != driver.n_genes:
                raise ControllerError(f"{weights.shape[1]} genes for {driver}; expected {driver.n_genes}")
            kind, sizes, recurrent = stepping.NETWORK, driver.sizes, driver.recurrent
            top_speed, n_memory = float(driver.top_speed), sizes[1]
            first_term = sizes[0] - sum(len(term.names) for term in terms)
            scales = [entry[1:5] for entry in driver.inputs[first_term:]]
        case Function():
            kind, n_memory = stepping.FUNCTION, driver.n_memory
            if compiled:
                from khep_twin.episodes.compiled import compile_controller

                function = compile_controller(driver.decide, n_registers, readings, n_outputs)
            else:
                function = partial(_call_plain, driver.decide, readings)
        case Policy():
            kind = stepping.CONSTANT_SPEED if line is None else stepping.CALLER
        case ConstantSpeed():
            pass
        case _:
            raise ControllerError(f"{driver!r} is no controller; {_EXPECTED_DRIVER}")
    times = line_times(line, driver.requests, setup.period_ns)
    controllers = stepping.Controllers(
        kind,
        function,
        np.array(sizes, np.int64),
        recurrent,
        top_speed,
        np.array(scales, np.float64).reshape(-1, N_SCALE),
        weights,
        np.zeros((n_robots, n_memory)),
        np.zeros(sum(sizes)),
        np.full((n_robots, n_outputs), np.nan),
        home,
        initial_sums(n_robots, home),
        times,
        initial_events(n_robots, times),
        np.zeros((n_robots, n_registers), np.int64),
    )
    return controllers if compiled else _to_python(controllers)


def _call_plain(
    function: Callable[..., tuple[float, ...]],
    readings: Sequence[tuple[int, int]],
    registers: Registers,
    memory: Floats,
    genes: Floats,
) -> tuple[float, ...]:
    """Call a function with the sensors in the registers."""
    values: NDArray[np.int64] = np.asarray(registers)
    proximity, ambient, *terms = (values[slice(*reading)] for reading in readings)
    return function(proximity, ambient, memory, genes, *terms)


def _to_python(controllers: stepping.Controllers) -> stepping.Controllers:
    """Return controllers whose arrays are views and lists, which are faster in Python."""
    controllers = controllers._replace(
        line=np.asarray(controllers.line).tolist(),
        events=[event.data for event in controllers.events],
        host_registers=[registers.data for registers in controllers.host_registers],
    )
    if controllers.kind == stepping.FUNCTION:
        return controllers
    return controllers._replace(
        sizes=np.asarray(controllers.sizes).tolist(),
        terms=controllers.terms.tolist(),
        genes=controllers.genes.tolist(),
        memory=controllers.memory.tolist(),
        neurons=[0.0] * len(controllers.neurons),
    )
