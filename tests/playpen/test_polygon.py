"""Polygons: area, contained points, crossings, and the walls around them."""

import math

import numpy as np
import pytest

from khep_twin.playpen.footprint import Rectangle
from khep_twin.playpen.polygon import (
    area,
    contains,
    corner_before,
    distance,
    find_crossing,
    wall_pieces,
    walls_around,
)

SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
L_SHAPE = [(0.0, 0.0), (300.0, 0.0), (300.0, 100.0), (100.0, 100.0), (100.0, 300.0), (0.0, 300.0)]


def covers(shapes: list[Rectangle], x: float, y: float) -> bool:
    for shape in shapes:
        offset = np.array([x - shape.x_mm, y - shape.y_mm])
        along, across = np.array(shape.axes()) @ offset
        if abs(along) < shape.length_mm / 2 - 1e-9 and abs(across) < shape.width_mm / 2 - 1e-9:
            return True
    return False


def test_the_area_of_a_polygon_has_the_sign_of_its_sense() -> None:
    assert area(SQUARE) == 10_000
    assert area(SQUARE[::-1]) == -10_000
    assert area(L_SHAPE) == 50_000


@pytest.mark.parametrize(
    ("points", "edges"),
    [
        (SQUARE, None),
        (L_SHAPE, None),
        ([SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]], (1, 3)),
        ([(0, 0), (100, 0), (50, 0), (50, 80)], (1, 2)),
        ([(0, 0), (100, 0), (100, 50), (50, 0), (0, 50)], (1, 3)),
    ],
)
def test_a_polygon_that_meets_itself_is_found(
    points: list[tuple[float, float]], edges: tuple[int, int] | None
) -> None:
    assert find_crossing(points) == edges


def test_what_is_inside_a_polygon() -> None:
    assert all(contains(L_SHAPE, x, y) for x, y in [(50, 50), (250, 50), (50, 250), (0, 0), (100, 200)])
    assert not any(contains(L_SHAPE, x, y) for x, y in [(150, 150), (-1, 50), (301, 50), (50, 301)])


def test_the_distance_to_a_polygon_is_that_to_its_nearest_edge_or_corner() -> None:
    assert distance(SQUARE, 30, 50) == 30
    assert distance(SQUARE, 130, 140) == pytest.approx(50)
    assert distance(L_SHAPE, 110, 110) == pytest.approx(10)


@pytest.mark.parametrize(
    "points", [SQUARE, SQUARE[::-1], L_SHAPE, [(0.0, 0.0), (600.0, 50.0), (250.0, 500.0)]]
)
def test_walls_around_a_polygon_are_outside_it_and_leave_no_gap(points: list[tuple[float, float]]) -> None:
    walls = walls_around(points, 10)
    assert len(walls) == len(points)
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-40, 640, (4000, 2)).tolist():
        inside = contains(points, x, y)
        assert not (inside and covers(walls, x, y))
        if not inside and distance(points, x, y) < 9.9:
            # A wall ends at a sharp corner where both outer faces meet; along edges it has no gap.
            near_corner = min(math.dist((x, y), corner) for corner in points) < 9.9
            assert covers(walls, x, y) or near_corner
    # A ray from the middle of each corner outwards hits a wall.
    for previous, corner, following in zip(
        [points[-1], *points], points, [*points[1:], points[0]], strict=False
    ):
        outwards = 2 * np.array(corner) - np.array(previous) / 2 - np.array(following) / 2 - np.array(corner)
        if contains(points, *(np.array(corner) - 1e-3 * outwards / np.linalg.norm(outwards))):
            assert covers(walls, *(np.array(corner) + 5 * outwards / np.linalg.norm(outwards)))


def test_a_free_standing_wall_is_rectangles_with_round_corners() -> None:
    line = [(0.0, 0.0), (100.0, 0.0), (100.0, 60.0)]
    shapes = list(wall_pieces(line, 8, closed=False))
    assert [type(shape).__name__ for shape in shapes] == ["Rectangle", "Rectangle", "Circle"]
    assert [shape.length_mm for shape in shapes if isinstance(shape, Rectangle)] == [100, 60]
    assert len(list(wall_pieces(line, 8, closed=True))) == 6


@pytest.mark.parametrize("points", [L_SHAPE, L_SHAPE[::-1]])
def test_a_wall_is_named_by_the_corner_before_it_in_the_files_order(
    points: list[tuple[float, float]],
) -> None:
    for index, wall in enumerate(walls_around(points, 2)):
        number = corner_before(points, index)
        middle = np.add(points[number - 1], points[number % len(points)]) / 2
        assert np.hypot(*(middle - (wall.x_mm, wall.y_mm))) < 2
