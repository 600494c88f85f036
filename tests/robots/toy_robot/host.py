"""`Toy`: a Toy at the other end of a port."""

from khep_twin.host.host_command import frame_command
from khep_twin.host.host_robot import HostRobot
from khep_twin.robots.model import consecutive_registers
from toy_robot.model import FRAMES, LABELS, REGISTERS, SPEEDS, TOY, frame, values


class Toy(HostRobot):
    """A Toy behind a port. Leaving it as a context stops the motors."""

    dialect = TOY.dialect

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [m/s]."""
        request = frame(SPEEDS, round(1000 * left), round(1000 * right))
        self._run(frame_command(FRAMES, request, values))

    def read_panel(self) -> dict[str, list[int]]:
        """Return the registers by their channels, among them the values of a panel."""
        registers = self._run(frame_command(FRAMES, frame(REGISTERS), values, repeatable=True))
        return {name: [registers[index] for index in part] for name, _, part in consecutive_registers(LABELS)}
