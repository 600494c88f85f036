"""Obstacle fields: the requested density, lanes for a robot, and reproducibility by the seed."""

import itertools
import math

import numpy as np
import pytest

from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen.footprint import Circle, overlap
from khep_twin.playpen.random_obstacles import LANE_MM, _grow, obstacle_field


def field(density: float, seed: int) -> Playpen:
    return obstacle_field("field", 1000, 1000, density, np.random.default_rng(seed))


@pytest.mark.parametrize("density", [0.0, 0.02, 0.06])
@pytest.mark.parametrize("seed", range(3))
def test_a_field_covers_what_was_asked_and_leaves_lanes(density: float, seed: int) -> None:
    playpen = field(density, seed)
    shapes = [item.footprint for item in (*playpen.blocks, *playpen.cylinders)]
    area = sum(
        math.pi * shape.radius_mm**2 if isinstance(shape, Circle) else shape.length_mm * shape.width_mm
        for shape in shapes
    )
    assert density <= area / 1e6 < density + 0.015
    for one, other in itertools.combinations([*shapes, playpen.robots[0].footprint], 2):
        # A grown rectangle has corners farther off; one of the two tests suffices.
        grown, other_grown = (_grow(shape, LANE_MM - 1e-6) for shape in (one, other))
        assert not (overlap(grown, other) and overlap(one, other_grown))
    for shape in shapes:
        for direction in ((1.0, 0.0), (0.0, 1.0)):
            middle = shape.x_mm if direction[0] else shape.y_mm
            assert LANE_MM <= middle - shape.reach(direction) + 0.1
            assert middle + shape.reach(direction) <= 1000 - LANE_MM + 0.1


def test_the_same_seed_draws_the_same_field() -> None:
    assert field(0.05, 1) == field(0.05, 1)
    assert field(0.05, 1) != field(0.05, 2)


@pytest.mark.parametrize("density", [-0.1, 0.11, math.nan])
def test_what_cannot_be_is_refused(density: float) -> None:
    with pytest.raises(PlaypenError, match=r"expected 0 to 0\.1"):
        field(density, 1)
    with pytest.raises(PlaypenError, match="there was room for"):
        obstacle_field("small", 200, 200, 0.1, np.random.default_rng(1))
