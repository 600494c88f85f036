"""Light on the floor: distance, power and shadows."""

import numpy as np
import pytest

from khep_twin import playpen as playpens
from khep_twin.drawing.light_map import illumination
from khep_twin.units import SENSOR_HEIGHT

ARENA = 'version = 1\nname = "p"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
LAMP = "[[lamp]]\nx_mm = 100\ny_mm = 250\nz_mm = 13.4\npower_w = 8\n"
BLOCK = "[[block]]\nx_mm = 200\ny_mm = 250\nlength_mm = 20\nwidth_mm = 100\nheight_mm = 50\n"
CYLINDER = "[[cylinder]]\nx_mm = 200\ny_mm = 250\nradius_mm = 50\nheight_mm = 50\n"


def light(text: str, x_mm: float, y_mm: float) -> float:
    playpen = playpens.parse(ARENA + text, "p.toml")
    return illumination(playpen, np.array([x_mm]), np.array([y_mm])).item()


def test_light_falls_with_the_square_of_the_distance_and_lamps_add() -> None:
    assert light(LAMP, 300, 250) == pytest.approx(8 / 200**2)
    assert light(LAMP + LAMP.replace("x_mm = 100", "x_mm = 500"), 300, 250) == pytest.approx(16 / 200**2)
    assert light("", 300, 250) == 0


def test_the_height_of_a_lamp_counts_from_the_sensors_height() -> None:
    rise = 100 - 1000 * SENSOR_HEIGHT
    assert light(LAMP.replace("13.4", "100"), 300, 250) == pytest.approx(8 / (200**2 + rise**2))


@pytest.mark.parametrize("thing", [BLOCK, BLOCK + "angle_deg = 180\n", CYLINDER])
def test_it_is_dark_behind_things_and_nowhere_else(thing: str) -> None:
    assert light(LAMP + thing, 300, 250) == 0
    assert light(LAMP + thing, 500, 320) == 0
    assert light(LAMP + thing, 140, 250) > 0
    assert light(LAMP + thing, 100, 400) > 0
    assert light(LAMP + thing, 300, 400) > 0
    assert light(LAMP + thing, 20, 250) > 0


@pytest.mark.parametrize("angle_deg", [0, 45, 90])
def test_a_turned_block_casts_the_shadow_of_its_width_across(angle_deg: int) -> None:
    block = BLOCK.replace("width_mm = 100", "width_mm = 2") + f"angle_deg = {angle_deg}\n"
    # Seen from the lamp, the block's end is this far from the middle, twice as far at twice the distance.
    end = 10 * np.sin(np.radians(angle_deg)) + 1 * np.cos(np.radians(angle_deg))
    assert light(LAMP + block, 300, 250 + 1.7 * end) == 0
    assert light(LAMP + block, 300, 250 + 2.7 * end) > 0


def test_the_shadow_of_a_low_thing_below_a_high_lamp_ends() -> None:
    lamp = LAMP.replace("13.4", "213.4")
    # The ray over the block's far edge, 110 mm from the lamp and 150 mm below it, is at sensor height after
    # 110 * 200 / 163.4 mm.
    assert light(lamp + BLOCK, 100 + 134, 250) == 0
    assert light(lamp + BLOCK, 100 + 136, 250) > 0


def test_a_lamp_beside_a_wall_of_blocks_is_not_hidden_by_what_its_glass_touches() -> None:
    block = BLOCK.replace("x_mm = 200", "x_mm = 85")
    assert light(LAMP + block, 300, 250) > 0


def test_light_close_to_a_bulb_is_finite() -> None:
    assert light(LAMP, 100, 250) == pytest.approx(8 / 10**2)
