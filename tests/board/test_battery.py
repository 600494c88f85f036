"""Charger and cells: the discharge curve, its measurement by the board, and its effects on the robot."""

import pytest
import scenes
from notes import Notes

from khep_twin import playpen as playpens
from khep_twin import units
from khep_twin.board.battery import CHARGER, DISCHARGE, cell_voltage, voltage
from khep_twin.board.kernel import DUTIES
from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing.calibration import MotorCalibration
from khep_twin.world import World

MINUTE_NS = 60_000_000_000

# Minutes and volts read off the manual's figure 14.
FIGURE = {0: 5.36, 5: 4.98, 10: 4.83, 20: 4.74, 30: 4.61, 35: 4.51, 40: 4.26, 43: 3.30}


def connect(**options: float | bool) -> tuple[Khepera, World]:
    twin = open_twin("default", TwinOptions(**options))
    return Khepera(Serial.of(twin, timeout=1)), twin.world


def test_the_charger_keeps_its_voltage() -> None:
    assert {voltage(CHARGER, minutes * MINUTE_NS) for minutes in range(100)} == {5.0}


@pytest.mark.parametrize(("used_min", "volts"), FIGURE.items())
def test_the_cells_run_down_as_in_the_manuals_figure(used_min: float, volts: float) -> None:
    assert cell_voltage(used_min) == pytest.approx(volts, abs=0.08)
    assert voltage(used_min / 2, round(used_min / 2 * MINUTE_NS)) == cell_voltage(used_min)


def test_the_cells_fall_below_4_volts_after_41_minutes_and_never_rise() -> None:
    voltages = [cell_voltage(minutes / 10) for minutes in range(600)]
    assert voltages == sorted(voltages, reverse=True)
    assert next(minutes / 10 for minutes in range(600) if voltages[minutes] < 4) == pytest.approx(41, abs=0.1)
    assert len(DISCHARGE) <= 10
    assert cell_voltage(1000) == DISCHARGE[-1][1]


def test_channel_0_reads_half_the_supply_and_channel_6_the_current() -> None:
    robot, _ = connect()
    with robot:
        assert robot.converter(0) == round(2.5 / 4.096 * 1024) == 625
        assert robot.converter(6) == round(units.IDLE_CURRENT * 1000) == 236
    robot, _ = connect(battery_used_min=20)
    with robot:
        assert robot.converter(0) / 1024 * 4.096 * 2 == pytest.approx(cell_voltage(20), abs=0.01)


def test_a_robot_that_pushes_draws_the_current_of_its_torque() -> None:
    scene = playpens.parse(scenes.arena(200, 200) + scenes.robot(172, 100), "push.toml")
    with scenes.hosted(scene, noise=False) as robot:
        robot.set_duty(30, 30)  # too little for the tyres to slip
        robot.sleep(1)
        # All but at rest: i = duty V / R per motor, of which the supply sees the part `duty`.
        resistance = MotorCalibration().resistance
        duty = 30 / 255
        expected = units.IDLE_CURRENT + 2 * duty * duty * units.SUPPLY_VOLTAGE / resistance
        assert max(robot.speed()) <= 1
        assert robot.converter(6) == pytest.approx(expected * 1000, abs=2)


def test_a_lower_voltage_drives_slower_at_the_same_duty() -> None:
    ways = []
    for used_min in (0.3, 39.0):
        robot, world = connect(battery_used_min=used_min)
        with robot:
            robot.set_duty(40, 40)
            robot.sleep(1)
            ways.append(world.robots[0].pose[1])
    # The gears' friction takes the same voltage of both.
    full, empty = (40 / units.DUTY_LIMIT * cell_voltage(used_min) for used_min in (0.3, 39.0))
    motors = MotorCalibration()
    dead = motors.friction_torque_n_m * motors.resistance / motors.constant
    ratio = (empty - dead) / (full - dead)
    assert (ways[1] - 0.25) / (ways[0] - 0.25) == pytest.approx(ratio, abs=0.02)


def test_below_4_volts_the_processor_stands_still_and_the_motors_do_not() -> None:
    notes = Notes()
    robot, world = connect(battery_used_min=40.96)
    world.observers.append(notes)
    with pytest.raises(PortError, match="the motors may still run"), robot:  # noqa: PT012
        robot.set_led(0, 1)
        robot.set_duty(25, -25)
        robot.port.write(b"N\n" * 30)
        robot.sleep(1.5)
        assert "the supply fell to 4.00 V" in notes.events[0]
        assert len(notes.events) == 1
        firmware = world.robots[0].firmware
        assert not firmware.powered
        # It was reset, and answers no more …
        robot.port.reset_input_buffer()
        robot.port.write(b"B\n")
        assert robot.port.read(10) == b""
        assert robot.port.read(10) == b""
        # … while the robot goes on turning on the spot.
        before = world.robots[0].pose[2]
        robot.sleep(1)
        assert world.robots[0].pose[2] != pytest.approx(before, abs=0.3)


def test_a_processor_without_supply_does_not_start_anew_after_a_brown_out_fault() -> None:
    notes = Notes()
    twin = open_twin("default", TwinOptions(battery_used_min=41.2, faults=("brown-out@0.05",)))
    twin.world.observers.append(notes)
    with Serial.of(twin, timeout=0.5) as port:
        twin.robot.firmware.register_view[DUTIES[0]] = 20
        assert port.read(100) == b""
        assert notes.events[-1] == "fault brown-out@0.05 begins"
        # The motors keep their duty all the same.
        assert (twin.robot.firmware.powered, twin.robot.firmware.register_view[DUTIES[0]]) == (False, 20)
