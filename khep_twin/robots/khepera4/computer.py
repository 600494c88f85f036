"""The computer of a Khepera IV: the dsPIC on its bus, its pins and files; C functions for its programs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from khep_twin.programs.computer import PINS, PWM, Computer, Devices, i2c_bus, i2c_program
from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.registers import ADDRESS
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.robots.khepera4.state import WORDS

RESET_PIN, CHARGER_PIN = 90, 65
"""Pins: 0 holds the dsPIC in reset; 0 while the charger is plugged in (library)."""


class DspicSlave:
    """A dsPIC on the bus: a write names the register at which reads begin."""

    def __init__(self, dspic: Dspic) -> None:
        self._dspic, self._next_register, self._is_held = dspic, 0, False

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
            if self._is_held:
                self._dspic.reset()


def connect(robot: Khepera4Robot) -> Devices:
    """Return the devices of a robot."""
    slave = DspicSlave(robot.dspic)
    return Devices({(0, ADDRESS): slave}, {CHARGER_PIN: 1, RESET_PIN: 1}, slave.set_pin)


def files(number: int) -> Mapping[str, str]:
    """Return the robot's number, and the file by which K-Team's library finds the dsPIC."""
    knc = f"section Khepera4\ndevice dsPic i2c {ADDRESS:#x}\n"
    return {"/etc/khepera/robotid": f"{number}\n", "/etc/libkhepera/khepera4.knc": knc}


COMPUTER = Computer(
    nodes={"/dev/i2c-*": i2c_bus(), "/dev/user-gpio": PINS, "/dev/pwm*": PWM},
    connect=connect,
    files=files,
    byte_ns=25_000,  # 9 bits at 400 kHz and a pause (assumed)
)


def bus_source(registers: Sequence[int]) -> str:
    """Return C functions that start the robot, read registers of 2 bytes, and drive."""
    places = [first + number * stride for first, _, _, stride, count in WORDS for number in range(count)]
    reads: list[list[int]] = []
    for place in map(places.__getitem__, registers):
        if reads and reads[-1][0] + 2 * reads[-1][1] == place:
            reads[-1][1] += 1
        else:
            reads.append([place, 1])
    table = ", ".join(f"{place}, {count}" for place, count in reads)
    source = Path(__file__).with_name("assets") / "bus.c"
    return i2c_program("/dev/i2c-2", f"static unsigned char READS[] = {{{table}}};", source)
