"""Sensors and battery of a Khepera III in a world, as the bus reports them."""

import math

import numpy as np
import pytest

from khep_twin.playpen import parse
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.world import World

SCAN_MS, ALL, N_EMPTY = 33, 0b11111, (0,) * 15

ROOM = """version = 1
name = "room"
[arena]
width_mm = 9000
height_mm = 2000
[[robot]]
model = "khepera3"
x_mm = 2000
y_mm = 1000
heading_deg = 0
{}"""
"""A room whose wall is 7 m ahead of the robot."""

SONAR_M = 0.0564
"""Position of the front ultrasonic sensor before the axle [m]."""


def robot_in(
    content: str = "", noise: bool = False, active: int | None = None, n_echoes: int = 3
) -> tuple[World, Khepera3Robot]:
    """Return a world with a robot and other content, and the robot with these active ultrasonic sensors."""
    world = World(parse(ROOM.format(content), "room"))
    world.reset(seed=1, noise=noise)
    robot = world.robots[0]
    assert isinstance(robot, Khepera3Robot)
    if active is not None:
        ask(robot, "C", 0, 0, active)
        ask(robot, "C", 1, 0, n_echoes)
    return world, robot


def ask(robot: Khepera3Robot, letter: str, *arguments: int) -> list[int]:
    """Return the numbers that the dsPIC answers."""
    reply = robot.bus.dspic.ask(letter, *arguments)
    assert reply is not None
    return [*reply]


def block(distance: float, width: float) -> str:
    """Return a block at a distance from the front ultrasonic sensor [m]."""
    x_mm = 2000 + 1000 * (SONAR_M + distance) + 50
    return f"""[[block]]
x_mm = {x_mm}
y_mm = 1000
length_mm = 100
width_mm = {1000 * width}
height_mm = 300
"""


def test_infrared_readings_are_those_of_the_last_scan_every_33_ms() -> None:
    world, robot = robot_in(noise=True)
    readings: dict[int, list[int]] = {}
    for _ in range(80):
        world.step()
        *counts, time_ms = ask(robot, "N")
        assert time_ms == world.time_ns // 1_000_000 // SCAN_MS * SCAN_MS
        assert readings.setdefault(time_ms, counts) == counts
        assert ask(robot, "O")[-1] == time_ms
    assert len({*map(tuple, readings.values())}) == len(readings) == 7


def test_z_sets_the_time_of_readings_to_0() -> None:
    world, robot = robot_in()
    world.advance(1.0)
    assert ask(robot, "N")[-1] == 990
    ask(robot, "Z")
    assert ask(robot, "N")[-1] == 0  # of a scan before
    world.advance(0.5)
    assert ask(robot, "N")[-1] == 45 * SCAN_MS - 1000  # the last scan, at 1.485 s


def test_an_infrared_sensor_that_the_mask_switches_off_reads_0() -> None:
    world, robot = robot_in(block(0.05, 0.6))
    world.advance(0.1)
    counts = ask(robot, "N")[:11]
    assert min(counts[2:6]) > 0
    ask(robot, "C", 4, 0b101, 0b1110_1011)  # without the numbers 2, 4 and 9
    world.advance(0.1)
    expected = [0 if number in (2, 4, 9) else count for number, count in enumerate(counts)]
    assert ask(robot, "N")[:11] == expected
    assert [number for number, count in enumerate(ask(robot, "O")[:11]) if not count] == [2, 4, 9]


@pytest.mark.parametrize("distance", [0.2, 0.27, 0.5, 1.0, 2.0, 3.0, 4.0])
def test_a_wall_has_one_echo_at_its_distance_to_a_centimetre(distance: float) -> None:
    world, robot = robot_in(block(distance + 0.0001 * (distance == 0.2), 1.9))
    world.advance(0.2)
    count, cm, amplitude, time_ms, *rest = ask(robot, "G", 3)
    assert (count, cm, rest[-1]) == (1, round(100 * distance), 1800)
    assert time_ms in range(0, 200, 50)  # of its burst
    assert not any(rest[:-1])
    if distance == 0.27:
        assert amplitude == pytest.approx(2900, rel=0.05)  # example of the manual


@pytest.mark.parametrize(("distance", "degrees", "n_echoes"), [(1, 40, 1), (1, 45, 0), (3, 15, 1)])
def test_a_turned_wall_is_heard_at_its_perpendicular_distance_up_to_an_angle(
    distance: float, degrees: float, n_echoes: int
) -> None:
    angle, depth = math.radians(degrees), 50
    wall = f"""[[block]]
x_mm = {2000 + 1000 * (SONAR_M + distance) + depth * math.cos(angle)}
y_mm = {1000 + depth * math.sin(angle)}
angle_deg = {degrees}
length_mm = {2 * depth}
width_mm = 1600
height_mm = 300
"""
    world, robot = robot_in(wall)
    world.advance(0.2)
    count, cm, *_ = ask(robot, "G", 3)
    expected = 100 * distance * math.cos(angle) if n_echoes else 0
    assert (count, cm) == (n_echoes, pytest.approx(expected, abs=1))


@pytest.mark.parametrize("content", ["", block(4.2, 1.9), block(0.15, 1.9)])
def test_without_an_object_from_20_cm_to_4_m_there_are_0_echoes(content: str) -> None:
    world, robot = robot_in(content)
    world.advance(0.2)
    assert ask(robot, "G", 3) == [0, *N_EMPTY, 1800]


POSTS = block(0.5, 0.03) + block(0.8, 0.1) + block(1.5, 1.9)


@pytest.mark.parametrize(("n_echoes", "distances"), [(1, [50]), (2, [50, 80]), (3, [50, 80, 150])])
def test_several_objects_are_echoes_with_the_nearest_first_up_to_the_set_number(
    n_echoes: int, distances: list[int]
) -> None:
    world, robot = robot_in(POSTS, active=0b00100, n_echoes=n_echoes)
    world.advance(0.2)
    count, *numbers, _ = ask(robot, "G", 3)
    assert count == n_echoes
    np.testing.assert_allclose(numbers[: 3 * count : 3], distances, atol=1)
    assert not any(numbers[3 * count :])


@pytest.mark.parametrize("mask", [0, 0b00001, 0b00110, ALL])
def test_active_ultrasonic_sensors_measure_in_turn_every_50_ms_and_others_never(mask: int) -> None:
    world, robot = robot_in(block(0.3, 1.9), active=mask)
    times: set[int] = set()
    for _ in range(12):
        world.advance(0.05)
        for sensor in range(5):
            count, _, _, time_ms, *_ = ask(robot, "G", sensor + 1)
            assert count == 0 or mask >> sensor & 1
            times |= {time_ms} if count else set()
    if mask:
        assert all(time_ms % 50 == 0 for time_ms in times)


def test_ultrasonic_sensors_keep_their_places_and_numbers() -> None:
    world, robot = robot_in(active=ALL)
    world.advance(0.5)
    distances = [ask(robot, "G", sensor + 1)[1] for sensor in range(5)]
    side_cm = round(100 * (1.0 - 0.0596))
    assert (distances[0], distances[4], distances[2]) == (side_cm, side_cm, 0)


def test_a_battery_has_a_voltage_currents_charges_and_a_temperature_by_its_kinds() -> None:
    world, robot = robot_in()
    world.advance(0.1)
    volts, amperes, average, charge, temperature, level = (ask(robot, "V", kind) for kind in range(6))
    assert 8 <= volts[0] + volts[1] / 10_000 <= 8.4
    assert amperes == [0x8000, 3500] == average  # 0.35 A, discharging: 1400 mAh last four hours (manual)
    assert (charge, temperature, level) == ([1400, 0], [25, 0], [100, 0])


def test_a_used_up_battery_falls_to_6_v_and_switches_the_robot_off() -> None:
    levels: list[list[int]] = []
    for minutes in (60, 120, 239.995):
        world, robot = robot_in(f"battery_used_min = {minutes}\n")
        levels.append(ask(robot, "V", 5))
    assert levels == [[75, 0], [50, 0], [0, 0]]
    world.advance(1.0)
    volts, fraction = ask(robot, "V", 0)
    assert volts + fraction / 10_000 <= 6
    assert not robot.firmware.powered
