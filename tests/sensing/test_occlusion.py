"""Sight lines that are surely clear: rays agree wherever they say so, and they say so often."""

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.sensing import optics
from khep_twin.sensing.ambient import light_of
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.scene import MANY
from khep_twin.units import SENSOR_HEIGHT
from khep_twin.world import World


def share_of_clear(text: str, n: int = 400) -> float:
    """Asserts that rays see all of each lamp where it is said to be clear; the share of such places."""
    world = World(playpen.parse(text, "sight"), noise=False)
    lines = SightLines(world.model, world.robots[0].indices, world.lamps.positions)
    light, plain = light_of(lines, playpen.Lighting()), world.simulation.plain
    sensors = plain.robots[0].sensors
    place = world.data.cam_xpos[sensors.cameras[0]]
    width, depth = world.playpen.arena.width_mm / 1e3, world.playpen.arena.height_mm / 1e3
    clear = 0
    for x, y in np.random.default_rng(7).uniform((0, 0), (width, depth), (n, 2)).tolist():
        for lamp, at in enumerate(world.lamps.positions):
            if optics.clear(light, lamp, x, y):
                clear += 1
                place[:] = x, y, SENSOR_HEIGHT
                way = at[0] - x, at[1] - y, at[2] - SENSOR_HEIGHT
                distance = float(np.linalg.norm(way))
                if distance > 0.03:
                    assert optics.part_of_bulb(plain.scene, sensors, 0, way, distance, MANY) == 1, (
                        x,
                        y,
                        lamp,
                    )
    return clear / n / len(world.lamps.positions)


@pytest.mark.parametrize("name", ["default", "obstacles", "two-lamps", "light-seeking", "t-maze"])
def test_where_a_line_is_clear_rays_reach_all_of_the_bulb(name: str) -> None:
    text = playpen.dump(playpen.load(name))
    if "[[lamp]]" not in text:
        text += "[[lamp]]\nx_mm = 100\ny_mm = 100\npower_w = 1\n"
    # The sign of the T-maze hangs right at a wall, which may hide it from anywhere.
    assert share_of_clear(text) >= (0 if name == "t-maze" else 0.4)


def test_things_in_all_directions_and_sizes_are_seen() -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        text = 'version = 1\nname = "many"\n[arena]\nwidth_mm = 800\nheight_mm = 600\n'
        text += "[[robot]]\nx_mm = 30\ny_mm = 30\nheading_deg = 0\n"
        for x, y, length, angle in rng.uniform((80, 80, 5, -180), (760, 560, 90, 180), (6, 4)).tolist():
            text += (
                f"[[block]]\nx_mm = {x}\ny_mm = {y}\nlength_mm = {length}\nwidth_mm = 8\nheight_mm = 50\n"
                f"angle_deg = {angle}\n"
                f"[[cylinder]]\nx_mm = {y}\ny_mm = {x * 0.7}\nradius_mm = {length / 4}\nheight_mm = 50\n"
            )
        for x, y in rng.uniform((10, 10), (790, 590), (3, 2)).tolist():
            text += f"[[lamp]]\nx_mm = {x}\ny_mm = {y}\npower_w = 1\nz_mm = 40\n"
        assert share_of_clear(text, 200) > 0.02


@pytest.mark.parametrize(
    "other",
    [
        "[[robot]]\nx_mm = 500\ny_mm = 400\nheading_deg = 0\n",
        "[[cylinder]]\nx_mm = 500\ny_mm = 400\nradius_mm = 9\nheight_mm = 50\nmovable = true\n",
    ],
)
def test_where_something_may_move_nothing_is_known(other: str) -> None:
    text = playpen.dump(playpen.load("default")) + "[[lamp]]\nx_mm = 100\ny_mm = 100\npower_w = 1\n"
    assert share_of_clear(text, 50) == 1
    assert share_of_clear(text + other, 50) == 0
