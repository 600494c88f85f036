"""The computer of a Khepera IV: the dsPIC on its I2C bus, its pins, and its configuration files."""

from collections.abc import Mapping

from khep_twin.programs.computer import Computer, Devices, Kind, Node
from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.registers import ADDRESS
from khep_twin.robots.khepera4.robot import Khepera4Robot

RESET_PIN, CHARGER_PIN = 90, 65
"""Pins: 0 holds the dsPIC in reset; 0 while the charger is plugged in (library)."""


class DspicSlave:
    """A dsPIC on the bus: a write sets the register at which reads begin.

    Args:
        dspic: The dsPIC.
    """

    def __init__(self, dspic: Dspic) -> None:
        self._dspic = dspic
        self._next_register = 0
        self._is_held = False

    @property
    def is_powered(self) -> bool:
        """True if it is not held in reset, and the supply suffices."""
        return not self._is_held and self._dspic.is_powered

    def write(self, message: bytes) -> None:
        """Set registers."""
        self._next_register = message[0]
        self._dspic.write(message)

    def read(self, count: int) -> bytes:
        """Return registers."""
        return self._dspic.read(self._next_register, count)

    def set_pin(self, pin: int, level: int) -> None:
        """Reset the dsPIC and hold it while `RESET_PIN` is 0."""
        if pin == RESET_PIN:
            self._is_held = not level
            if not level:
                self._dspic.reset()


def connect(robot: Khepera4Robot) -> Devices:
    """Return the devices of a robot."""
    slave = DspicSlave(robot.dspic)
    return Devices({(0, ADDRESS): slave}, {CHARGER_PIN: 1, RESET_PIN: 1}, slave.set_pin)


def files(number: int) -> Mapping[str, str]:
    """Return the robot's number, and the file by which K-Team's library finds the dsPIC."""
    return {
        "/etc/khepera/robotid": f"{number}\n",
        "/etc/libkhepera/khepera4.knc": f"section Khepera4\ndevice dsPic i2c {ADDRESS:#x}\n",
    }


COMPUTER = Computer(
    nodes={
        "/dev/i2c-*": Node(Kind.I2C),
        "/dev/user-gpio": Node(Kind.GPIO),
        "/dev/pwm*": Node(Kind.PWM),
    },
    connect=connect,
    files=files,
    byte_ns=25_000,  # 9 bits at 400 kHz and a pause (assumed)
)
