"""Light of the floor: on a sensor, directly and by way of objects; figures of a real Khepera III."""

import numpy as np
import pytest

from khep_twin import ConstantSpeed, World, rollout
from khep_twin.playpen import parse
from khep_twin.robots.khepera3.model import SAMPLED
from studies.khepera3_bench import scene_counts

PROXIMITY = next(slice(c.registers[0], c.registers[0] + 9) for c in SAMPLED if c.name == "proximity")

REST = {"black": [41, 9, 8, 13, 5, 44, 1, 66, 43], "white": [95, 29, 34, 55, 54, 122, 19, 120, 101]}
"""Mean readings of a real robot without an obstacle, by the floor."""

FRONT = {
    "black": {4.5: 3968, 13.5: 3562, 18: 2645, 27: 1426, 36: 842, 49.5: 420, 67.5: 193, 103.5: 60},
    "white": {4.5: 3962, 13.5: 3418, 18: 2645, 27: 1543, 36: 974, 49.5: 551, 67.5: 316, 103.5: 150},
}
"""Means of both front sensors at distances [mm] from a white obstacle."""

PEN = """version = 1
name = "floors"
[arena]
width_mm = 1500
height_mm = 1000
[[block]]
x_mm = 900
y_mm = 500
length_mm = 40
width_mm = 200
height_mm = {height_mm}
[[patch]]
x_mm = {x_mm}
y_mm = 500
length_mm = 300
width_mm = 1000
surface = "{surface}"
[[robot]]
model = "khepera3"
x_mm = 700
y_mm = 500
heading_deg = 3
"""


def pen(x_mm: float, surface: str = "black", height_mm: float = 70) -> str:
    return PEN.format(x_mm=x_mm, surface=surface, height_mm=height_mm)


@pytest.mark.parametrize("floor", REST)
def test_a_floor_and_a_white_obstacle_read_as_on_a_real_khepera_iii(floor: str) -> None:
    distances = np.array([*FRONT[floor], 445.0])
    readings = scene_counts(distances, floor)
    assert [values[-1] for values in readings.values()] == pytest.approx(REST[floor], abs=7)
    front = (readings[3] + readings[4])[:-1] / 2
    # 10 %, or three standard deviations of the noise.
    np.testing.assert_allclose(front, list(FRONT[floor].values()), rtol=0.1, atol=10)


def test_each_sensor_sees_the_floor_before_it() -> None:
    world = World(parse(pen(850), "floors"), noise=False)
    readings = np.array(world.robots[0].readings()["proximity"][:9])
    far = REST["black"], REST["white"]
    is_white = np.abs(readings - far[1]) < np.abs(readings - far[0])
    # The patch begins under the axle; the obstacle is 130 mm ahead.
    assert is_white[[0, 7, 8]].all()
    assert not is_white[[1, 2, 6]].any()


def test_floors_between_black_and_white_give_a_part_of_the_light() -> None:
    rests = [
        World(parse(pen(850, surface), "floors"), noise=False).robots[0].readings()["proximity"][3]
        for surface in ("black", "grey", "sponge", "white")
    ]
    assert rests == sorted(rests)
    assert rests[0] + 5 < rests[1]


@pytest.mark.parametrize("x_mm", [850, 1350])
def test_floors_of_the_plane_are_those_of_mujoco(x_mm: float) -> None:
    plane, mujoco = (
        rollout(
            parse(pen(x_mm), "floors"), ConstantSpeed(9000, 8000), [1], 1.0, planar=planar, compiled=False
        )
        for planar in (True, False)
    )
    np.testing.assert_allclose(plane.registers[0, PROXIMITY], mujoco.registers[0, PROXIMITY], atol=4)


def test_readings_rise_gradually_to_their_limit() -> None:
    readings = scene_counts(np.arange(0.0, 20.0, 0.5), "black")[3]
    steps = np.diff(readings)
    assert (steps <= 0).all()
    assert readings[0] == 3980
    assert 0 < (readings > 3900).sum() < len(readings)
    assert steps[readings[:-1] > 3800].min() > -150


def test_noise_grows_with_the_light_and_vanishes_at_the_limit() -> None:
    distances = np.array([445.0, 40.5, 27.0, 0.0])
    quiet, noisy = (scene_counts(distances, "black", draw)[3] for draw in (0.0, 1.0))
    # Standard deviations of a real robot: 3 to 5 far off, and 4 to 9 from 250 to 1700 counts.
    far, near, nearer, limit = noisy - quiet
    assert 3 <= far <= 5 <= near <= nearer <= 9
    assert limit == 0
