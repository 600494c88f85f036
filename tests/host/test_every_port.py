"""The same tests for a robot behind khep://, a pseudo-terminal, TCP and RFC 2217."""

import math

import pytest

from khep_twin.errors import MoveError, ProtocolError
from khep_twin.host import Khepera, MotorMode, Sensor, commands

# pyserial calls setDaemon.
pytestmark = pytest.mark.filterwarnings("ignore:set:DeprecationWarning")


@pytest.mark.share(2)
def test_it_returns_its_readings_by_name_and_number(robot: Khepera) -> None:
    light = robot.ambient()
    assert light == (485,) * 8
    assert light.back_left == light[7] == light[Sensor.BACK_LEFT]
    assert robot.proximity()._fields == tuple(sensor.key for sensor in Sensor)
    assert robot.versions().bios == "5.02"


def test_a_move_ends_where_it_was_to_end(robot: Khepera) -> None:
    robot.set_position(0, 0)
    assert robot.move(0.02) == pytest.approx((250, 250), abs=2)
    assert robot.turn(math.pi / 6) == pytest.approx((250 - 170, 250 + 170), abs=3)
    assert robot.turn(-math.pi / 6) == pytest.approx((250, 250), abs=3)
    assert robot.move(-0.02) == pytest.approx((0, 0), abs=3)
    status = robot.status()
    assert status.on_target
    assert status.left.mode is status.right.mode is MotorMode.POSITION


def test_a_move_that_takes_too_long_is_stopped(robot: Khepera) -> None:
    with pytest.raises(MoveError, match=r"not on target after 0.1 s \(left and right wheel\); stopped at"):
        robot.move(0.1, timeout=0.1)
    assert robot.status().left.mode is MotorMode.SPEED
    with pytest.raises(MoveError, match=r"left wheel .* in SPEED mode; expected set_target"):
        robot.wait_for_target()


def test_a_move_farther_than_targets_reach_is_refused(robot: Khepera) -> None:
    robot.set_position(8_388_600, 0)
    with pytest.raises(
        MoveError, match=r"from counters \(83886.*\) to \(8388.*\) pulses; expected a target within"
    ):
        robot.move(0.02)
    robot.set_position(0, 0)


def test_a_burst_is_answered_in_order(robot: Khepera) -> None:
    requests = [
        commands.proximity(),
        commands.set_position(700, -700),
        commands.position(),
        commands.speed(),
    ] * 3
    answers = robot.burst(*requests)
    assert [type(answer).__name__ for answer in answers] == [
        "SensorCounts",
        "NoneType",
        "Positions",
        "Speeds",
    ] * 3
    assert answers[2] == pytest.approx((700, -700), abs=20)


def test_after_noise_the_next_answer_is_right(robot: Khepera) -> None:
    for rubbish in (b"\xff\x00x", b"garbage\ngarbage\n", b"help\n"):
        robot.set_position(1000, -1000)
        robot.port.write(rubbish)
        robot.sleep(0.05)
        assert robot.position() == pytest.approx((1000, -1000), abs=20)
    robot.port.write(b"help\n")
    robot.sleep(0.05)
    robot.set_position(500, 700)
    assert robot.position() == pytest.approx((500, 700), abs=20)


def test_an_order_that_the_robot_refuses_is_reported_with_the_exchange(robot: Khepera) -> None:
    with pytest.raises(ProtocolError, match="'I,9' was answered 'z,Protocol error'; expected"):
        robot.converter(9)
    assert robot.versions() == ("5.02", "5.01")


def test_the_speed_of_the_line_is_found(robot: Khepera) -> None:
    if "khep" not in robot.name:
        pytest.skip("a served twin understands every speed, and has one host at a time")
    with Khepera("khep://default?mode=3", baudrate="auto") as other:
        assert other.port.baudrate == 38400
        assert other.versions().bios == "5.02"
