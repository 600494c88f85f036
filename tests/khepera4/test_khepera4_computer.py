"""The computer of a Khepera IV: its dsPIC on the bus, its pins and files."""

import pytest

from khep_twin.programs.computer import READ_FLAG, Machine
from khep_twin.robots.khepera4.computer import CHARGER_PIN, COMPUTER, RESET_PIN
from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.khepera4.registers import ADDRESS, DspicRegister


class PlainClock:
    """A clock without a world."""

    time_ns = 0

    def advance_to(self, time_ns: int) -> None:
        """Advance."""
        self.time_ns = time_ns


class DspicRobot:
    """The part of a robot that is on the bus."""

    robot_model = KHEPERA_4

    def __init__(self) -> None:
        self.dspic = Dspic()


def machine_of(robot: DspicRobot) -> Machine:
    return Machine(robot, PlainClock())  # type: ignore[arg-type]


def test_a_read_begins_at_the_register_of_the_last_write_of_any_program() -> None:
    machine, gains = machine_of(DspicRobot()), bytes([1, 2, 3])
    machine.transfer(0, [(ADDRESS, 0, bytes([DspicRegister.KP]) + gains)], 0)
    assert machine.transfer(0, [(ADDRESS, READ_FLAG, bytes(3))], 0) == gains
    assert machine.transfer(0, [(ADDRESS, 0, b""), (ADDRESS, READ_FLAG, bytes(1))], 0) == gains[:1]


def test_the_reset_pin_resets_and_holds_the_dspic_at_0_only() -> None:
    robot = DspicRobot()
    machine = machine_of(robot)
    assert (machine.pin(CHARGER_PIN), machine.pin(RESET_PIN), machine.pin(3)) == (1, 1, 0)
    robot.dspic.write(bytes([DspicRegister.KP, 99]))
    for pin, level in ((3, 0), (RESET_PIN, 1)):
        machine.set_pin(pin, level)
    assert robot.dspic.read(DspicRegister.KP, 1) == bytes([99])
    machine.set_pin(RESET_PIN, 0)
    with pytest.raises(OSError, match="no device has answered"):
        machine.transfer(0, [(ADDRESS, 0, b"abc")], 0)
    machine.set_pin(RESET_PIN, 1)
    assert (
        machine.transfer(0, [(ADDRESS, 0, bytes([DspicRegister.KP])), (ADDRESS, READ_FLAG, b"x")], 0) == b"\n"
    )


def test_a_byte_takes_25_us_and_files_have_the_robots_number_and_the_address() -> None:
    assert COMPUTER.byte_ns == 25_000
    assert COMPUTER.files(42) == {
        "/etc/khepera/robotid": "42\n",
        "/etc/libkhepera/khepera4.knc": "section Khepera4\ndevice dsPic i2c 0x30\n",
    }
