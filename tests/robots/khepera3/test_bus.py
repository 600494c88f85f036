"""Devices on the bus of a Khepera III in a world: times of echoes, and messages of any kind."""

import random

import pytest

from khep_twin.board.memory import write_number
from khep_twin.playpen import parse
from khep_twin.programs.computer import READ_FLAG, Machine
from khep_twin.robots.khepera3.motor_control import Pic, control_motor, power_up, set_order
from khep_twin.robots.khepera3.registers import CLOCK, DSPIC, MOTORS, ControlType, MotorRegister
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.world import World

PEN = """version = 1
name = "pen"
[arena]
width_mm = 1000
height_mm = 1000
[[robot]]
model = "{}"
x_mm = {}
y_mm = 500
heading_deg = 0"""


def robot_in_pen(x_mm: float = 500, model: str = "khepera3") -> tuple[World, Khepera3Robot]:
    world = World(parse(PEN.format(model, x_mm), "pen"))
    robot = world.robots[0]
    assert isinstance(robot, Khepera3Robot)
    return world, robot


def test_an_echo_from_before_a_reset_of_the_timer_has_the_time_0() -> None:
    world, robot = robot_in_pen()
    world.advance(0.26)
    assert robot.bus.dspic.execute(b"Z") == b"z"
    reply = [*(robot.bus.dspic.ask("G", 3) or ())]  # number of echoes, distance [cm], amplitude, time [ms]
    assert [*reply[:2], reply[3]] == [1, pytest.approx(44, abs=1), 0]
    assert len(robot.bus.dspic.execute(b"G\x03")) == 45


def test_an_unknown_kind_of_battery_value_has_a_reply() -> None:
    assert robot_in_pen()[1].bus.dspic.execute(b"V\x06") == b"v" + bytes(4)


def test_a_program_that_stops_below_20_cm_gets_such_a_reading() -> None:
    world, robot = robot_in_pen(1000 - 56.4 - 192)  # of the front sensor's 56 mm before the axle
    world.reset(seed=1, noise=False)
    world.advance(0.2)
    assert (robot.bus.dspic.ask("G", 3) or ())[:2] == (1, 19)


def test_the_largest_error_of_position_is_a_number_of_32_bits() -> None:
    motor = power_up(1)
    for gain in range(3):
        write_number(motor.memory, MotorRegister.POSITION_GAINS + 2 * gain, 2, 0x7FFF)
    motor.numbers[Pic.POSITION] = -(2**31)
    set_order(motor, ControlType.POSITION.value, 2**31 - 1)
    control_motor(motor)
    assert (motor.numbers[Pic.ERROR], motor.numbers[Pic.PWM]) == (2**31 - 1, 1023)


@pytest.mark.parametrize("model", ["khepera3", "khepera3-firmware2"])
def test_messages_of_any_kind_leave_the_state_in_range_and_a_snapshot_restores_it(model: str) -> None:
    draw, (world, robot) = random.Random(5), robot_in_pen(model=model)
    machine, state = Machine(robot, world), robot._state  # pyright: ignore[reportPrivateUsage]
    for number in range(1500):
        address = draw.choice([DSPIC, *MOTORS, CLOCK])
        message = bytes([draw.choice(b"BCGKNOVZ"), *draw.choices(range(256), k=draw.randrange(5))])
        message = bytes([len(message) + 1]) + message
        if address != DSPIC or draw.random() < 0.2:
            message = draw.randbytes(draw.choice([1, 2, 2, 2, 3, 300]))
            message = bytes([draw.choice([*range(0x28, 0x70), message[0]])]) + message[1:]
        reply = machine.transfer(0, [(address, 0, message), (address, READ_FLAG, bytes(50))], 0)
        assert len(reply) == 50
        if number % 10 == 0:
            world.advance(0.01)
            for motor in (state.left, state.right):
                assert abs(motor.numbers[Pic.PWM]) <= 1023
                assert all(-(2**31) <= value < 2**31 for value in motor.numbers[: Pic.ERROR_SUM])
            assert all(-20 < count < 4096 for count in robot.readings()["proximity"])
    snapshot = world.snapshot()
    world.restore(snapshot)
    assert world.snapshot() == snapshot
