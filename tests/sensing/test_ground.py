"""Ground sensors and counts of any converter, in a world of a robot with a calibration of 12 bits."""

from pathlib import Path
from typing import Any

import pytest

from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.sensing.ground import Ground, convert_any
from khep_twin.sensing.noise import Draws
from khep_twin.world import World

QUIET: Draws = (0.0, 0.0, 0.0)
FRONT, BACK, GROUND_LEFT = 3, 7, 8
"""Sensors in front, at the back, where it sees nothing, and of the ground."""
HEIGHT, LENS = 0.0047, 0.002


@pytest.fixture
def twelve_bits(tmp_path: Path) -> str:
    """Return a calibration of a Khepera IV with 12 bits, whose counts in free space are below 0."""
    text = calibration.read("khepera4")[1]
    for old, new in (
        ("version = 1", "version = 1\nlargest_count = 4095"),
        ("1058000, 1058000", "4200000, 4200000"),
        ("4200000]", "1]"),
        ("[-96, -96, -96, -96, -96, -96, -96, -96]", "[2, 2, 2, 2, 2, 2, 2, 2]"),
        ("limit_counts = 1004", "limit_counts = 3985\nfloor_counts = -10"),
        ("white_counts = [930, 930", "white_counts = [3975, 3975"),
        ("ceiling_counts = 1023", "ceiling_counts = 4095\nrises_with_light = true"),
    ):
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "twelve.toml"
    path.write_text(text)
    return str(path)


def counts(path: str, x_mm: float, *, noise: Draws = QUIET, height: float = HEIGHT) -> list[tuple[int, int]]:
    """Return proximity and ambient counts of all sensors of a robot towards the wall at x = 2 m."""
    pen = Playpen.load("arena4-line")
    robot = pen.robots[0].model_copy(update={"calibration": path})
    world = World(pen.model_copy(update={"robots": (robot,), "patches": ()}))
    world.reset(noise=False, starts=[(x_mm, 1000, 0)])
    simulated: Any = world.simulation.plain
    sensors, ground = simulated.groups[0][0].sensors, Ground.of(calibration.read(path)[0], height, LENS)
    scene, light = simulated.scene, simulated.light
    return [convert_any(scene, sensors, ground, light, [], 0, channel, noise) for channel in range(12)]


def test_readings_of_12_bits_exceed_those_of_10(twelve_bits: str) -> None:
    readings = counts(twelve_bits, 2000 - 70)
    assert readings[FRONT][0] == 3985
    assert readings[GROUND_LEFT][0] == pytest.approx(3975, abs=40)
    # Light raises the counts: in the dark they are the largest count less those of the calibration.
    assert {ambient for _, ambient in readings} == {4095 - 980}


def test_proximity_below_0_keeps_its_sign_down_to_the_floor_of_the_calibration(twelve_bits: str) -> None:
    for noise, expected in ((0.0, -2), (-1.0, -5), (-3.0, -10)):
        assert counts(twelve_bits, 1000, noise=(noise, 0, 0))[BACK][0] == expected


def test_a_ground_sensor_that_is_higher_than_usual_reads_less(twelve_bits: str) -> None:
    usual, low = (counts(twelve_bits, 1000, height=height)[GROUND_LEFT][0] for height in (HEIGHT, HEIGHT / 2))
    assert (low - 30) / (usual - 30) == pytest.approx(((HEIGHT / 2 + LENS) / (HEIGHT + LENS)) ** 2, abs=0.01)
