"""Sensors of the Khepera IV in a world, against the manual's figures and closed form."""

import math

import numpy as np
import pytest

from khep_twin.board.fault_injection import parse_fault
from khep_twin.errors import CalibrationError
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.playpen import Playpen
from khep_twin.playpen.parts import Block
from khep_twin.programs.computer import Machine
from khep_twin.robots.khepera4.inertial import at_rest, measure
from khep_twin.robots.khepera4.model import BODY
from khep_twin.robots.khepera4.registers import COUNTS_PER_G, DEGREES_PER_COUNT, Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.robots.khepera4.state import BURST_NS as PERIOD_NS
from khep_twin.units import GRAVITY, TICK_NS
from khep_twin.world import World

WHITE_CM = {
    1: 1013,
    2: 1003,
    3: 985,
    4: 765,
    5: 490,
    6: 380,
    7: 320,
    8: 255,
    9: 230,
    10: 200,
    12: 165,
    14: 144,
    16: 130,
    18: 119,
    20: 111,
}
"""Counts before white paper at a distance [cm] (manual, figure 10)."""

FRONT, SONAR_MM, EYE_MM = 3, 66, 68
"""Sensor in front; distance of the ultrasonic and the infrared sensors from the centre [mm]."""


def robot_of(world: World, index: int = 0) -> Khepera4Robot:
    robot = world.robots[index]
    assert isinstance(robot, Khepera4Robot)
    return robot


def words(world: World, register: DspicRegister, count: int) -> list[int]:
    """Return registers as a program reads them."""
    content = robot_of(world).dspic.read(register, 2 * count)
    return [int.from_bytes(content[at : at + 2], "little", signed=True) for at in range(0, 2 * count, 2)]


def world_at(x_mm: float, y_mm: float = 1000, heading_deg: float = 0, playpen: str = "arena4-line") -> World:
    world = World(playpen)
    world.reset(noise=False, starts=[(x_mm, y_mm, heading_deg)])
    world.advance(0.2)
    return world


def order(world: World, left: int, right: int, control: Control = Control.SPEED) -> None:
    content = b"".join(speed.to_bytes(2, "little", signed=True) for speed in (left, right))
    first = DspicRegister.PWM_ORDER_LEFT if control is Control.OPEN_LOOP else DspicRegister.SPEED_ORDER_LEFT
    robot_of(world).dspic.write(bytes([first]) + content)
    robot_of(world).dspic.write(bytes([DspicRegister.CONTROL, control]))


def test_proximity_follows_the_manuals_curve() -> None:
    for cm, counts in WHITE_CM.items():
        (reading,) = words(world_at(2000 - EYE_MM - 10 * cm), DspicRegister.PROXIMITY, FRONT + 1)[FRONT:]
        assert abs(reading - counts) <= max(0.05 * counts, 15), cm


def test_readings_are_those_of_a_measurement_whenever_they_are_read() -> None:
    often, seldom = World("arena4", seed=3), World("arena4", seed=3)
    for world in (often, seldom):
        order(world, 300, -200)
    for _ in range(97):
        often.advance(0.00731)
        words(often, DspicRegister.AMBIENT, 40)
    seldom.advance_to(often.time_ns)
    assert often.snapshot() == seldom.snapshot()
    assert words(often, DspicRegister.AMBIENT, 29) == words(seldom, DspicRegister.AMBIENT, 29)


def test_ground_sensors_tell_floor_line_and_edge_apart() -> None:
    on_the_line = words(world_at(1600 - 61, 1000), DspicRegister.PROXIMITY, 12)[8:]
    assert on_the_line == pytest.approx([930, 51, 51, 930], abs=8)
    beyond = words(world_at(1149, 400, playpen="arena4-table"), DspicRegister.PROXIMITY, 12)[8:]
    assert beyond == pytest.approx([930, 30, 30, 930], abs=8)


def test_a_robot_falls_from_a_table_and_climbs_a_ramp() -> None:
    world = World("arena4-table", noise=False)
    order(world, 400, 400)
    world.advance(5)
    assert world.data.qpos[2] < -0.02
    world = World("arena4-ramps", noise=False)
    order(world, 250, 250)
    world.advance(3.6)
    assert world.data.qpos[2] == pytest.approx(0.04, abs=0.01)
    world.advance(4)
    assert world.data.qpos[2] == pytest.approx(0, abs=1e-3)
    assert world.poses[0][0] > 1.5


@pytest.mark.parametrize(("gap_mm", "reading"), [(200, 0), (260, 26), (700, 70), (1500, 150), (1800, 180)])
def test_ultrasound_ranges_a_wall_ahead(gap_mm: int, reading: int) -> None:
    front = words(world_at(2000 - SONAR_MM - gap_mm), DspicRegister.ULTRASONIC, 5)[2]
    assert front == pytest.approx(reading, abs=2)


def test_ultrasound_misses_far_oblique_walls_and_detects_objects_in_its_beam() -> None:
    pen = Playpen.load("arena4-line").model_copy(update={"patches": ()})
    board = Block(x_mm=1900, y_mm=1000, angle_deg=90, length_mm=600, width_mm=20, height_mm=200)
    for turn_deg, is_seen in ((0, True), (60, False)):
        turned = board.model_copy(update={"angle_deg": 90 + turn_deg})
        world = World(pen.model_copy(update={"blocks": (turned,)}))
        world.reset(noise=False, starts=[(900, 1000, 0)])
        world.advance(0.2)
        front = words(world, DspicRegister.ULTRASONIC, 5)[2]
        assert (front == pytest.approx(92, abs=2)) == is_seen


def test_disabled_ultrasonic_sensors_return_a_code_and_are_skipped() -> None:
    world = world_at(1000)
    robot_of(world).dspic.write(bytes([DspicRegister.ULTRASONIC_ENABLED, 0b00100]))
    assert words(world, DspicRegister.ULTRASONIC, 5) == [2000, 2000, 93, 2000, 2000]
    order(world, 400, 400)
    world.advance(1)
    expected = (2.0 - world.poses[0][0] - SONAR_MM / 1000) * 100
    assert words(world, DspicRegister.ULTRASONIC, 5)[2] == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("sensors", [(0, 1, 2, 3, 4), (0, 3), (0, 1, 4), (2,)])
def test_ultrasonic_sensors_that_are_enabled_take_turns_in_the_order_of_their_numbers(
    sensors: tuple[int, ...],
) -> None:
    world = World("arena4", noise=False)
    robot = robot_of(world)
    robot.dspic.write(bytes([DspicRegister.ULTRASONIC_ENABLED, sum(1 << sensor for sensor in sensors)]))
    bursts: list[int] = []
    for _ in range(2 * len(sensors) + 1):
        world.advance_to(world.time_ns + PERIOD_NS)
        bursts.append(robot._state.burst[0])
    first = sensors.index(bursts[0])
    turns = sensors[first:] + sensors[:first]
    assert bursts == [*turns, *turns, turns[0]]


def test_the_accelerometer_measures_gravity_and_a_start() -> None:
    world = world_at(400)
    assert [words(world, DspicRegister.ACCELEROMETER + 20 * axis, 10)[0] for axis in range(3)] == [
        0,
        0,
        -COUNTS_PER_G,
    ]
    before = world.data.qvel[0]
    order(world, 2000, 2000, Control.OPEN_LOOP)
    world.advance(0.1)
    # The casters deflect, by a hundredth of g.
    acceleration = np.mean(words(world, DspicRegister.ACCELEROMETER, 10)) / COUNTS_PER_G * GRAVITY
    assert acceleration == pytest.approx((world.data.qvel[0] - before) / 0.1, abs=0.15)


def test_the_gyroscope_measures_the_rate_of_a_turn_in_place() -> None:
    world = world_at(1000)
    order(world, -200, 200)
    world.advance(3)
    rate_deg = np.mean(words(world, DspicRegister.GYROSCOPE + 40, 10)) * DEGREES_PER_COUNT
    speed = 200 / 0.010 / BODY.pulses_per_turn * math.tau * 0.021
    assert rate_deg == pytest.approx(math.degrees(2 * speed / 0.1054), rel=0.01)


def test_each_axis_of_both_sensors_draws_once_from_the_numbers_of_its_own_period(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    numbers: list[int] = []

    def draws(tables: object, key: object, number: int) -> tuple[float, float]:
        numbers.append(number)
        return 0.0, 0.0

    monkeypatch.setattr("khep_twin.robots.khepera4.inertial.draws", draws)
    sensors, memory, upright, still = at_rest(), [0] * 256, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], (0.0, 0.0, 0.0)
    for period in range(1, 200):
        measure(sensors, memory, [], [1, 2], period * TICK_NS, upright, still, still)
        assert len(numbers) in (2, 4)
        assert numbers == [*range(4 * period, 4 * period + len(numbers))]
        numbers.clear()


def test_inertial_values_come_in_packets_of_ten_the_newest_first() -> None:
    world = World("arena4", seed=1)
    packets = [tuple(words(world, DspicRegister.ACCELEROMETER, 10))]
    for _ in range(40):
        world.advance(0.01)
        if (packet := tuple(words(world, DspicRegister.ACCELEROMETER, 10))) != packets[-1]:
            packets.append(packet)
    assert len(packets) == 5


def test_a_battery_runs_down_and_stops_the_robot() -> None:
    pen = Playpen.load("arena4")
    robot = pen.robots[0].model_copy(update={"battery_used_min": 420 * 300 / 420 - 0.05})
    world = World(pen.model_copy(update={"robots": (robot,)}), noise=False)
    order(world, 300, -300)
    world.advance(4)
    block = robot_of(world).dspic.read(DspicRegister.BATTERY, 12)
    assert block[3] == 0
    assert 6.0 <= int.from_bytes(block[10:12], "little") * 0.00976 < 6.05
    assert -1.5 < int.from_bytes(block[4:6], "little", signed=True) * 78.125e-6 < -0.48
    world.advance(8)
    assert np.abs(world.data.qvel).max() < 1e-3


def test_a_snapshot_resumes_bit_for_bit_with_robots_of_two_models() -> None:
    world = World("arena4-two", seed=2)
    order(world, 250, 240)
    world.robots[1].send(b"D,200,210\r\n")
    world.robots[2].send(b"D,5,4\n")
    world.advance(0.6175)
    snapshot = world.snapshot()
    world.advance(0.7)
    other = World("arena4-two", seed=9)
    other.restore(snapshot)
    other.advance_to(world.time_ns)
    assert other.snapshot() == world.snapshot()
    assert world.poses[1][0] < 1.45


def test_robots_of_one_model_differ_and_a_seed_repeats_them() -> None:
    world = World("arena4", seed=4, vary=True)
    repetition = World("arena4", seed=4, vary=True)
    for copy in (world, repetition):
        copy.advance(0.1)
    first = words(world, DspicRegister.PROXIMITY, 12)
    assert first == words(repetition, DspicRegister.PROXIMITY, 12)
    assert max(first[:8]) - min(first[:8]) > 20


def test_a_reset_sets_the_positions_to_zero_and_keeps_readings() -> None:
    world = World("arena4", seed=1)
    order(world, 300, 300)
    world.advance(1.0025)
    dspic = robot_of(world).dspic
    before = words(world, DspicRegister.PROXIMITY, 12)
    dspic.reset()
    assert words(world, DspicRegister.PROXIMITY, 12) == before
    assert dspic.read(DspicRegister.BATTERY, 12)[3] == 100
    world.advance(0.02)
    readings = robot_of(world).readings()
    assert 0 < readings["position"][0] < 800
    assert abs(readings["speed"][0]) < 400


def test_a_brown_out_resets_the_robot_and_with_an_empty_battery_it_does_not_reply() -> None:
    world = World("arena4", faults=[parse_fault("brown-out@0.5")])
    order(world, 300, 300)
    world.advance(1)
    assert robot_of(world).dspic.read(DspicRegister.CONTROL, 1) == bytes([Control.IDLE])
    pen = Playpen.load("arena4")
    empty = pen.robots[0].model_copy(update={"battery_used_min": 300})
    world = World(pen.model_copy(update={"robots": (empty,)}))
    world.advance(0.1)
    world.robots[0].send(b"B\r\n")
    world.advance(0.1)
    assert world.robots[0].uart.tx.read(world.time_ns) == b""
    with pytest.raises(OSError, match="no device has answered"):
        Machine(robot_of(world), world).transfer(0, [(0x30, 0, b"\0")], 25_000)


def test_a_scan_and_a_moved_wall_are_measured_immediately() -> None:
    world = World("arena4", noise=False)
    world.advance(0.1)
    place_robot(world, 0, 1000, 1925, 90)
    scan(world)
    assert words(world, DspicRegister.PROXIMITY, 4)[FRONT] == 1004
    place_robot(world, 0, 1000, 1000, 90)
    world.model.geom("block0").pos[:2] = 1.0, 1.2
    world.refresh()
    world.advance(0.02)
    assert words(world, DspicRegister.PROXIMITY, 4)[FRONT] > 300


def test_a_calibration_of_another_robot_is_refused() -> None:
    pen = Playpen.load("arena4")
    for model, wrong in (("khepera4", "khepera1"), ("khepera1", "khepera4")):
        robot = pen.robots[0].model_copy(update={"model": model, "calibration": wrong, "rom": "5.02"})
        with pytest.raises(CalibrationError, match=f"{wrong}: of another robot than model"):
            World(pen.model_copy(update={"robots": (robot,)}))
