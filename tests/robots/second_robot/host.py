"""`Scout`: a Scout at the other end of a port."""

from functools import partial

from khep_twin.host.host_command import HostCommand
from khep_twin.host.host_robot import HostRobot
from khep_twin.robots.model import consecutive_registers
from second_robot.model import LABELS, N_VALUES, READS, SCOUT


def parse(count: int, reply: str) -> list[int]:
    """Return the numbers of a reply."""
    values = [int(value) for value in reply.split()]
    if len(values) != count or values == [-1]:
        raise ValueError(f"expected {count} numbers")
    return values


class Scout(HostRobot):
    """A Scout behind a port. Leaving it as a context stops the motors."""

    dialect = SCOUT.dialect

    def send(self, word: str, *values: int) -> list[int]:
        """Send a request; return the numbers of its reply."""
        request = " ".join([word, *map(str, values)])
        return self._run(HostCommand(request, partial(parse, N_VALUES[word]), word in READS))

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [rad/s]."""
        self.send("drive", round(100 * left), round(100 * right))

    def read_panel(self) -> dict[str, list[int]]:
        """Return the readings by their channels."""
        registers = {
            first + i: value for word, (first, _) in READS.items() for i, value in enumerate(self.send(word))
        }
        channels = consecutive_registers(LABELS)
        return {name: [registers[i] for i in part] for name, _, part in channels if name != "leds"}
