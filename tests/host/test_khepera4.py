"""The host library for a Khepera IV, on twins in lock-step and behind ports."""

import math
from collections.abc import Iterator

import pytest
from hosts import answer_once
from served_twin import served

from khep_twin.errors import PortError, ProtocolError
from khep_twin.host import Khepera, Khepera4, Vector3
from khep_twin.host.discovery import identify_robot
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.robots.registry import find_model


@pytest.fixture
def robot() -> Iterator[Khepera4]:
    with Khepera4("khep://arena4?noise=off") as khepera4:
        yield khepera4


def twin_of(robot: Khepera4) -> Khepera4Robot:
    twin = robot.port.twin.robot  # type: ignore[attr-defined]
    assert isinstance(twin, Khepera4Robot)
    return twin


def registers(robot: Khepera4, first: DspicRegister, count: int) -> list[int]:
    return [*twin_of(robot).dspic.read(first, count)]


def test_every_setting_reaches_its_registers(robot: Khepera4) -> None:
    assert robot.revision() == "B0"
    robot.configure_speed_controller(40, 2, 1)
    robot.configure_profile(5, 1, 30, 2, 300)
    robot.set_margin(0.001)
    assert registers(robot, DspicRegister.KP, 11) == [40, 2, 1, 5, 1, 30, 2, 147, 0, 300 - 256, 1]
    robot.reset_motors()
    assert registers(robot, DspicRegister.KP, 11) == [10, 5, 1, 3, 0, 20, 1, 20, 0, 400 - 256, 1]
    robot.set_leds((1, 2, 3), (4, 5, 6), (7, 8, 63))
    assert [*twin_of(robot).dspic.leds] == [1, 2, 3, 4, 5, 6, 7, 8, 63]
    robot.reset()
    assert [*twin_of(robot).dspic.leds] == [0] * 9


def test_sensors_have_names_and_units(robot: Khepera4) -> None:
    robot.sleep(0.25)
    assert robot.proximity().front == 96
    assert robot.proximity().ground_left > 900
    assert robot.ambient().back == 980
    assert robot.accelerations() == ((0.0, 0.0, pytest.approx(-9.81, abs=0.02)),) * 10
    robot.set_speed(-0.05, 0.05)
    robot.sleep(1)
    assert robot.turn_rates()[0] == Vector3(0, 0, pytest.approx(0.1 / 0.1054, abs=0.05))
    robot.enable_ultrasonic([2])
    robot.sleep(0.1)
    distances = robot.ultrasonic()
    assert distances.front is not None
    assert distances[:2] == (None, None) == distances[3:]
    answer_once(robot, b"g,0,25,250,1000,2000\r\n")
    assert robot.ultrasonic() == (0, 0.25, 2.5, math.inf, None)


def test_a_battery_has_its_voltage_and_charge(robot: Khepera4) -> None:
    battery = robot.battery()
    assert battery.voltage == pytest.approx(8.2, abs=0.1)
    assert (battery.level, battery.charge_mah, battery.is_charging) == (1, 3400, False)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda robot: robot.set_leds((64, 0, 0), (0, 0, 0), (0, 0, 0)), "expected three numbers from 0 to"),
        (lambda robot: robot.enable_ultrasonic([5]), r"sensors = \[5\]; expected some of 0 to 4"),
    ],
)
def test_what_is_out_of_range_is_refused_before_it_is_sent(robot: Khepera4, wrong, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong(robot)


def test_a_robot_of_the_other_kind_is_named_at_a_twin_and_by_its_replies() -> None:
    with pytest.raises(
        PortError, match=r"^khep://arena4: the robot is a Khepera IV; expected a Khepera"
    ) as caught:
        Khepera("khep://arena4")
    assert str(caught.value).endswith("expected a Khepera")
    assert caught.value.__notes__ == ["khep_twin.host.Khepera4 is the class for a Khepera IV"]
    with pytest.raises(PortError, match=r"the robot is a Khepera; expected a Khepera IV"):
        Khepera4("khep://default")


@pytest.mark.share(3)
@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")  # pyserial calls setDaemon
@pytest.mark.parametrize("kind", [[], ["--tcp", ":0"], ["--rfc2217", ":0"]])
def test_a_served_twin_answers_at_each_kind_of_port(kind: list[str]) -> None:
    with served("arena4", "--noise", "off", *kind) as (_, url):
        with Khepera4(url, 2.0) as robot:
            robot.set_speed(0.05, 0.05)
            assert robot.proximity().front == 96
            assert robot.ultrasonic().front is not None
        with Khepera(url, 2.0) as wrong:
            with pytest.raises(ProtocolError, match="and 8 values; a Khepera IV answers so; expected a Khep"):
                wrong.proximity()
        if not kind:
            assert identify_robot(url) == (9600, find_model("khepera4"), "b,B,0")  # a twin takes any speed
