"""The dsPIC of the Khepera IV: its registers, and its motors against recordings and the manual's figures."""

import pytest
from dspic_words import set_words

from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.motor_control import PWM_LIMIT
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.world import World


class Driven:
    """A Khepera IV on the floor of its arena."""

    def __init__(self) -> None:
        self.world = World("arena4", noise=False)
        self.robot = self.world.robots[0]
        assert isinstance(self.robot, Khepera4Robot)
        self.dspic = self.robot.dspic

    def run(self, ticks: int) -> list[int]:
        """Return the left wheel's speed after each control period [pulses/10 ms]."""
        speeds: list[int] = []
        for _ in range(ticks):
            self.world.advance(0.01)
            speeds.append(speed_of(self.dspic))
        return speeds


def speed_of(dspic: Dspic) -> int:
    return int.from_bytes(dspic.read(DspicRegister.SPEED_LEFT, 2), "little", signed=True)


def little_endian(value: int, size: int = 2) -> bytes:
    return value.to_bytes(size, "little", signed=True)


def driven(gains: tuple[int, int, int], control: Control, order: int) -> Driven:
    """Return a robot that turns in place, which may take long without reaching a wall."""
    robot = Driven()
    robot.dspic.write(bytes([DspicRegister.KP, *gains]))
    robot.dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + little_endian(order) + little_endian(-order))
    robot.dspic.write(bytes([DspicRegister.CONTROL, control]))
    return robot


@pytest.mark.parametrize(("gains", "settled"), [((10, 0, 0), 199), ((40, 0, 0), 370), ((10, 1, 0), 500)])
def test_a_speed_settles_where_a_real_robots_does(gains: tuple[int, int, int], settled: int) -> None:
    assert driven(gains, Control.SPEED, 500).run(400)[-1] == pytest.approx(settled, rel=0.1)


def test_a_strong_integral_overshoots_as_a_real_robots_does() -> None:
    speeds = driven((10, 10, 0), Control.SPEED, 500).run(400)
    assert max(speeds) == pytest.approx(750, rel=0.1)
    assert speeds[-1] == pytest.approx(500, rel=0.02)


def test_the_control_type_in_force_keeps_the_controller() -> None:
    """The server writes it with each D, and a host may send one in each of its cycles of 20 ms."""
    once, repeatedly = (driven((10, 5, 1), Control.SPEED, 500) for _ in range(2))
    for _ in range(50):
        once.run(2)
        repeatedly.dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))
        repeatedly.run(2)
    assert speed_of(repeatedly.dspic) == speed_of(once.dspic) == pytest.approx(500, rel=0.1)
    repeatedly.dspic.write(bytes([DspicRegister.CONTROL, Control.IDLE]))
    assert repeatedly.dspic.pwm == (0, 0)


def test_a_profile_holds_its_least_speed_and_rises_by_its_acceleration() -> None:
    wheels = driven((10, 5, 1), Control.SPEED_PROFILE, 400)
    seconds = 1.27 + 0.07  # 380 steps of 3 in 10 ms, behind the hold
    assert wheels.run(round(100 * seconds))[-1] < 400
    assert wheels.run(60)[-1] == pytest.approx(400, rel=0.05)
    wheels.dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + little_endian(0) * 2)
    assert wheels.run(200)[-1] == pytest.approx(0, abs=2)


def test_a_move_of_70000_pulses_takes_as_long_as_in_the_manual() -> None:
    wheels = Driven()
    dspic = wheels.dspic
    dspic.write(
        bytes([DspicRegister.POSITION_ORDER_LEFT]) + little_endian(70_000, 4) + little_endian(-70_000, 4)
    )
    dspic.write(bytes([DspicRegister.CONTROL, Control.POSITION]))
    ticks = 0
    while dspic.read(DspicRegister.ON_TARGET, 1) != bytes([0b11]):
        wheels.run(1)
        ticks += 1
        assert ticks < 1000
    assert ticks * 0.010 == pytest.approx(3.05, rel=0.05)
    wheels.run(200)
    for register, target in ((DspicRegister.POSITION_LEFT, 70_000), (DspicRegister.POSITION_RIGHT, -70_000)):
        position = int.from_bytes(dspic.read(register, 4), "little", signed=True)
        assert position == pytest.approx(target, abs=40)


def test_a_short_move_begins_where_a_long_one_has_ended() -> None:
    wheels = Driven()
    dspic = wheels.dspic
    dspic.write(bytes([DspicRegister.CONTROL, Control.POSITION]))
    for target in (3000, 3050):
        dspic.write(bytes([DspicRegister.POSITION_ORDER_LEFT]) + little_endian(target, 4) * 2)
        assert max(wheels.run(20)) > 5
        wheels.run(280)
        assert dspic.read(DspicRegister.ON_TARGET, 1) == bytes([0b11])


def test_open_loop_control_clips_the_pwm() -> None:
    dspic = Dspic()
    dspic.write(bytes([DspicRegister.PWM_ORDER_LEFT]) + little_endian(1000) + little_endian(-9000))
    dspic.write(bytes([DspicRegister.CONTROL, Control.OPEN_LOOP]))
    assert dspic.tick(0, 0) == (1000, -PWM_LIMIT)
    dspic.write(bytes([DspicRegister.CONTROL, Control.IDLE]))
    assert dspic.tick(0, 0) == (0, 0)


def test_a_read_continues_through_the_map_and_ends_with_zeros() -> None:
    dspic = Dspic()
    set_words(dspic, DspicRegister.PROXIMITY, range(100, 112))
    content = dspic.read(DspicRegister.AMBIENT, 48)
    assert content[:24] == bytes(24)
    assert [int.from_bytes(content[at : at + 2], "little") for at in range(24, 48, 2)] == list(
        range(100, 112)
    )
    for index in range(12):
        dspic.state.memory[DspicRegister.BATTERY + index] = index
    assert dspic.read(DspicRegister.BATTERY, 16) == bytes([*range(12), 0, 0, 0, 0])


def test_read_only_registers_stay_and_a_reset_restores_the_others() -> None:
    dspic = Dspic()
    before = dspic.read(0, 256)
    dspic.write(bytes([DspicRegister.SPEED_LEFT, 1, 2, 3, 4]))
    dspic.write(bytes([DspicRegister.REVISION, 0xFF]))
    dspic.write(b"")
    assert dspic.read(0, 256) == before
    dspic.write(bytes([DspicRegister.LEDS, *range(9)]))
    assert dspic.leds == bytes(range(9))
    dspic.write(bytes([DspicRegister.ULTRASONIC_ENABLED, 0b101]))
    assert dspic.read(DspicRegister.ULTRASONIC_ENABLED, 1) == bytes([0b101])
    dspic.reset()
    assert dspic.read(0, 256) == before


def test_a_reset_of_the_encoders_counts_from_zero_again() -> None:
    dspic = Dspic()
    dspic.tick(1000, 2000)
    dspic.write(bytes([DspicRegister.RESET_ENCODERS, 1]))
    assert dspic.read(DspicRegister.POSITION_LEFT, 8) == bytes(8)
    dspic.tick(1010, 1995)
    assert dspic.read(DspicRegister.POSITION_LEFT, 8) == little_endian(10, 4) + little_endian(-5, 4)
