"""The computer of a Khepera III, a KoreBot: its I2C bus, pages of its processor's memory, and its files."""

from collections.abc import Mapping, Sequence

from khep_twin.programs.computer import Computer, Devices, i2c_bus, i2c_program
from khep_twin.robots.khepera3.model import ASSETS, KHEPERA_3
from khep_twin.robots.khepera3.registers import CLOCK, DSPIC, MOTORS
from khep_twin.robots.khepera3.robot import Khepera3Robot

_BUS = i2c_bus(sends_empty=True)

_GPIO, _CLOCKS, _PWM = 0x40E00000, 0x41300000, (0x40B00000, 0x40C00000)
"""Pages of the processor PXA255 (data sheet)."""

_READY = 1 << 8
"""Pin 40, the dsPIC's interrupt, among the levels of pins 32 to 63: a reply is always ready."""


def connect(robot: Khepera3Robot) -> Devices:
    """Return the devices of a robot."""
    return Devices({(0, address): device for address, device in robot.bus.devices.items()})


def files(number: int) -> Mapping[str, str]:
    """Return the robot's number, and the devices by which K-Team's library finds them (library)."""
    devices = {"dsPic": DSPIC, "Mot1": MOTORS[0], "Mot2": MOTORS[1], "Rtc": CLOCK}
    lines = [
        f"device {name} {kind} {address:#x}"
        for name, address in devices.items()
        for kind in ("i2c", "module")
    ]
    return {
        "/etc/khepera/robotid": f"{number}\n",
        "/etc/libkorebot/khepera3.knc": "\n".join(
            ["section Khepera3", "modulebus i2c", "modbusaddr 6", *lines, ""]
        ),
    }


COMPUTER = Computer(
    nodes={"/dev/i2c-0": _BUS, "/dev/i2c/0": _BUS},
    connect=connect,
    files=files,
    byte_ns=90_000,  # 9 bits at 100 kHz (an exchange of 31 bytes takes 3 ms in a public program)
    memory={_GPIO + 0x04: _READY, _CLOCKS: 0, _PWM[0]: 0, _PWM[1]: 0},
)


def bus_source(registers: Sequence[int]) -> str:
    """Return C functions that start the robot, read registers, and drive."""
    places = {
        register: (ord(read.request[0]), int(read.request[2:] or 0), 3 + 2 * value)
        for read in KHEPERA_3.dialect.reads.values()
        for register, value in zip(read.registers, read.values, strict=True)
    }
    rows = sorted((*places[register], index) for index, register in enumerate(registers))
    table = ", ".join(str(value) for row in rows for value in row)
    return i2c_program("/dev/i2c-0", f"static unsigned char READS[] = {{{table}}};", ASSETS / "bus.c")
