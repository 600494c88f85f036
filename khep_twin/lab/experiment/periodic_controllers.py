"""Controllers with a fixed control period, and networks as controllers.

    from khep_twin import Khepera, Network, NetworkController
    from khep_twin.lab.experiment import run

    with Khepera("/dev/ttyUSB0") as robot:
        run(NetworkController(Network.load("best.npz")), robot, seconds=60)

They read and set the registers of their model's `Interface`. On a twin or a robot, their cycle is that of a
rollout with a serial line (`khep_twin.episodes.line`).
"""

import math
from typing import cast

from khep_twin.board.turrets import installed_turrets
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.episodes import networks
from khep_twin.episodes.controllers import Network
from khep_twin.errors import ControllerError
from khep_twin.host.host_robot import HostRobot
from khep_twin.host.khepera import Khepera
from khep_twin.host.turret import HostTurret
from khep_twin.lab.experiment.controllers import AnyRobot, Controller
from khep_twin.robots.registry import find_family


class PeriodicController(Controller):
    """Controller that reads sensors, decides and drives once a period, in the port's time.

    The next cycle follows immediately after a cycle that takes longer than the period.

    Args:
        period_ns: Control period [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._period_ns / NS_PER_S

    def decide(self, robot: AnyRobot) -> tuple[float, float]:
        """Read the robot's sensors; return the speeds of the left and right wheel [register]."""
        raise NotImplementedError(f"{type(self).__name__} needs a decide(self, robot)")

    def cycle(self, robot: HostRobot) -> None:
        """Drive at the speeds, rounded and clipped as in a rollout, then wait for the end of the period."""
        # A port's time is a whole number of nanoseconds, as a float in seconds.
        end_ns = to_ns(robot.time) + self._period_ns
        limit = float(robot.model.episode_interface.speed_limit)
        left, right = (round(min(max(speed, -limit), limit)) for speed in self.decide(robot))
        robot.set_setpoints(left, right)
        if (remaining_ns := end_ns - to_ns(robot.time)) > 0:
            robot.sleep(remaining_ns / NS_PER_S)


class NetworkController(PeriodicController):
    """Network that drives a robot on a serial line, as in a rollout.

    Each cycle asks for proximity (N), for light if that is an input (O), and for terms, evaluates the
    network, gives orders to turrets whose values have changed, and sends the speeds (D).

    Args:
        network: Network with genes.
        file: Name of its file, for messages and logs; empty without a file.

    Raises:
        ControllerError: The network has a wrong number of genes.
    """

    def __init__(self, network: Network, file: str = "") -> None:
        if len(network.genes) != network.n_genes:
            raise ControllerError(f"{len(network.genes)} genes for {network}; expected {network.n_genes}")
        super().__init__(network.period_ns)
        self.network = network
        self.file = file
        self._genes = list(network.genes)
        self._inputs = network.inputs
        model = find_family(network.model)
        n_registers = model.episode_interface.n_registers
        self._registers = [entry.register for entry in self._inputs if entry.register < n_registers]
        self._terms = [term for term in model.place_terms(network.terms) if term.turret]
        self._commands = model.find_terms(network.commands)
        self._memory: list[float] = []
        self._sizes = list(network.sizes)
        self._values = [0.0] * sum(network.sizes)
        self._turrets: dict[str, HostTurret] = {}
        self._orders: dict[str, str] = {}

    @property
    def family(self) -> str:
        """Family of the robots that it drives."""
        return self.network.model

    @property
    def subject(self) -> str:
        """Name for messages."""
        return self.file or "network"

    def start(self, robot: HostRobot) -> None:
        """Reset the recurrent memory, and check that the robot has the turrets."""
        self._memory, self._orders = [0.0] * self.network.sizes[1], {}
        kinds = {installed_turrets()[term.turret] for term in (*self._terms, *self._commands)}
        self._turrets = {kind.name: HostTurret(cast(Khepera, robot), kind) for kind in kinds}

    def decide(self, robot: HostRobot) -> tuple[float, float]:
        """Read the robot's sensors, evaluate the network, and give its orders to turrets."""
        network, values, inputs = self.network, self._values, self._inputs
        readings = dict(zip(self._registers, robot.read_registers(self._registers), strict=True))
        for term in self._terms:
            answer = self._turrets[term.turret].ask(term.message, len(term.names))
            readings |= zip(range(*term.registers), answer, strict=True)
        values[: len(inputs)] = [entry.scale(readings[entry.register]) for entry in inputs]
        output_start = networks.forward(self._sizes, network.recurrent, self._genes, self._memory, values)
        left, right = (network.top_speed * value for value in values[output_start : output_start + 2])
        if not (math.isfinite(left) and math.isfinite(right)):
            raise ControllerError(f"{self.subject}: speeds {left}, {right}; expected finite numbers")
        for index, term in enumerate(self._commands, output_start + 2):
            if (order := term.order_for(term.unscale(values[index]))) != self._orders.get(term.name):
                self._turrets[term.turret].ask(order, 0)
                self._orders[term.name] = order
        return left, right
