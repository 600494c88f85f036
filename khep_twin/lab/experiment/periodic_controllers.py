"""Controllers that decide once a period, and networks as such controllers.

    from khep_twin import Khepera, Network, NetworkController
    from khep_twin.lab.experiment import run

    with Khepera("/dev/ttyUSB0") as robot:
        run(NetworkController(Network.load("best.npz")), robot, seconds=60)

On a twin or a robot they have the cycle that a rollout with that line has (`khep_twin.episodes.line`).
"""

import math

from khep_twin import units
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.episodes import networks
from khep_twin.episodes.controllers import Network
from khep_twin.errors import ControllerError
from khep_twin.firmware import SPEED_LIMIT_PULSES
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import Controller


class PeriodicController(Controller):
    """A controller that asks, decides and drives once a period, in the port's own time.

    A cycle that takes longer is followed by the next one at once.

    Args:
        period_ns: Control period [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns

    def decide(self, robot: Khepera) -> tuple[float, float]:
        """Ask the robot and return the speeds of the left and right wheel [pulses/10 ms]."""
        raise NotImplementedError(f"{type(self).__name__} needs a decide(self, robot)")

    def cycle(self, robot: Khepera) -> None:
        """Drive at the speeds, rounded and clipped as in a rollout, and wait for the end of the period."""
        # Times of a port are whole nanoseconds, as floats in seconds.
        end_ns = to_ns(robot.time) + self._period_ns
        most = float(SPEED_LIMIT_PULSES)
        left, right = (round(min(max(speed, -most), most)) for speed in self.decide(robot))
        robot.set_speed(left, right)
        if (left_ns := end_ns - to_ns(robot.time)) > 0:
            robot.sleep(left_ns / NS_PER_S)


class NetworkController(PeriodicController):
    """A network that drives a robot at the other end of a line, as it drives one in a rollout.

    Each cycle asks N, with ambient inputs O, too, evaluates the network, and sends D.

    Args:
        network: Network with genes.
        file: Name of its file, for messages and logs; empty without.

    Attributes:
        network: Network.
        file: Name of its file.

    Raises:
        ControllerError: The network has not the genes that it needs.
    """

    def __init__(self, network: Network, file: str = "") -> None:
        if len(network.genes) != network.n_genes:
            raise ControllerError(f"{len(network.genes)} genes for {network}; expected {network.n_genes}")
        super().__init__(network.period_ns)
        self.network, self.file = network, file
        self._genes = list(network.genes)
        self._memory: list[float] = []
        self._sizes, self._values = list(network.sizes), [0.0] * sum(network.sizes)

    def start(self, robot: Khepera) -> None:
        """Forget the values of the run before."""
        self._memory = [0.0] * self.network.sizes[1]

    def decide(self, robot: Khepera) -> tuple[float, float]:
        """Ask the robot and evaluate the network."""
        network, values = self.network, self._values
        values[: units.N_SENSORS] = [count / units.COUNTS_LIMIT for count in robot.proximity()]
        if network.ambient:
            dark, bright = network.light
            values[units.N_SENSORS : network.sizes[0]] = [
                (dark - count) / (dark - bright) for count in robot.ambient()
            ]
        out = networks.forward(self._sizes, network.recurrent, self._genes, self._memory, values)
        left, right = (network.top_speed * value for value in values[out : out + 2])
        if not (math.isfinite(left) and math.isfinite(right)):
            name = self.file or "network"
            raise ControllerError(f"{name}: speeds {left}, {right}; expected finite numbers")
        return left, right
