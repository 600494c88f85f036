"""Devices on the bus of a Khepera III, to the byte: frames of the dsPIC, registers of motor controllers."""

import random

import pytest
from test_letters import PROXIMITY, Robot, robot

from khep_twin.robots.khepera3 import state
from khep_twin.robots.khepera3.motor_control import Pic, control_motor
from khep_twin.robots.khepera3.registers import CLOCK, DSPIC, MOTORS
from khep_twin.robots.khepera3.registers import MotorRegister as R

VALUES = b"".join(value.to_bytes(2, "little", signed=True) for value in PROXIMITY)

FRAMES = {
    b"\x02B": b"b\x03\0\0\0",
    b"\x05C\x00\x00\x1f": b"c",
    # One echo of 27 cm, amplitude 2900, time 100,000; noise 1800: the manual's example.
    b"\x03G\x03": b"g\x01\0\x1b\0\x54\x0b\xa0\x86\x01\0" + bytes(32) + b"\x08\x07",
    b"\x04K\x00\x01": b"k",
    b"\x02N": b"n" + VALUES + b"\xe8\x03\0\0",
    b"\x02O": b"o" + bytes(22) + b"\xe8\x03\0\0",
    b"\x03V\x00": b"v\x08\0\xd0\x07",  # 8.2 V
    b"\x02Z": b"z",
}
"""Letter and data of the reply to each command."""

N_BYTES = {"B": 5, "C": 1, "G": 45, "K": 1, "N": 27, "O": 27, "V": 5, "Z": 1}
"""Number of these bytes, which is the first byte of a frame (library)."""


@pytest.fixture
def robot3() -> Robot:
    khepera3 = robot()
    khepera3.set_proximity(PROXIMITY)
    khepera3.state.board[state.SCAN_MS] = 1000
    return khepera3


@pytest.mark.parametrize("command", FRAMES)
def test_a_frame_is_read_in_two_parts_by_the_library_and_at_once_by_the_toolbox(
    command: bytes, robot3: Robot
) -> None:
    dspic, reply = robot3.bus.dspic, FRAMES[command]
    dspic.write(command)
    count = dspic.read(1)[0]
    assert (count, dspic.read(count)) == (N_BYTES[chr(command[1])], reply)
    assert dspic.read(3) == bytes(3)
    dspic.write(command)
    assert dspic.read(2 + count) == bytes([count, 0]) + reply


def test_a_command_drops_the_unread_rest_of_a_frame(robot3: Robot) -> None:
    dspic = robot3.bus.dspic
    for command in (b"\x02N", b"\x02B"):
        dspic.write(command)
    assert dspic.read(30) == b"\x05\0" + FRAMES[b"\x02B"] + bytes(23)


@pytest.mark.parametrize("message", [b"\x03B", b"\x01", b"\x02", b"\x00B", b"B", b"\x02BB", b"\xff" * 40])
def test_a_message_of_another_length_than_it_says_has_no_effect(message: bytes, robot3: Robot) -> None:
    dspic = robot3.bus.dspic
    dspic.write(b"\x02B")
    dspic.write(message)
    assert dspic.read(7) == b"\x05\0" + FRAMES[b"\x02B"]


@pytest.mark.parametrize(
    "message", [b"\x02b", b"\x02D", b"\x02$", b"\x02G", b"\x03G\x00", b"\x03G\x06", b"\x02C"]
)
def test_an_unknown_or_incomplete_command_has_an_empty_frame(message: bytes, robot3: Robot) -> None:
    robot3.bus.dspic.write(b"\x02N")
    robot3.bus.dspic.write(message)
    assert robot3.bus.dspic.read(29) == bytes(29)


def test_a_setting_is_written_with_its_high_byte_first_and_the_toolbox_sets_the_number_of_echoes(
    robot3: Robot,
) -> None:
    for command in (b"\x05C\x05\x01\x02", b"\x05C\xfe\x00\x05", b"\x05C\x09\x00\x01"):
        robot3.bus.dspic.write(command)
    assert robot3.state.board[state.SETTING :].tolist() == [4, 5, 0, 0, 0xFFFF, 0x102, 1]


def test_each_order_of_an_led_sets_its_state(robot3: Robot) -> None:
    for order, states in ((1, [1, 0]), (2, [0, 0]), (2, [1, 0]), (0, [0, 0])):
        robot3.bus.dspic.write(bytes([4, ord("K"), 0, order]))
        assert robot3.state.board[state.LEDS :][:2].tolist() == states
    robot3.bus.dspic.write(b"\x04K\x01\x01")
    assert robot3.state.board[state.LEDS :][:2].tolist() == [0, 1]


@pytest.mark.parametrize(
    ("register", "size", "number"),
    [
        (R.POSITION, 4, Pic.POSITION),
        (R.SPEED, 4, Pic.SPEED),
        (R.CURRENT, 2, Pic.CURRENT),
    ],
)
def test_the_highest_byte_of_a_measured_number_latches_the_others(
    register: R, size: int, number: Pic, robot3: Robot
) -> None:
    motor, numbers = robot3.bus.motors[0], robot3.state.left.numbers
    numbers[number] = -2
    motor.write(bytes([register + size - 1]))
    content = motor.read(1)
    numbers[number] = 0x1234  # the wheel turns on between two messages
    for byte in range(size - 2, -1, -1):
        motor.write(bytes([register + byte]))
        content += motor.read(1)
    assert int.from_bytes(content, "big", signed=True) == -2
    assert motor.get(register, size) == 0x1234


def test_a_set_point_is_in_force_with_its_lowest_byte(robot3: Robot) -> None:
    motor, numbers = robot3.bus.motors[1], robot3.state.right.numbers
    for byte, value in ((3, 0xFF), (2, 0xFF), (1, 0xB1)):
        motor.write(bytes([R.SET_POINT + byte, value]))
        assert numbers[Pic.SET_POINT] == 0
    motor.write(bytes([R.SET_POINT, 0xE0]))
    assert numbers[Pic.SET_POINT] == -20_000


def test_a_message_sets_one_byte_and_a_read_repeats_the_byte_of_the_last_register(robot3: Robot) -> None:
    motor = robot3.bus.motors[0]
    motor.write(bytes([R.MARGIN, 9, 8, 7]))
    assert (motor.read(3), motor.get(R.POSITION_GAINS, 2)) == (b"\x09\x09\x09", 600)


def test_a_written_position_is_the_one_that_is_read(robot3: Robot) -> None:
    motor = robot3.bus.motors[0]
    motor.set(R.POSITION, 4, -123_456)
    assert motor.get(R.POSITION, 4) == -123_456


@pytest.mark.parametrize("register", [R.VERSION, R.STATUS, R.SPEED, R.LEAST_SAMPLE_TIME, R.CURRENT, R.OUTPUT])
def test_a_measured_number_cannot_be_written(register: R, robot3: Robot) -> None:
    motor = robot3.bus.motors[0]
    motor.write(bytes([register]))
    before = motor.read(1)
    motor.write(bytes([register, 0x55]))
    assert motor.read(1) == before


def test_a_reset_restores_the_settings_and_keys_save_nothing(robot3: Robot) -> None:
    motor = robot3.bus.motors[0]
    motor.set(R.SPEED_GAINS, 2, 99)
    for mode in (0x55, 0xAA, 5):
        motor.write(bytes([R.MODE, mode]))
    assert (motor.read(1), motor.get(R.SPEED_GAINS, 2)) == (b"\0", 99)
    motor.write(bytes([R.MODE, 4]))
    assert (motor.read(1), motor.get(R.SPEED_GAINS, 2), motor.get(R.VERSION, 1)) == (b"\0", 620, 0x68)


def test_the_clock_counts_from_the_start_in_decimal_digits(robot3: Robot) -> None:
    robot3.bus.dspic.time_ms = lambda: 1000 * (23 * 3600 + 45 * 60 + 6)
    clock = robot3.bus.devices[CLOCK]
    clock.write(b"\0")
    assert clock.read(4) == b"\x06\x45\x23\0"
    clock.write(b"\x01")
    assert clock.read(1) == b"\x45"


def test_no_message_raises_an_error_and_a_read_has_its_length(robot3: Robot) -> None:
    assert sorted(robot3.bus.devices) == sorted([DSPIC, *MOTORS, CLOCK])
    draw = random.Random(3)
    for _ in range(3000):
        device = robot3.bus.devices[draw.choice([DSPIC, *MOTORS, CLOCK])]
        count = draw.randrange(1, 8)
        device.write(bytes([count, *draw.randbytes(count - 1)]) if draw.random() < 0.5 else draw.randbytes(4))
        length = draw.randrange(60)
        assert len(device.read(length)) == length
        if draw.random() < 0.1:
            control_motor(robot3.state.left)
