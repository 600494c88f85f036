"""Placement: detection of overlapping parts in an arena."""

import itertools
import re

import numpy as np
import pytest
from numpy.typing import NDArray

from khep_twin.playpen.footprint import Circle, Footprint, Rectangle, overlap
from khep_twin.playpen.overlap import PlacedPart, part_label, placement_problems
from khep_twin.playpen.parts import Arena

Points = NDArray[np.float64]


def arena(side_mm: float) -> Arena:
    return Arena(width_mm=side_mm, height_mm=side_mm)


def block(
    number: int, footprint: Footprint, *, is_free: bool = True, bottom: float = 0, top: float = 50
) -> PlacedPart:
    return PlacedPart("block", number, None, footprint, bottom, top, is_free)


def contains(shape: Footprint, points: Points) -> NDArray[np.bool_]:
    """Return whether points (n, 2) lie in a shape (n,)."""
    offsets = points - np.array((shape.x_mm, shape.y_mm))
    if isinstance(shape, Circle):
        return np.hypot(*offsets.T) < shape.radius_mm
    along, across = np.array(shape.axes()) @ offsets.T
    return (abs(along) < shape.length_mm / 2) & (abs(across) < shape.width_mm / 2)


def grow(shape: Footprint, by_mm: float) -> Footprint:
    if isinstance(shape, Circle):
        return Circle(shape.x_mm, shape.y_mm, shape.radius_mm + by_mm)
    length_mm, width_mm = shape.length_mm + by_mm, shape.width_mm + by_mm
    return Rectangle(shape.x_mm, shape.y_mm, length_mm, width_mm, shape.angle_deg)


def random_shapes(n: int) -> list[Footprint]:
    rng = np.random.default_rng(1)
    shapes: list[Footprint] = []
    for _ in range(n):
        x, y, length, width, angle = rng.uniform((50, 50, 5, 5, -360), (250, 250, 40, 40, 360)).tolist()
        shapes += [Circle(x, y, width / 2), Rectangle(y, x, length, width, angle)]
    return shapes


def test_shapes_overlap_exactly_where_they_share_points() -> None:
    axis = np.arange(0, 300, 1.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    shapes = [
        (shape, contains(shape, points), contains(grow(shape, 3), points)) for shape in random_shapes(12)
    ]
    for (one, points_in_one, points_near_one), (
        other,
        points_in_other,
        points_near_other,
    ) in itertools.combinations(shapes, 2):
        assert overlap(one, other) == overlap(other, one)
        if (points_in_one & points_in_other).any():
            assert overlap(one, other)
        # Between points 1 mm apart only a sliver can be missed.
        if not (points_near_one & points_near_other).any():
            assert not overlap(one, other)


def test_each_free_thing_is_held_against_every_other_thing() -> None:
    parts = [
        block(number, shape, is_free=number % 3 == 0) for number, shape in enumerate(random_shapes(12), 1)
    ]
    expected = {
        (one.number, other.number)
        for one, other in itertools.combinations(parts, 2)
        if (one.is_free or other.is_free) and overlap(one.footprint, other.footprint)
    }
    pairs = [re.findall(r"block (\d+)", problem.text) for problem in placement_problems(parts, arena(1000))]
    assert {tuple(sorted(map(int, numbers))) for numbers in pairs} == expected
    assert len(pairs) == len(expected) > 5


def test_fixed_things_may_overlap() -> None:
    assert not list(placement_problems([block(1, Circle(50, 50, 9), is_free=False)] * 2, arena(100)))


@pytest.mark.parametrize(("bottom", "n_problems"), [(50, 0), (49.9, 1)])
def test_things_above_each_other_are_clear_of_each_other(bottom: float, n_problems: int) -> None:
    parts = [block(1, Circle(50, 50, 9)), block(2, Circle(50, 50, 9), bottom=bottom, top=90)]
    assert len(list(placement_problems(parts, arena(100)))) == n_problems


def test_a_label_has_kind_number_and_name() -> None:
    assert part_label("block", 2, None) == "block 2"
    assert part_label("block", 2, "pillar") == "block 2 (pillar)"
