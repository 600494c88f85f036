"""Infrared sensors of a Khepera III before a white obstacle, against some means of a real robot."""

import numpy as np
import pytest

from khep_twin.playpen import parse
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.world import World
from studies.khepera3_bench import PEN, scene_counts

MEANS = {
    "black": {
        9.0: (381, 3942, 3953, 753),
        18.0: (172, 2363, 2927, 472),
        31.5: (61, 951, 1236, 264),
        58.5: (19, 253, 317, 118),
        103.5: (13, 60, 60, 66),
        202.5: (9, 19, 9, 52),
    },
    "white": {
        22.5: (224, 1754, 2036, 446),
        49.5: (90, 503, 599, 244),
        94.5: (48, 157, 187, 162),
        202.5: (37, 71, 72, 132),
    },
}
"""Mean counts of the four front sensors, from the left, by floor and distance of the obstacle [mm]."""

NOISE = 3 * 3.5
"""Three standard deviations of a small count."""

FREE = {
    "black": (41, 9, 8, 13, 5, 44, 1, 66, 43),
    "white": (95, 29, 34, 55, 54, 122, 19, 120, 101),
}
"""Counts of the nine sensors around without an object, by the floor, which each reflects in its own way."""


@pytest.mark.parametrize("floor", MEANS)
def test_readings_before_an_obstacle_are_within_10_percent_or_noise(floor: str) -> None:
    readings = scene_counts(np.array([*MEANS[floor]]), floor)
    counts = np.column_stack([readings[sensor] for sensor in (2, 3, 4, 5)])
    np.testing.assert_allclose(counts, [*MEANS[floor].values()], rtol=0.1, atol=NOISE)


def world_above(floor: str, noise: bool = False) -> tuple[World, Khepera3Robot]:
    """Return a world with a robot on a floor, far from other objects, and the robot."""
    world = World(parse(PEN.format(x_mm=3900, y_mm=2000, angle_deg=0, floor=floor), "pen"))
    world.reset(noise=noise)
    robot = world.robots[0]
    assert isinstance(robot, Khepera3Robot)
    world.advance(0.1)
    return world, robot


def counts_of(robot: Khepera3Robot, letter: str) -> list[int]:
    reply = robot.bus.dspic.ask(letter)
    assert reply is not None
    return [*reply[:11]]


@pytest.mark.parametrize("floor", FREE)
def test_the_floor_reflects_into_each_sensor_as_recorded(floor: str) -> None:
    _, robot = world_above(floor)
    np.testing.assert_allclose(counts_of(robot, "N")[:9], FREE[floor], atol=6)


def test_the_ground_reads_white_as_recorded_and_black_paint_below_all_thresholds() -> None:
    white, black = (counts_of(world_above(floor)[1], "N")[9:] for floor in ("white", "black"))
    assert white == [3978, 3972]
    # The recordings' black floor reads 2620 to 3410, and programs compare with 3000 to 3750.
    assert max(black) < 2620


def test_noise_is_that_of_the_recordings_and_proximity_may_be_below_0() -> None:
    world, robot = world_above("black", noise=True)
    readings: list[list[int]] = []
    for _ in range(80):
        world.advance(0.033)
        readings.append(counts_of(robot, "N")[:9])
        assert min(counts_of(robot, "O")) >= 0
    deviations = np.std(readings, axis=0)
    assert -20 <= np.min(readings) < 0
    assert 2 < deviations.min() < deviations.max() < 9
