"""The host library for a Khepera III, on twins with its firmware and with kh3server, and behind ports."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import pytest
from hosts import answer_once

from khep_twin.errors import PortError, ProtocolError
from khep_twin.host import Distances, Khepera, Khepera3, Khepera4
from khep_twin.host.discovery import identify_robot
from khep_twin.interventions.move_robot import place_robot
from khep_twin.playpen import Playpen
from khep_twin.robots.khepera3.host import Echo, InfraredReadings
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.registers import PWM_LIMIT, MotorRegister, PicMode
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.robots.registry import find_model

FIRMWARE, SERVER = "khep://arena3?noise=off", "khep://arena3?noise=off&rom=kh3server"


@pytest.fixture(params=[FIRMWARE, SERVER], ids=["firmware", "kh3server"])
def robot(request: pytest.FixtureRequest) -> Iterator[Khepera3]:
    with Khepera3(request.param) as khepera3:
        yield khepera3


def twin_of(robot: Khepera3) -> Khepera3Robot:
    twin = robot.port.twin.robot  # type: ignore[attr-defined]
    assert isinstance(twin, Khepera3Robot)
    return twin


def registers(robot: Khepera3, register: int, size: int) -> list[int]:
    return [motor.get(register, size) for motor in twin_of(robot).bus.motors]


def test_every_setting_reaches_its_registers(robot: Khepera3) -> None:
    assert robot.version() == (3, 0)
    robot.configure_speed_controller(40, 2, 1)
    robot.configure_position_controller(50, 4, 3)
    robot.configure_profile(0.05, 20)
    for first, gains in ((MotorRegister.SPEED_GAINS, (40, 1, 2)), (MotorRegister.POSITION_GAINS, (50, 3, 4))):
        for index, gain in enumerate(gains):
            assert registers(robot, first + 2 * index, 2) == [gain, gain]
    assert registers(robot, MotorRegister.TOP_SPEED, 2) == [10_937, 10_937]  # 218.75 units per mm/s
    assert registers(robot, MotorRegister.ACCELERATION, 1) == [20, 20]
    robot.reset_motors()
    assert registers(robot, MotorRegister.SPEED_GAINS, 2) == [620, 620]
    robot.light_leds([True, False])
    assert twin_of(robot).readings()["leds"] == [1, 0]
    robot.light_leds([False, True])
    assert twin_of(robot).readings()["leds"] == [0, 1]


def test_a_duty_is_a_part_of_the_voltage(robot: Khepera3) -> None:
    robot.set_duty(0.5, 0.5)
    assert registers(robot, MotorRegister.SET_POINT, 4) == [round(PWM_LIMIT / 2)] * 2


def test_a_robot_of_the_first_generation_has_its_own_units(tmp_path) -> None:
    playpen = tmp_path / "old.toml"
    playpen.write_text(
        'version = 1\nname = "old"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n[[robot]]\n'
        'model = "khepera3-firmware2"\nx_mm = 500\ny_mm = 300\nheading_deg = 90\n'
    )
    for rom in ("2.0", "kh3server"):
        with Khepera3(f"khep://{playpen}?rom={rom}") as robot:
            assert robot.version() == (2, 0)
            _, y, _ = twin_of(robot).pose
            robot.set_speed(0.1, 0.1)
            assert registers(robot, MotorRegister.SET_POINT, 4) == [14_405, 14_405]  # 144.05 units per mm/s
            robot.stop()
            robot.reset_position()
            robot.move(0.1)
            assert twin_of(robot).pose[1] == pytest.approx(y + 0.1, abs=3e-3)


def test_a_robot_that_is_put_elsewhere_with_a_reset_drives_straight_again(robot: Khepera3) -> None:
    robot.configure_ultrasonic()
    robot.set_speed(0.05, 0.05)
    robot.sleep(0.3)
    place_robot(robot.port.twin.world, 0, 1000, 800, 90, reset=True)  # type: ignore[attr-defined]
    assert robot.position() == (0, 0)
    robot.set_speed(0.05, 0.05)
    robot.sleep(1)
    x, y, _ = twin_of(robot).pose
    assert x == pytest.approx(1, abs=1e-3)
    assert y > 0.83


def test_negative_counts_are_negative_from_both_programs(robot: Khepera3) -> None:
    robot.sleep(0.1)
    twin_of(robot).registers[FIRST["proximity"]] = -3
    twin_of(robot).bus.dspic.before_read = lambda letter: None
    assert robot.proximity().back_left == -3
    assert robot.read_channels("proximity")["proximity"][0] == -3
    assert (robot.ask("N").split(",")[1] == "-3") == ("rom" not in robot.port.name)


def test_sensors_have_names_and_units(robot: Khepera3) -> None:
    robot.sleep(0.25)
    assert robot.proximity().back in range(20, 200)  # the floor's reflection
    assert robot.proximity().ground_left > 3900
    assert robot.ambient() == InfraredReadings(*[4000] * 11)
    assert robot.infrared_time() == pytest.approx(0.25, abs=0.06)
    robot.reset_timer()
    robot.sleep(0.1)
    assert robot.infrared_time() == pytest.approx(0.1, abs=0.04)
    distances = robot.ultrasonic()
    assert distances == Distances(None, None, pytest.approx(0.94, abs=0.03), None, None)
    robot.configure_ultrasonic([0, 1], n_echoes=1)
    robot.sleep(0.3)
    left, front_left, *inactive = robot.ultrasonic()
    assert left == pytest.approx(0.94, abs=0.03)
    assert front_left == math.inf
    assert inactive == [None] * 3
    (echo,) = robot.echoes(0)
    assert echo.amplitude > 200
    assert 0 < echo.time < 1
    assert robot.echoes(2) == []
    answer_once(robot, b"g,2,27,2900,1500,94,300,2500" + b",0" * 9 + b",1800\r\n")
    assert robot.echoes(0) == [Echo(0.27, 2900, 1.5), Echo(0.94, 300, 2.5)]


def test_a_battery_has_its_voltage_and_charge(robot: Khepera3) -> None:
    battery = robot.battery()
    assert battery.voltage == pytest.approx(8.2, abs=0.2)
    assert battery.current == pytest.approx(battery.average_current, abs=0.01)
    assert -0.5 < battery.current < -0.1
    assert battery[3:] == (1400, 25, 1, None)
    assert robot.supply_voltage() == battery.voltage


def test_its_vehicle_stops_with_its_motors(robot: Khepera3) -> None:
    robot.wander()
    robot.wander()
    robot.stop_wandering()
    assert registers(robot, MotorRegister.MODE, 1) == [PicMode.STOP] * 2


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda robot: robot.configure_ultrasonic([0, 2]), r"sensors = \[0, 2\]; expected neighbours among"),
        (lambda robot: robot.configure_ultrasonic([5]), r"sensors = \[5\]; expected neighbours among 0 to 4"),
        (lambda robot: robot.configure_ultrasonic([-1]), r"sensors = \[-1\]; expected neighbours among 0 to"),
        (lambda robot: robot.configure_ultrasonic(n_echoes=6), "n_echoes = 6; expected 1 to 5"),
        (lambda robot: robot.echoes(5), "sensor = 5; expected 0 to 4"),
    ],
)
def test_what_is_out_of_range_is_refused_before_it_is_sent(wrong, message: str) -> None:
    with Khepera3(FIRMWARE) as robot, pytest.raises(ValueError, match=message):
        wrong(robot)


def test_a_robot_of_another_kind_is_named_at_a_twin_and_by_its_replies() -> None:
    with pytest.raises(PortError, match=r"^khep://arena3\?noise=off: the robot is a Khepera III; expected a"):
        Khepera(FIRMWARE)
    with pytest.raises(PortError, match=r"the robot is a Khepera IV; expected a Khepera III"):
        Khepera3("khep://arena4")


@pytest.mark.filterwarnings("ignore:.*a host came in the moment another left")
def test_a_served_twin_answers_hosts_of_its_kind(
    served: Callable[[Playpen], AbstractContextManager[str]],
) -> None:
    with served(Playpen.load("arena3")) as url:
        with Khepera3(url, 2.0) as robot:
            robot.set_speed(0.05, 0.05)
            assert robot.proximity().ground_left > 3900
            assert len(robot.read_panel()["ambient"]) == 11
        with Khepera4(url, 2.0) as wrong:
            with pytest.raises(ProtocolError, match="and 5 values; a Khepera III answers so"):
                wrong.ultrasonic()
        assert identify_robot(url)[1:] == (find_model("khepera3"), "b,3,0")
