"""A Toy of a world, and the program on its line."""

from khep_twin.robots.line_server import LineServer
from khep_twin.robots.model import consecutive_registers
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.robot_arrays import Layout, Part
from toy_robot.core import N_REGISTERS, SETPOINT
from toy_robot.model import LABELS, NAME, REGISTERS, SPEEDS, TOY, frame, values


class ToyRobot(Robot):
    """A Toy of a world."""

    sampled = consecutive_registers(LABELS)
    layout = Layout(1, {"registers": [Part("register", N_REGISTERS, -(2**15), 2**15 - 1)]})

    def __init__(self, setup: RobotSetup) -> None:
        self.registers = setup.context.simulation.robots.record_of(setup.index)["registers"]
        super().__init__(setup, LineServer(TOY.dialect, self._execute))

    def reset_motion(self) -> None:
        """Stop the wheels."""
        self.registers[SETPOINT : SETPOINT + 2] = 0

    def _execute(self, request: bytes) -> bytes:
        if request[1] == SPEEDS:
            self.registers[SETPOINT : SETPOINT + 2] = values(request)
        replies = {NAME: (0x546F, 0x7901), SPEEDS: (), REGISTERS: self.registers}
        return frame(request[1], *replies[request[1]])
