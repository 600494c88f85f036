"""Motor controllers of a Khepera III: closed form, and drives of a robot in a world."""

import math

import numpy as np
import pytest

from khep_twin.playpen import parse
from khep_twin.robots.khepera3.model import KHEPERA_3, KHEPERA_3_V2
from khep_twin.robots.khepera3.motor_control import (
    MotorState,
    Pic,
    control_motor,
    measured_speed,
    power_up,
    set_order,
)
from khep_twin.robots.khepera3.registers import (
    BLOCKED_ERROR,
    PULSES_PER_SPEED,
    STOP_ERROR,
    ControlType,
    Option,
    PicMode,
    Status,
)
from khep_twin.robots.khepera3.registers import MotorRegister as R
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.world import World

PEN = """version = 1
name = "pen"
[arena]
width_mm = 4000
height_mm = 2000
[[robot]]
model = "{}"
x_mm = 1000
y_mm = 1000
heading_deg = 0
"""

INVERTED, PLAIN = Option.INVERTED, 0


def drive(
    model: str = "khepera3", options: tuple[int, int] = (INVERTED, PLAIN)
) -> tuple[World, Khepera3Robot]:
    """Return a world with a robot, and the robot with these options of its motors."""
    world = World(parse(PEN.format(model), "pen"))
    robot = world.robots[0]
    assert isinstance(robot, Khepera3Robot)
    set_all(robot, R.OPTIONS, 1, *options)
    return world, robot


def set_all(robot: Khepera3Robot, register: R, size: int, *values: int) -> None:
    for motor, value in zip(robot.bus.motors, (values[0], values[-1]), strict=True):
        motor.set(register, size, value)


def order(robot: Khepera3Robot, control: ControlType, *values: int) -> None:
    set_all(robot, R.MODE, 1, PicMode.NORMAL)
    set_all(robot, R.CONTROL, 1, control)
    set_all(robot, R.SET_POINT, 4, *values)


def read(robot: Khepera3Robot, register: R, size: int = 4) -> list[int]:
    return [motor.get(register, size) for motor in robot.bus.motors]


# Law of the measured speed --------------------------------------------------------------------------------


@pytest.mark.parametrize("ticks", [65_535, 40_000, 838, 389])
def test_a_speed_is_16776960_divided_by_the_ticks_of_four_pulses(ticks: int) -> None:
    rate = 4 / ((ticks + 0.5) * 1.6e-6)  # pulses/s
    assert measured_speed(rate) == -measured_speed(-rate) == 16_776_960 // ticks


def test_the_slowest_measured_speed_is_256_and_rest_is_0() -> None:
    slowest = 4 / (65_536 * 1.6e-6)
    assert measured_speed(slowest * 1.0001) == 256
    assert measured_speed(slowest * 0.9999) == measured_speed(0.0) == measured_speed(-1e-9) == 0


@pytest.mark.parametrize(
    ("model", "units", "speeds"),
    [(KHEPERA_3_V2, 144.01, {2000: 13.9, 43_000: 298}), (KHEPERA_3, 218.72, {2000: 9.1, 43_000: 196})],
)
def test_units_per_speed_are_those_of_the_manual_for_either_gear(model, units, speeds) -> None:
    mm_per_unit = PULSES_PER_SPEED * math.tau * 1e3 * model.body.wheel_radius / model.body.pulses_per_turn
    assert 1 / mm_per_unit == pytest.approx(units, rel=1e-3)
    for speed, mm_s in speeds.items():
        assert speed * mm_per_unit == pytest.approx(mm_s, rel=6e-3)


# Closed form, without a robot -----------------------------------------------------------------------------


def controller(control: ControlType, value: int, **registers: int) -> MotorState:
    """Return a controller with an order, and registers of one byte by their names."""
    motor = power_up(1)
    for name, content in registers.items():
        motor.memory[R[name]] = content
    set_order(motor, control.value, value)
    return motor


def run(motor: MotorState, n_periods: int) -> None:
    for _ in range(n_periods):
        control_motor(motor)


@pytest.mark.parametrize(("acceleration", "target"), [(30, 15_000), (30, -15_000), (64, 20_000), (255, 100)])
def test_the_ramp_of_a_speed_with_profile_rises_by_ten_units_for_each_one_of_acceleration(
    acceleration: int, target: int
) -> None:
    motor = controller(ControlType.SPEED_PROFILE, target, ACCELERATION=acceleration)
    n_periods = math.ceil(abs(target) / (10 * acceleration))  # 30 to 15,000: half a second
    run(motor, n_periods - 1)
    assert motor.numbers[Pic.RAMP] == math.copysign(10 * acceleration * (n_periods - 1), target)
    run(motor, 2)
    assert motor.numbers[Pic.RAMP] == target


def test_a_speed_order_without_profile_has_a_pwm_of_kp_and_the_sum_of_errors() -> None:
    motor = controller(ControlType.SPEED, 1000)
    for gain, value in zip((R.SPEED_GAINS, R.SPEED_GAINS + 2, R.SPEED_GAINS + 4), (512, 0, 0), strict=True):
        motor.memory[gain], motor.memory[gain + 1] = value & 0xFF, value >> 8
    run(motor, 3)
    assert motor.numbers[Pic.PWM] == 512 * 1000 // 10_240
    motor.memory[R.SPEED_GAINS + 4] = 100
    run(motor, 1)
    before = motor.numbers[Pic.PWM]
    run(motor, 10)
    rise = 10 * (100 * 1000 * 6250 // 1550) / 10_240  # 6250 ticks of 1.6 us are a period
    assert motor.numbers[Pic.PWM] - before == pytest.approx(rise, abs=1)


@pytest.mark.parametrize(("value", "pwm"), [(500, 500), (-500, -500), (32_767, 1023), (-4000, -1023)])
def test_open_loop_sets_the_pwm_up_to_1023(value: int, pwm: int) -> None:
    motor = controller(ControlType.OPEN_LOOP, value)
    run(motor, 1)
    assert motor.numbers[Pic.PWM] == pwm
    assert bool(motor.memory[R.STATUS] & Status.SATURATED) == (abs(pwm) == 1023)


@pytest.mark.parametrize("mode", [PicMode.IDLE, PicMode.SLEEP, 77])
def test_other_modes_than_normal_and_stop_give_no_voltage(mode: int) -> None:
    motor = controller(ControlType.SPEED, 10_000)
    run(motor, 5)
    motor.memory[R.MODE] = mode
    run(motor, 1)
    assert motor.numbers[Pic.PWM] == 0


def blocked(n_periods: int, current: int, options: int) -> MotorState:
    """Return a motor that was held for some periods at a current [mA]."""
    motor = controller(ControlType.SPEED, 10_000, OPTIONS=options)
    motor.numbers[Pic.CURRENT] = current
    run(motor, n_periods)
    return motor


def test_a_blocked_motor_is_switched_off_after_the_blocked_time_until_its_error_is_reset() -> None:
    motor = blocked(10, 501, Option.STOP_WHEN_BLOCKED)
    assert (motor.memory[R.ERRORS], motor.numbers[Pic.PWM] > 0) == (0, True)
    run(motor, 1)
    assert (motor.memory[R.ERRORS], motor.numbers[Pic.PWM]) == (BLOCKED_ERROR, 0)
    motor.numbers[Pic.CURRENT] = 0
    run(motor, 1)
    assert motor.numbers[Pic.PWM] == 0
    motor.memory[R.ERRORS] = 0
    run(motor, 1)
    assert motor.numbers[Pic.PWM] > 0


@pytest.mark.parametrize(("current", "options"), [(500, Option.STOP_WHEN_BLOCKED), (900, PLAIN)])
def test_a_motor_below_its_current_limit_or_without_the_option_is_never_blocked(
    current: int, options: int
) -> None:
    assert blocked(50, current, options).memory[R.ERRORS] == 0


# In a world -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "speed"), [("khepera3", 2000), ("khepera3", -20_000), ("khepera3-firmware2", 43_000)]
)
def test_both_wheels_reach_an_ordered_speed_to_its_resolution(model: str, speed: int) -> None:
    world, robot = drive(model)
    order(robot, ControlType.SPEED, speed)
    world.advance(1.0)
    starts = read(robot, R.POSITION)
    speeds = np.array([read(robot, R.SPEED) for _ in range(20) if world.advance(0.01) is None])
    tolerance = speed * speed / 16_776_960 + 0.02 * abs(speed)
    np.testing.assert_allclose(speeds.mean(axis=0), speed, atol=tolerance)
    ways = np.subtract(read(robot, R.POSITION), starts)
    np.testing.assert_allclose(ways, speed * PULSES_PER_SPEED * 0.2, rtol=0.05, atol=2)


def test_the_left_motor_runs_backwards_without_the_option_of_inversion() -> None:
    world, robot = drive(options=(PLAIN, PLAIN))
    order(robot, ControlType.SPEED, 10_000)
    world.advance(0.5)
    positions = read(robot, R.POSITION)
    assert min(positions + read(robot, R.SPEED)) > 0
    x, y, heading = world.poses[0]
    assert math.hypot(x - 1, y - 1) < 0.002
    assert heading == pytest.approx(
        sum(positions) * 0.03068 / 88.41, rel=0.02
    )  # the manual's factor, and base
    world, robot = drive()
    order(robot, ControlType.SPEED, 10_000)
    world.advance(0.5)
    assert min(read(robot, R.POSITION)) > 0
    assert world.poses[0][0] > 1.015


@pytest.mark.parametrize(
    ("model", "control", "targets"),
    [
        ("khepera3", ControlType.POSITION_PROFILE, (4198, 1)),
        ("khepera3-firmware2", ControlType.POSITION, (-3000, 100)),
    ],
)
def test_a_move_soon_ends_within_the_margin_and_later_exactly_at_its_target(
    model: str, control: ControlType, targets: tuple[int, int]
) -> None:
    world, robot = drive(model)
    order(robot, control, *targets)
    world.advance(3.0)
    np.testing.assert_allclose(read(robot, R.POSITION), targets, atol=6)
    assert all(status & Status.ON_TARGET for status in read(robot, R.STATUS, 1))
    world.advance(7.0)  # a program of a dance waits for both exact positions, without a margin
    assert read(robot, R.POSITION) == [*targets]
    assert read(robot, R.OUTPUT, 2) == [0, 0]


def test_a_move_along_a_profile_takes_the_time_of_its_trapezium() -> None:
    world, robot = drive()
    set_all(robot, R.TOP_SPEED, 2, 15_000)
    set_all(robot, R.ACCELERATION, 1, 30)
    way = 200 / 0.03068  # 200 mm, as in the example program of the manual
    order(robot, ControlType.POSITION_PROFILE, round(way))
    expected = way / (15_000 * PULSES_PER_SPEED) + 15_000 / 30_000
    world.advance(0.9 * expected)
    assert not any(status & Status.ON_TARGET for status in read(robot, R.STATUS, 1))
    world.advance(0.2 * expected)
    assert all(status & Status.ON_TARGET for status in read(robot, R.STATUS, 1))
    assert world.poses[0][0] - 1.0 == pytest.approx(0.200, abs=0.001)


@pytest.mark.parametrize(("sign", "is_error"), [(1, True), (-1, False)])
def test_a_soft_stop_ends_a_motion_past_it_and_as_an_error_all_until_it_is_reset(
    sign: int, is_error: bool
) -> None:
    world, robot = drive()
    stops = Option.STOP_AT_LOWEST | Option.STOP_AT_HIGHEST | (Option.ERROR_AT_STOPS if is_error else 0)
    set_all(robot, R.OPTIONS, 1, INVERTED | stops, stops)
    set_all(robot, R.LOWEST, 4, -2000)
    set_all(robot, R.HIGHEST, 4, 2000)
    order(robot, ControlType.SPEED, 10_000 * sign)
    world.advance(3.0)
    for position in read(robot, R.POSITION):
        assert 2000 < position * sign < 2400
    assert read(robot, R.ERRORS, 1) == [STOP_ERROR * is_error] * 2
    order(robot, ControlType.SPEED, -10_000 * sign)
    world.advance(0.5)
    assert (abs(read(robot, R.POSITION)[0]) < 2000) == (not is_error)
    set_all(robot, R.ERRORS, 1, 0)
    world.advance(0.5)
    assert abs(read(robot, R.POSITION)[0]) < 2000


def test_mode_stop_holds_the_position_at_its_order() -> None:
    world, robot = drive()
    order(robot, ControlType.SPEED, 10_000)
    world.advance(0.5)
    positions = read(robot, R.POSITION)
    set_all(robot, R.MODE, 1, PicMode.STOP)
    world.advance(1.0)
    np.testing.assert_allclose(read(robot, R.POSITION), positions, atol=12)  # two margins
    assert read(robot, R.SPEED) == [0, 0]


def test_counting_one_edge_of_the_encoder_gives_a_quarter_of_the_pulses() -> None:
    ways: list[int] = []
    for options in (0, 8):
        world, robot = drive()
        set_all(robot, R.HARDWARE_OPTIONS, 1, options)
        order(robot, ControlType.OPEN_LOOP, 500)
        world.advance(1.0)
        ways.append(read(robot, R.POSITION)[0])
    assert ways[1] == pytest.approx(ways[0] / 4, abs=1)
