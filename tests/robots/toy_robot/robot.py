"""A Toy of a world, and the program on its line.

Numbers are hexadecimal, of 16 bits in two's complement: B names the robot, M,LEFT,RIGHT sets the speeds of
its wheels [mm/s], R reads all registers.
"""

from typing import Any

from khep_twin.robots.line_server import LineServer
from khep_twin.robots.model import consecutive_registers
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.robot_arrays import Layout, Part
from toy_robot.core import N_REGISTERS, SETPOINT
from toy_robot.model import BAUD, LABELS


class ToyServer(LineServer):
    """Program of a Toy with these registers."""

    def __init__(self, registers: Any) -> None:
        super().__init__(BAUD)
        self._registers = registers

    def execute(self, line: bytes) -> bytes:
        """Execute a command; the reply to an unknown one is a question mark."""
        letter, *texts = line.decode("latin-1").split(",")
        try:
            numbers = [int.from_bytes(bytes.fromhex(text), "big", signed=True) for text in texts]
        except ValueError:
            letter = ""
            numbers = []
        if (letter, len(numbers)) == ("M", 2):
            self._registers[SETPOINT : SETPOINT + 2] = numbers
            return b"m\r\n"
        if (letter, numbers) == ("R", []):
            return ",".join(["r", *(f"{value & 0xFFFF:04x}" for value in self._registers)]).encode() + b"\r\n"
        return b"b,toy,1\r\n" if (letter, numbers) == ("B", []) else b"?\r\n"


class ToyRobot(Robot):
    """A Toy of a world."""

    sampled = consecutive_registers(LABELS)
    layout = Layout(1, {"registers": [Part("register", N_REGISTERS, -(2**15), 2**15 - 1)]})

    def __init__(self, setup: RobotSetup) -> None:
        self.registers = setup.context.simulation.robots.record_of(setup.index)["registers"]
        super().__init__(setup, ToyServer(self.registers))

    def reset_motion(self) -> None:
        """Stop the wheels."""
        self.registers[SETPOINT : SETPOINT + 2] = 0
