"""Adjoining blocks become one geom, without other changes."""

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.kernel import PROXIMITY
from khep_twin.playpen import Block
from khep_twin.playpen.merge import merge_blocks
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.world import World


def block(x_mm: float, y_mm: float, length_mm: float = 40, width_mm: float = 10, **keys: object) -> Block:
    values = {"x_mm": x_mm, "y_mm": y_mm, "length_mm": length_mm, "width_mm": width_mm, "height_mm": 50.0}
    return Block.model_validate({**values, **keys})


def test_blocks_in_a_line_that_touch_or_cross_are_one() -> None:
    ((number, one),) = merge_blocks([block(100, 50), block(140, 50), block(170, 50)])
    assert (number, one.x_mm, one.y_mm, one.length_mm, one.width_mm) == (0, 135, 50, 110, 10)


def test_blocks_side_by_side_are_one_across() -> None:
    ((_, one),) = merge_blocks([block(100, 50), block(100, 60)])
    assert (one.y_mm, one.length_mm, one.width_mm) == pytest.approx((55, 40, 20))


def test_a_checker_of_squares_becomes_one_block() -> None:
    squares = [block(10 + 20 * i, 10 + 20 * k, 20, 20) for i in range(4) for k in range(3)]
    ((_, one),) = merge_blocks(squares)
    assert (one.x_mm, one.y_mm, one.length_mm, one.width_mm) == pytest.approx((40, 30, 80, 60))


def test_slanting_blocks_are_merged_along_their_own_axis() -> None:
    step = 40 / np.sqrt(2)
    ((_, one),) = merge_blocks(
        [block(100, 100, angle_deg=45.0), block(100 + step, 100 + step, angle_deg=45.0)]
    )
    assert one.length_mm == pytest.approx(80)
    np.testing.assert_allclose([one.x_mm, one.y_mm], 100 + step / 2)


def test_what_differs_is_named_moves_or_leaves_a_gap_stays_apart() -> None:
    first = block(100, 50)
    for other in (
        block(141, 50),
        block(140, 51),
        block(140, 50, width_mm=11),
        block(140, 50, height_mm=40.0),
        block(140, 50, surface="black"),
        block(140, 50, name="mine"),
        block(140, 50, movable=True),
        block(140, 50, angle_deg=1.0),
    ):
        assert [number for number, _ in merge_blocks([first, other])] == [0, 1]


def test_a_scene_has_fewer_geoms_and_looks_the_same_to_a_robot() -> None:
    head = 'version = 1\nname = "m"\n[arena]\nwidth_mm = 400\nheight_mm = 400\n'
    robot = "[[robot]]\nx_mm = 200\ny_mm = 200\nheading_deg = 20\n"
    table = "[[block]]\nx_mm = {}\ny_mm = 245\nlength_mm = {}\nwidth_mm = 10\nheight_mm = 50\n"
    split = playpen.parse(head + robot + "".join(table.format(110 + 20 * i, 20) for i in range(10)), "m")
    merged = playpen.parse(head + robot + table.format(200, 200), "m")
    assert to_spec(split).compile().ngeom == to_spec(merged).compile().ngeom
    readings = [
        World(world_playpen, noise=False).robots[0].registers[PROXIMITY] for world_playpen in (split, merged)
    ]
    np.testing.assert_array_equal(*readings)
    assert readings[0].max() > 100
