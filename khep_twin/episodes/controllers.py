"""Controllers of episodes without a serial line: none, the ROM's vehicle, networks, functions, policies.

All but a policy run inside the compiled loop; a policy is plain Python and is called for many robots at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.board import kernel
from khep_twin.episodes import network_file, networks, stepping
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.fitness import TOP_SPEED_PULSES
from khep_twin.episodes.line import LineTimes, first_events, line_times
from khep_twin.episodes.metrics import sums_at_start
from khep_twin.errors import ControllerError
from khep_twin.files.paths import StrPath
from khep_twin.units import SCAN_NS

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ConstantSpeed:
    """No controller; both wheels start at a speed [pulses/10 ms] and keep it, whatever the line.

    `requests` of a controller are what it asks the robot in each cycle: see `line.REQUESTS`.
    """

    left: int = 0
    right: int = 0

    @property
    def requests(self) -> str:
        """Requests of a cycle: none."""
        return ""


@dataclass(frozen=True, slots=True)
class Braitenberg:
    """The Braitenberg vehicle of the ROM: speed = proximity x weights / 400 + 10."""

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
        recurrent: Whether the first layer behind the sensors has feedback of its own last values.
        ambient: Whether light is an input too, 0 dark to 1 bright, behind proximity, 0 to 1.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        genes: Own genes (n_genes,), used where an episode is given none; empty for none.
        period_ns: Control period that it was made for [ns], kept by a host and by a rollout without a setup.
        light: Ambient counts that are 0 and 1 for a host (2,); a rollout has those of its robot.
        playpen: Playpen in which it was found; empty if unknown.
        seed: Seed with which it was found; None if unknown.
    """

    hidden: tuple[int, ...] = ()
    recurrent: bool = False
    ambient: bool = False
    top_speed: float = TOP_SPEED_PULSES
    genes: Sequence[float] | Floats = field(default=(), repr=False, kw_only=True)
    period_ns: int = field(default=SCAN_NS, kw_only=True)
    light: tuple[float, float] = field(default=network_file.LIGHT, repr=False, kw_only=True)
    playpen: str = field(default="", kw_only=True)
    seed: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Keep the genes as a tuple, which compares and cannot change."""
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
        """Write the network with its genes to an NPZ file, in place of another network of that name.

        Args:
            path: Name of the file, which ends in .npz.
            genes: Genes (n_genes,); by default its own.
            setup: Setup of the episodes that it was found in, for `period_ns`, `light` and `playpen`.
            seed: Seed with which it was found; by default its own.
            replace: Whether to replace a file that is no network, too.

        Raises:
            ControllerError: The genes do not fit the network, or a file of another kind is there.
            KhepTwinError: The file cannot be written.
        """
        found = {name: getattr(self, name) for name in network_file.Stored._fields}
        if genes is not None:
            found["genes"] = np.asarray(genes, np.float64).ravel().tolist()
        if setup is not None:
            ambient = setup.calibration.ambient
            found["light"] = ambient.dark_counts, ambient.floor_counts
            found["period_ns"], found["playpen"] = setup.period_ns, setup.playpen.name
        if seed is not None:
            found["seed"] = seed
        network_file.write(Path(path), network_file.Stored(**found), replace)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of inputs, neurons of each layer and outputs (left and right)."""
        return network_file.sizes(self.hidden, self.ambient)

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
    """A function of a robot's proximity (8,), ambient (8,), memory and genes.

    It returns left and right speed [pulses/10 ms], rounded and clipped to 127 as by command D, and changes
    nothing but its memory. It may be decorated with `numba.njit`; if not, it is compiled all the same.

    Attributes:
        decide: The function.
        n_memory: Length of its memory, all 0 at first.
        requests: Requests of a cycle; "N" for a function that needs no light saves time on a line.
    """

    decide: Callable[..., tuple[float, float]]
    n_memory: int = 0
    requests: str = "NO"


def _by_caller(*readings: object) -> NoReturn:
    raise NotImplementedError("a policy without a function; expected its caller to give the speeds")


@dataclass(frozen=True, slots=True)
class Policy:
    """A function of many robots at once, in plain Python, called once per control period.

    Attributes:
        decide: Function of proximity (n, 8), ambient (n, 8) and indices of the episodes (n,), a row for each
            robot, that returns speeds (n, 2) [pulses/10 ms]; a row may depend on none of another episode.
            By default there is none: the caller of the `Episode` gives the speeds.
        requests: Requests of a cycle; "N" for a policy that needs no light saves time on a line.
    """

    decide: Callable[[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]], ArrayLike] = _by_caller
    requests: str = "NO"


Driver = ConstantSpeed | Braitenberg | Network | Function | Policy

_DRIVERS = "expected a ConstantSpeed, Braitenberg, Network, Function or Policy"


def controllers_of(
    driver: Driver,
    genes: Floats,
    home: Floats,
    line: LineTimes,
    period_ns: int,
    n_robots: int,
    compiled: bool,
) -> stepping.Controllers:
    """Return the controllers of an episode's robots as the stepping core uses them.

    Args:
        driver: Controller; for a policy only the sums of metrics are kept.
        genes: Weights of a network, or parameters of a function (n_genes,), or each robot's own
            (n_robots, n_genes).
        home: Home x, y, radius [m] and duration of the charge [s] (4,).
        line: Line between controllers and robots.
        period_ns: Control period [ns].
        n_robots: Number of robots.
        compiled: Whether a function is given by its address.

    Raises:
        ControllerError: The number of genes is wrong, numba cannot compile the function, or the driver is of
            no known kind.
    """
    kind, function, sizes, recurrent, top_speed, n_memory = stepping.CONSTANT_SPEED, 0, (), False, 0.0, 0
    if isinstance(driver, Network) and not genes.size:
        genes = np.array(driver.genes, np.float64)
    if genes.ndim == 2 and len(genes) != n_robots:
        raise ControllerError(f"genes for {len(genes)} robots; expected {n_robots}")
    weights = np.array(np.broadcast_to(genes, (n_robots, genes.shape[-1])), np.float64)
    match driver:
        case Braitenberg():
            kind = stepping.BRAITENBERG
        case Network():
            if weights.shape[1] != driver.n_genes:
                raise ControllerError(f"{weights.shape[1]} genes for {driver}; expected {driver.n_genes}")
            kind, sizes, recurrent = stepping.NETWORK, driver.sizes, driver.recurrent
            top_speed, n_memory = float(driver.top_speed), sizes[1]
        case Function():
            kind, function, n_memory = stepping.FUNCTION, driver.decide, driver.n_memory
            if compiled:
                from khep_twin.episodes.compiled import address_of

                function = address_of(driver.decide)
        case Policy():
            kind = stepping.CONSTANT_SPEED if line is None else stepping.CALLER
        case ConstantSpeed():
            pass
        case _:
            raise ControllerError(f"{driver!r} is no controller; {_DRIVERS}")
    times = line_times(line, driver.requests, period_ns)
    controllers = stepping.Controllers(
        kind,
        function,
        np.array(sizes, np.int64),
        recurrent,
        top_speed,
        weights,
        np.zeros((n_robots, n_memory)),
        np.zeros(sum(sizes)),
        np.zeros(2),
        home,
        sums_at_start(n_robots, home),
        times,
        first_events(n_robots, times),
        np.zeros((n_robots, kernel.N_REGISTERS), np.int64),
    )
    return controllers if compiled else _in_python(controllers)


def _in_python(controllers: stepping.Controllers) -> stepping.Controllers:
    """Return controllers whose arrays are views and lists, which are faster in Python."""
    controllers = controllers._replace(
        line=np.asarray(controllers.line).tolist(),
        events=[event.data for event in controllers.events],
        seen=[seen.data for seen in controllers.seen],
    )
    if controllers.kind == stepping.FUNCTION:
        return controllers
    return controllers._replace(
        sizes=np.asarray(controllers.sizes).tolist(),
        genes=controllers.genes.tolist(),
        memory=controllers.memory.tolist(),
        values=[0.0] * len(controllers.values),
    )
