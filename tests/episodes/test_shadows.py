"""Shadows of obstacles and of the floor in a plane: against points along the ray."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from khep_twin.episodes.planar.plane import (
    BOTTOM,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    HALF_LENGTH,
    HALF_WIDTH,
    SINE,
    TOP,
)
from khep_twin.episodes.planar.shadows import is_path_blocked

N_COLUMNS = 1 + max(BOTTOM, CENTRE_X, CENTRE_Y, COSINE, HALF_LENGTH, HALF_WIDTH, SINE, TOP)
MARGIN = 0.002
"""Margin of the obstacle's sides; points are 0.5 mm apart [m]."""

PLACES = st.tuples(st.floats(-math.pi, math.pi), st.floats(0.02, 0.3), st.floats(0.005, 0.1))
"""Bearing, distance [m] and height [m] of a ray's start, from the obstacle's centre."""

RAYS = st.tuples(st.floats(-0.6, 0.6), st.floats(0.02, 0.7), st.integers(-200, 200))
"""Angle to the obstacle's centre, horizontal length [m] and rise [mm] of a ray."""


def is_any_point_hidden(
    obstacle: np.ndarray, position: np.ndarray, ray: np.ndarray, glass: float, margin: float
) -> bool:
    """Return whether a point before the glass is below the floor, or in the obstacle grown by a margin."""
    points = position + np.linspace(0, glass, 1001)[:, None] * ray
    dx, dy = points[:, 0] - obstacle[CENTRE_X], points[:, 1] - obstacle[CENTRE_Y]
    if obstacle[HALF_WIDTH] < 0:
        is_inside = np.hypot(dx, dy) < obstacle[HALF_LENGTH] + margin
    else:
        along = np.abs(dx * obstacle[COSINE] + dy * obstacle[SINE])
        across = np.abs(dy * obstacle[COSINE] - dx * obstacle[SINE])
        is_inside = (along < obstacle[HALF_LENGTH] + margin) & (across < obstacle[HALF_WIDTH] + margin)
    is_inside &= (points[:, 2] > obstacle[BOTTOM] - margin) & (points[:, 2] < obstacle[TOP] + margin)
    return bool((is_inside | (points[:, 2] < margin)).any())


@given(
    PLACES,
    RAYS,
    st.floats(0.1, 1),
    st.floats(0.01, 0.2),
    st.one_of(st.just(-1.0), st.floats(0.01, 0.2)),
    st.floats(-math.pi, math.pi),
    st.tuples(st.floats(0, 0.05), st.floats(0.01, 0.1)),
)
def test_a_ray_is_blocked_where_a_point_of_it_is_in_an_obstacle_or_below_the_floor(
    place: tuple[float, float, float],
    aim: tuple[float, float, int],
    glass: float,
    half_length: float,
    half_width: float,
    angle: float,
    span: tuple[float, float],
) -> None:
    bearing, distance, height = place
    offset, length, rise_mm = aim
    position, direction = (
        (distance * math.cos(bearing), distance * math.sin(bearing), height),
        offset + math.pi + bearing,
    )
    ray = length * math.cos(direction), length * math.sin(direction), rise_mm / 1000
    obstacle = np.zeros(N_COLUMNS)
    obstacle[[HALF_LENGTH, HALF_WIDTH, BOTTOM, TOP]] = half_length, half_width, span[0], sum(span)
    obstacle[[COSINE, SINE]] = math.cos(angle), math.sin(angle)
    assume(not is_any_point_hidden(obstacle, np.array(position), np.array(ray), 0.0, MARGIN))
    plane: Any = SimpleNamespace(obstacles=obstacle[None])
    is_blocked = is_path_blocked(plane, position, ray, glass)
    arguments = obstacle, np.array(position), np.array(ray), glass
    assert is_any_point_hidden(*arguments, -MARGIN) <= is_blocked <= is_any_point_hidden(*arguments, MARGIN)


@pytest.mark.parametrize(
    ("height", "rise", "glass", "is_blocked"),
    [
        (0.03, 0.0, 0.3, False),  # level, before the front at 1/3
        (0.03, 0.0, 0.5, True),  # within
        (0.03, 0.0, 1.0, True),  # behind the back at 2/3
        (0.08, -0.06, 0.45, False),  # falls through the top at 1/2
        (0.08, -0.06, 0.55, True),
        (0.08, -0.04, 1.0, False),  # falls to the top's height behind the back
    ],
)
def test_a_cylinder_blocks_a_ray_between_its_front_and_its_back_below_its_top(
    height: float, rise: float, glass: float, is_blocked: bool
) -> None:
    obstacle = np.zeros(N_COLUMNS)
    obstacle[[HALF_LENGTH, HALF_WIDTH, TOP]] = 0.1, -1, 0.05
    plane = SimpleNamespace(obstacles=obstacle[None])
    assert is_path_blocked(plane, (-0.3, 0.0, height), (0.6, 0.0, rise), glass) == is_blocked
