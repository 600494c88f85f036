"""The board's arithmetic, on a wheel that follows its duty in a known way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.board import kernel
from khep_twin.board.kernel import LEFT, N_REGISTERS, RIGHT, Board, Wheel
from khep_twin.units import DUTY_LIMIT


@pytest.fixture(params=["array", "memoryview"])
def registers(request: pytest.FixtureRequest) -> kernel.Registers:
    """A board after a reset, as both kinds of memory that the kernel takes."""
    array = np.zeros(N_REGISTERS, np.int64)
    kernel.reset(array.data)
    return array if request.param == "array" else array.data


class Motor:
    """A wheel whose speed follows the duty with a lag: 143 pulses/10 ms at full duty, 50 ms."""

    def __init__(self) -> None:
        self.speed = self.place = 0.0

    def follow(self, duty: int) -> int:
        self.speed += (duty * 143 / DUTY_LIMIT - self.speed) * 0.18
        self.place += self.speed
        return int(self.place // 1)


def drive(registers: kernel.Registers, ticks: int, motor: Motor | None = None) -> list[int]:
    """Runs the left controller on a motor; returns the speed of each tick."""
    motor, speeds = motor or Motor(), []
    for _ in range(ticks):
        kernel.tick(registers, motor.follow(registers[LEFT + Wheel.DUTY]), 0)
        speeds.append(registers[LEFT + Wheel.SPEED])
    return speeds


def test_a_reset_sets_the_manuals_values(registers: kernel.Registers) -> None:
    gains = [registers[register] for register in range(Board.SPEED_KP, Board.POSITION_KD + 1)]
    assert gains == [3800, 800, 100, 3000, 20, 4000]
    for wheel in (LEFT, RIGHT):
        assert (registers[wheel + Wheel.MAX_SPEED], registers[wheel + Wheel.ACCELERATION]) == (20, 64)


def test_a_reset_leaves_the_encoders_where_they_are(registers: kernel.Registers) -> None:
    registers[LEFT + Wheel.ENCODER] = 77
    kernel.reset(registers)
    kernel.tick(registers, 78, 0)
    assert registers[LEFT + Wheel.SPEED] == 1


def test_the_plain_indices_are_those_of_the_enums() -> None:
    for register in Wheel:
        assert getattr(kernel, f"_{register.name}") == register


@pytest.mark.parametrize("setpoint", [1, 5, 20, -10])
def test_the_speed_controller_settles_on_its_setpoint(registers: kernel.Registers, setpoint: int) -> None:
    kernel.set_speed(registers, LEFT, setpoint)
    speeds = drive(registers, 200)
    assert np.mean(speeds[50:]) == pytest.approx(setpoint, abs=0.05)
    assert abs(speeds[19] - setpoint) <= 1


def test_gains_act(registers: kernel.Registers) -> None:
    kernel.set_speed(registers, LEFT, 20)
    slow = drive(registers, 3)
    kernel.reset(registers)
    registers[LEFT + Wheel.ENCODER] = 0
    registers[Board.SPEED_KP] = 7600
    kernel.set_speed(registers, LEFT, 20)
    assert drive(registers, 3)[2] > 1.3 * slow[2]


def test_the_counter_wraps_at_32_bits(registers: kernel.Registers) -> None:
    kernel.set_position(registers, LEFT, 2**31 - 1)
    kernel.tick(registers, 3, 0)
    assert registers[LEFT + Wheel.POSITION] == -(2**31) + 2


def test_the_trapezoid_reaches_full_speed_after_800_pulses(registers: kernel.Registers) -> None:
    kernel.set_target(registers, LEFT, 5000)
    motor, ticks = Motor(), 0
    while registers[LEFT + Wheel.PROFILE_SPEED] < 20 * 256:
        kernel.tick(registers, motor.follow(registers[LEFT + Wheel.DUTY]), 0)
        ticks += 1
    assert ticks == 80
    assert registers[LEFT + Wheel.PROFILE_POSITION] / 256 == pytest.approx(800, abs=10)


@given(
    st.integers(-(2**23), 2**23),
    st.integers(-20_000, 20_000),
    st.integers(0, 127),
    st.integers(1, 65535),
)
def test_the_profile_ends_on_its_target(start: int, way: int, speed: int, acceleration: int) -> None:
    registers = np.zeros(N_REGISTERS, np.int64).data
    kernel.reset(registers)
    kernel.set_position(registers, LEFT, start)
    registers[LEFT + Wheel.MAX_SPEED] = speed
    registers[LEFT + Wheel.ACCELERATION] = acceleration
    kernel.set_target(registers, LEFT, start + way)
    # No motor: the profile runs by itself, for way / speed and two ramps, with some ticks for rounding.
    cruise = max(speed, 1)
    ramp = min(cruise * 256 / acceleration, (abs(way) * 256 / acceleration) ** 0.5)
    for _ in range(int(abs(way) / cruise + 2 * ramp) + 60):
        old_speeds = registers[LEFT + Wheel.PROFILE_SPEED]
        kernel.tick(registers, 0, 0)
        assert abs(registers[LEFT + Wheel.PROFILE_SPEED] - old_speeds) <= acceleration
    if speed or not way:
        assert registers[LEFT + Wheel.PROFILE_POSITION] == (start + way) * 256
        assert registers[LEFT + Wheel.PROFILE_SPEED] == 0


def test_a_target_behind_turns_the_profile_around(registers: kernel.Registers) -> None:
    kernel.set_target(registers, LEFT, 5000)
    motor = Motor()
    drive(registers, 120, motor)
    kernel.set_target(registers, LEFT, 0)
    highest = 0.0
    for _ in range(400):
        drive(registers, 1, motor)
        highest = max(highest, registers[LEFT + Wheel.PROFILE_POSITION] / 256)
    # At 20 pulses/tick it needs 800 pulses to stop, and is never thrown about.
    assert highest == pytest.approx(1600 + 800, abs=60)
    assert registers[LEFT + Wheel.POSITION] == pytest.approx(0, abs=2)
    assert registers[LEFT + Wheel.ON_TARGET] == 1


def test_renumbering_a_position_moves_nothing(registers: kernel.Registers) -> None:
    kernel.set_target(registers, LEFT, 1000)
    motor = Motor()
    drive(registers, 200, motor)
    kernel.set_position(registers, LEFT, 0)
    drive(registers, 50, motor)
    assert registers[LEFT + Wheel.POSITION] == pytest.approx(0, abs=2)


def test_a_fixed_duty_is_left_alone(registers: kernel.Registers) -> None:
    kernel.set_duty(registers, LEFT, 100)
    assert drive(registers, 100)[-1] == pytest.approx(56, abs=1)
    assert registers[LEFT + Wheel.DUTY] == 100


def test_the_scan_goes_round(registers: kernel.Registers) -> None:
    for turn in range(9):
        kernel.convert(registers, 10 + turn, 100 + turn)
    assert [registers[register] for register in kernel.PROXIMITY] == [18, 11, 12, 13, 14, 15, 16, 17]
    assert next(registers[register] for register in kernel.AMBIENT) == 108
    assert registers[Board.SCAN] == 1


@given(st.integers(-(10**12), 10**12), st.integers(-(10**6), 10**6).filter(bool))
def test_division_cuts_towards_zero(numerator: int, denominator: int) -> None:
    quotient = kernel.divide(numerator, denominator)
    rest = numerator - quotient * denominator
    assert abs(rest) < abs(denominator)
    assert rest == 0 or (rest < 0) == (numerator < 0)


@given(st.integers(-(2**40), 2**40))
def test_wrapping_keeps_the_low_32_bits(value: int) -> None:
    wrapped = kernel.wrap(value)
    assert -(2**31) <= wrapped < 2**31
    assert (wrapped - value) % 2**32 == 0


@pytest.mark.parametrize("setpoint", [1, 5, 20, -7])
def test_a_blocked_wheel_gets_the_duty_of_the_closed_form(registers: kernel.Registers, setpoint: int) -> None:
    kernel.set_speed(registers, LEFT, setpoint)
    for tick in range(1, 400):
        kernel.tick(registers, 0, 0)
        # The error stays e: P gives Kp e, I grows by Ki e a tick, D acts on the first tick only.
        drive = 3800 * setpoint + 800 * setpoint * tick + (100 * setpoint if tick == 1 else 0)
        expected = min(abs(drive) // kernel.SPEED_GAIN_SCALE, DUTY_LIMIT) * (1 if setpoint > 0 else -1)
        assert registers[LEFT + Wheel.DUTY] == expected, tick
    assert registers[LEFT + Wheel.ERROR] == setpoint


@pytest.mark.parametrize("blocked_ticks", [100, 10_000])
def test_a_wheel_let_loose_finds_its_speed_however_long_it_was_blocked(
    registers: kernel.Registers, blocked_ticks: int
) -> None:
    kernel.set_speed(registers, LEFT, 20)
    for _ in range(blocked_ticks):
        kernel.tick(registers, 0, 0)
    speeds = drive(registers, 200)
    # The sum stops at what full duty needs, so that it is worked off within a second.
    assert registers[LEFT + Wheel.ERROR_SUM] <= DUTY_LIMIT * kernel.SPEED_GAIN_SCALE // 800
    assert speeds[100:] == pytest.approx([20] * 100, abs=2)


def test_a_setpoint_beyond_the_motor_is_full_duty_and_the_error_shows(registers: kernel.Registers) -> None:
    registers[LEFT + Wheel.ENCODER] = 0
    kernel.set_speed(registers, LEFT, 127)
    pulses = 0
    for _ in range(500):
        pulses += 100  # as fast as it gets
        kernel.tick(registers, pulses, 0)
    assert registers[LEFT + Wheel.DUTY] == DUTY_LIMIT
    assert registers[LEFT + Wheel.ERROR] == 27


def test_a_wheel_blocked_on_its_way_never_arrives_and_the_error_is_the_distance_left(
    registers: kernel.Registers,
) -> None:
    kernel.set_target(registers, LEFT, 1000)
    for _ in range(300):
        kernel.tick(registers, 0, 0)
    assert registers[LEFT + Wheel.ON_TARGET] == 0
    assert registers[LEFT + Wheel.ERROR] == 1000
    assert registers[LEFT + Wheel.DUTY] == DUTY_LIMIT


@pytest.mark.parametrize(
    ("target", "speed", "acceleration"), [(1000, 20, 64), (3000, 20, 64), (-1000, 20, 64), (5000, 50, 128)]
)
def test_the_trapezoid_takes_the_time_of_the_closed_form(
    registers: kernel.Registers, target: int, speed: int, acceleration: int
) -> None:
    registers[LEFT + Wheel.MAX_SPEED], registers[LEFT + Wheel.ACCELERATION] = speed, acceleration
    kernel.set_target(registers, LEFT, target)
    ticks, peak = 0, 0
    while registers[LEFT + Wheel.PROFILE_POSITION] != target * 256:
        kernel.tick(registers, registers[LEFT + Wheel.PROFILE_POSITION] // 256, 0)
        ticks, peak = ticks + 1, max(peak, abs(registers[LEFT + Wheel.PROFILE_SPEED]))
    a, way = acceleration / 256, abs(target)
    top = min(speed, (way * a) ** 0.5)
    assert peak / 256 == pytest.approx(top, abs=a + 0.01)
    # Up and down at a, the rest at the top speed [ticks].
    assert ticks == pytest.approx(2 * top / a + (way - top * top / a) / top, abs=4)


def profile(registers: kernel.Registers, ticks: int) -> tuple[list[float], list[float]]:
    """Places [pulses] and speeds [pulses/10 ms] of the left wheel's profile, which the wheel follows."""
    places, speeds = [], []
    for _ in range(ticks):
        kernel.tick(registers, registers[LEFT + Wheel.ENCODER] + round(registers[LEFT + Wheel.ERROR]), 0)
        places.append(registers[LEFT + Wheel.PROFILE_POSITION] / 256)
        speeds.append(registers[LEFT + Wheel.PROFILE_SPEED] / 256)
    return places, speeds


@pytest.mark.parametrize("distance", [-1000, -25, 0, 25, 100, 799, 801, 3000])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_new_target_never_brakes_or_pushes_harder_than_j_allows(
    registers: kernel.Registers, distance: int, sign: int
) -> None:
    kernel.set_target(registers, LEFT, sign * 5000)
    places, old_speeds = profile(registers, 120)
    target = int(places[-1]) + sign * distance
    kernel.set_target(registers, LEFT, target)
    places, speeds = profile(registers, 600)
    steps = np.abs(np.diff([old_speeds[-1], *speeds]))
    assert steps.max() <= 0.25
    assert places[-1] == target
    assert speeds[-1] == 0
    # Where 20 pulses/tick cannot be stopped in time, it runs 800 pulses on and comes back.
    farthest = max(sign * place for place in places)
    assert farthest == pytest.approx(max(sign * target, sign * (target - sign * distance) + 790), abs=25)


@pytest.mark.parametrize(
    ("speed", "acceleration", "target"),
    [(20, 64, 3000), (127, 640, 5000), (100, 512, 3000), (20, 1, 50), (80, 128, 2096)],
)
def test_every_move_keeps_to_its_acceleration_and_ends_on_its_target(
    registers: kernel.Registers, speed: int, acceleration: int, target: int
) -> None:
    registers[LEFT + Wheel.MAX_SPEED], registers[LEFT + Wheel.ACCELERATION] = speed, acceleration
    kernel.set_target(registers, LEFT, target)
    places, speeds = profile(registers, 1000)
    assert np.abs(np.diff([0.0, *speeds])).max() <= acceleration / 256
    assert places[-1] == target
    assert max(places) == target


def test_a_counter_that_wraps_in_mid_move_sends_nothing_astray(registers: kernel.Registers) -> None:
    kernel.set_target(registers, LEFT, 600)
    profile(registers, 40)
    kernel.set_position(registers, LEFT, 2**31 - 48)
    profile(registers, 200)
    assert registers[LEFT + Wheel.POSITION] < 0
    kernel.set_position(registers, LEFT, 0)
    kernel.set_target(registers, LEFT, 100)
    profile(registers, 200)
    assert registers[LEFT + Wheel.POSITION] == pytest.approx(100, abs=2)
    assert registers[LEFT + Wheel.ON_TARGET] == 1


def test_a_wheel_that_is_pushed_off_its_target_is_on_target_no_more(registers: kernel.Registers) -> None:
    kernel.set_target(registers, LEFT, 0)
    kernel.tick(registers, 0, 0)
    kernel.tick(registers, 0, 0)
    assert registers[LEFT + Wheel.ON_TARGET] == 1
    kernel.tick(registers, 50, 0)
    assert registers[LEFT + Wheel.ON_TARGET] == 0
    kernel.tick(registers, 1, 0)
    kernel.tick(registers, 1, 0)
    assert registers[LEFT + Wheel.ON_TARGET] == 1
