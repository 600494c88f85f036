"""Robots that pass each other are visible by infrared and cast shadows."""

from functools import cache

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.units import SENSOR_POSITIONS
from khep_twin.world import World

SCENE = """version = 1
name = "passing"
[arena]
width_mm = 800
height_mm = 600
{lamp}
[[robot]]
x_mm = 400
y_mm = 250
heading_deg = 0
calibration = "khepera1-manual"
[[robot]]
x_mm = 280
y_mm = {y_mm}
heading_deg = 0
calibration = "khepera1-manual"
"""


@cache
def pass_by(y_mm: float, lamp: str = "") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Let the second robot pass the first; return positions and readings every 10 ms.

    Returns:
        Positions x, y relative to the first robot (n, 2) [m], proximity (n, 2, 8), ambient (n, 2, 8).
    """
    world = World(playpen.parse(SCENE.format(y_mm=y_mm, lamp=lamp), "passing"), noise=False)
    world.robots[1].send(b"D,10,10\n")
    places: list[tuple[float, float]] = []
    proximity: list[list[np.ndarray]] = []
    ambient: list[list[np.ndarray]] = []
    for tick in range(1, 301):
        world.advance_to(tick * 10_000_000)
        (x, y, _), (other_x, other_y, _) = world.poses
        places.append((other_x - x, other_y - y))
        proximity.append([robot.registers[PROXIMITY].copy() for robot in world.robots])
        ambient.append([robot.registers[AMBIENT].copy() for robot in world.robots])
    return np.array(places), np.array(proximity), np.array(ambient)


@pytest.mark.parametrize(("side", "lateral", "oblique"), [(1, 0, 1), (-1, 5, 4)])
def test_a_robot_that_passes_is_seen_by_one_sensor_after_the_other(
    side: int, lateral: int, oblique: int
) -> None:
    places, proximity, _ = pass_by(250 + side * 58)
    counts = proximity[:, 0]
    assert counts[:, lateral].max() > 100
    assert counts[:, oblique].max() > 100
    # It comes from behind: first it is in front of the lateral sensor, then of the oblique one.
    lateral_x, oblique_x = (
        np.average(places[:, 0], weights=counts[:, sensor]) for sensor in (lateral, oblique)
    )
    assert lateral_x == pytest.approx(SENSOR_POSITIONS[lateral][0], abs=0.006)
    assert lateral_x + 0.005 < oblique_x < 0.055
    other_sensors = [sensor for sensor in range(6) if (sensor < 3) != (side == 1)]
    assert not counts[:, other_sensors].any()


def test_it_sees_the_one_that_it_passes_as_that_one_sees_it() -> None:
    places, proximity, _ = pass_by(250 + 58)
    counts, counts_back = proximity[:, 0, 0], proximity[:, 1, 5]
    # At the same heading, one is on the left of the other, and that one on its right.
    offset, offset_back = (
        np.average(places[:, 0], weights=counts),
        np.average(-places[:, 0], weights=counts_back),
    )
    assert offset == pytest.approx(offset_back, abs=0.003)


@pytest.mark.share(2)
@pytest.mark.parametrize("gaps_mm", [[4, 8, 40], [4, 8, 40, 6, 12]], ids=len)
def test_a_robot_is_seen_the_more_the_nearer_it_passes(gaps_mm: list[int]) -> None:
    peaks = [pass_by(250 + 55 + gap_mm)[1][:, 0, 0].max() for gap_mm in sorted(gaps_mm)]
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[0] > 2 * peaks[len(peaks) // 2] or peaks[0] == 1023
    assert peaks[-1] == 0


def test_a_robot_that_passes_before_a_lamp_takes_its_light() -> None:
    lamp = "[[lamp]]\nx_mm = 400\ny_mm = 420\npower_w = 4\n"
    places, _, ambient = pass_by(340, lamp)
    light = ambient[:, 0, 0].max() - ambient[:, 0, 0]
    dark = light < 0.1 * light.max()
    # The shadow lies where the way from the lamp to the sensor crosses the robot: it is as wide as the robot.
    assert dark.any()
    assert np.abs(places[dark, 0]).max() < 0.0275 + 0.01
    assert light[np.abs(places[:, 0]) > 0.0275 + 0.02].min() > 0.9 * light.max()
