"""Bitmaps become playpens: exact blocks, walls of the arena, a robot at a free position."""

from typing import Any

import mujoco
import numpy as np
import pytest
from drawn_bitmap import drawn, seen_from_above
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.errors import BitmapError
from khep_twin.playpen.bitmap import Borders, cover_with_rectangles, strip_borders, to_playpen
from khep_twin.playpen_to_mjcf import to_mjcf
from khep_twin.units import BODY_RADIUS


def empty_bitmap(rows: int = 200, columns: int = 300) -> NDArray[np.bool_]:
    return np.zeros((rows, columns), dtype=np.bool_)


@settings(max_examples=100, derandomize=True, database=None)
@given(arrays.arrays(np.bool_, arrays.array_shapes(min_dims=2, max_dims=2, max_side=24)))
def test_rectangles_cover_exactly_the_solid_pixels_without_overlap(solid: NDArray[np.bool_]) -> None:
    covered = np.zeros(solid.shape, dtype=np.int64)
    for row, column, rows, columns in cover_with_rectangles(solid).tolist():
        assert rows > 0
        assert columns > 0
        covered[row : row + rows, column : column + columns] += 1
    np.testing.assert_array_equal(covered, solid)


@settings(max_examples=50, derandomize=True, database=None)
@given(arrays.arrays(np.bool_, arrays.array_shapes(min_dims=2, max_dims=2, max_side=12)), st.booleans())
def test_any_bitmap_becomes_its_playpen_or_is_reported_to_be_solid(
    solid: NDArray[np.bool_], walled: bool
) -> None:
    solid = np.pad(solid, 1, constant_values=walled)
    if solid.all():
        with pytest.raises(BitmapError, match="every pixel is solid"):
            to_playpen(solid, "x", mm_per_pixel=120.0)
        return
    imported = to_playpen(solid, "x", mm_per_pixel=120.0, place_robot=False)
    inner, borders = strip_borders(solid)
    assert imported.borders == borders
    middles = [
        (block.x_mm, block.y_mm, block.length_mm * block.width_mm) for block in imported.playpen.blocks
    ]
    assert sum(area for _, _, area in middles) == 120**2 * inner.sum()
    assert playpen.parse(playpen.dump(imported.playpen), "x") == imported.playpen


def test_a_drawing_is_the_same_playpen_seen_from_above_to_the_pixel() -> None:
    solid = drawn()
    imported = to_playpen(solid, "drawn")
    np.testing.assert_array_equal(seen_from_above(imported.playpen), solid[10:-10, 10:-10])
    assert not (solid == solid[::-1]).all()


def test_the_compiled_scene_stands_as_the_drawing() -> None:
    solid = drawn()
    imported = to_playpen(solid, "drawn", robot=(300.0, 240.0, 0.0))
    model: Any = mujoco.MjModel.from_xml_string(to_mjcf(imported.playpen))
    data: Any = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit_geom = np.array([-1], dtype=np.int32)
    scene_pixels = empty_bitmap(480, 580)
    names = {model.geom(number).id: model.geom(number).name for number in range(model.ngeom)}
    pixels = [(row, column) for row in range(0, 480, 3) for column in range(0, 580, 3)]
    for row, column in pixels:
        ray_origin = np.array([(column + 0.5) / 1000, (479.5 - row) / 1000, 0.5])
        mujoco.mj_ray(model, data, ray_origin, np.array([0.0, 0.0, -1.0]), None, 1, -1, hit_geom)
        scene_pixels[row, column] = names[int(hit_geom[0])].startswith("block")
    n_different = sum(scene_pixels[pixel] != solid[10:-10, 10:-10][pixel] for pixel in pixels)
    assert n_different <= 0.01 * sum(solid[10:-10, 10:-10][pixel] for pixel in pixels)


def test_equal_walls_become_the_arenas_with_their_thickness() -> None:
    imported = to_playpen(drawn(wall=12), "x")
    assert imported.borders == Borders(12, 12, 12, 12)
    assert (imported.playpen.arena.width_mm, imported.playpen.arena.height_mm) == (576, 476)
    assert imported.playpen.arena.wall_thickness_mm == 12


def test_unequal_walls_are_taken_off_and_become_the_usual_ones() -> None:
    solid = empty_bitmap()
    solid[:5], solid[:, -7:] = True, True
    imported = to_playpen(solid, "x")
    assert imported.borders == Borders(left=0, right=7, bottom=0, top=5)
    assert (imported.playpen.arena.width_mm, imported.playpen.arena.height_mm) == (293, 195)
    assert imported.playpen.arena.wall_thickness_mm == 10
    assert imported.playpen.blocks == ()


def test_without_walls_the_arena_has_the_whole_size() -> None:
    solid = empty_bitmap()
    solid[0, 0] = True
    imported = to_playpen(solid, "x", mm_per_pixel=2)
    assert (imported.playpen.arena.width_mm, imported.playpen.arena.height_mm) == (600, 400)
    (block,) = imported.playpen.blocks
    assert (block.x_mm, block.y_mm, block.length_mm, block.width_mm) == (1, 399, 2, 2)
    assert imported.playpen.arena.wall_thickness_mm == 10


def test_columns_cost_fewer_blocks_where_they_do() -> None:
    solid = empty_bitmap()
    for column in range(0, 300, 10):
        solid[column % 70 : 150, column] = True
    assert len(cover_with_rectangles(solid)) == 30
    assert len(cover_with_rectangles(solid.T)) == 30


def test_the_robot_stands_in_the_middle_where_it_is_free_and_beside_it_elsewhere() -> None:
    (robot,) = to_playpen(empty_bitmap(), "x").playpen.robots
    assert (robot.x_mm, robot.y_mm, robot.heading_deg) == (150, 100, 90)
    solid = empty_bitmap()
    solid[80:120, 130:180] = True
    (robot,) = to_playpen(solid, "x").playpen.robots
    distance = np.hypot(*(np.argwhere(solid) + 0.5 - (200 - robot.y_mm, robot.x_mm)).T).min()
    assert BODY_RADIUS * 1000 + 1 <= distance + 0.8
    assert np.hypot(robot.x_mm - 150, robot.y_mm - 100) < 50


def test_without_a_free_place_there_is_no_robot_and_the_playpen_is_right() -> None:
    solid = empty_bitmap()
    solid[::40], solid[:, ::40] = True, True
    imported = to_playpen(solid, "x")
    assert imported.playpen.robots == ()
    assert playpen.parse(playpen.dump(imported.playpen), "x") == imported.playpen


@pytest.mark.long
def test_as_many_blocks_as_a_playpen_may_hold_are_written_so_that_they_load() -> None:
    solid = np.zeros((200, 200), dtype=np.bool_)
    solid.reshape(-1)[np.arange(4999) * 2 + np.arange(4999) * 2 // 200 % 2] = True
    imported = to_playpen(solid, "x", mm_per_pixel=33.333333)
    assert len(imported.playpen.blocks) == 4999
    text = playpen.dump(imported.playpen)
    assert len(text) < 2**20
    assert len(playpen.parse(text, "x").blocks) == 4999


def checkerboard(side: int) -> NDArray[np.bool_]:
    return np.indices((side, side)).sum(axis=0) % 2 == 0


def pixel_bitmap() -> NDArray[np.bool_]:
    solid = empty_bitmap()
    solid[100, 150] = True
    return solid


@pytest.mark.parametrize(
    ("solid", "options", "line"),
    [
        (
            checkerboard(200), {},
            "20000 blocks; expected up to 4999, as from a picture of fewer pixels with a larger "
            "--mm-per-pixel",
        ),
        (
            pixel_bitmap(), {"mm_per_pixel": 0.5},
            "a block of 0.5 mm; expected at least 1 mm, as from a picture of fewer pixels with a larger "
            "--mm-per-pixel",
        ),
        (np.ones((9, 9), dtype=np.bool_), {}, "every pixel is solid; expected a bitmap with a free floor"),
        (
            empty_bitmap(50, 600), {},
            "an arena of 600 x 50 mm within the walls; expected 100 to 10000 mm a side, as with another "
            "--mm-per-pixel",
        ),
        (
            empty_bitmap(4097, 200), {}, "4097 x 200 pixels; expected 1 to 4096 rows and columns",
        ),
        (empty_bitmap(0, 200), {}, "0 x 200 pixels; expected 1 to 4096 rows and columns"),
        (
            pixel_bitmap(), {"mm_per_pixel": float("nan")},
            "--mm-per-pixel nan; expected a number from 0.001 to 1000",
        ),
        (pixel_bitmap(), {"mm_per_pixel": 0.0}, "--mm-per-pixel 0; expected a number from 0.001 to 1000"),
        (pixel_bitmap(), {"height_mm": 1001.0}, "--height-mm 1001; expected a number from 1 to 1000"),
        (
            pixel_bitmap(), {"robot": (150.0, 100.0, 0.0)},
            "robot 1 at (150, 100) overlaps block 1 at (150.5, 99.5); expected a place clear of it",
        ),
        (pixel_bitmap(), {"robot": (150.0, 30.0, 400.0)},
         "robot 1: heading_deg = 400.0; expected a number from -360 to 360"),
        (pixel_bitmap(), {"name": "a b"}, "name = \"a b\"; expected 1 to 64 letters, digits, '_' or '-'"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_playpen_is_reported_in_one_line(
    solid: NDArray[np.bool_], options: dict[str, Any], line: str
) -> None:
    with pytest.raises(BitmapError) as caught:
        to_playpen(solid, **{"name": "x", **options})
    assert str(caught.value) == line
