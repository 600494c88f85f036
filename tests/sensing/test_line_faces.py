"""Faces of boxes and stripes for a line camera: their ends, heights and outer sides."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.sensing.line_faces import set_stripe, set_upright
from khep_twin.sensing.line_scene import (
    BOTTOM,
    END_X,
    END_Y,
    GLOW,
    N_COLUMNS,
    RADIUS,
    REFLECTANCE,
    ROLE,
    TOP,
    VISIBLE,
    X,
    Y,
)

LENGTHS = st.floats(-2, 2)
SIZES = st.floats(0.001, 0.5)
ANGLES = st.floats(-math.pi, math.pi)


def rotation(angle: float) -> list[float]:
    """Return the matrix of a turn about the vertical."""
    c, s = math.cos(angle), math.sin(angle)
    return [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0]


@given(LENGTHS, LENGTHS, LENGTHS, ANGLES, SIZES, SIZES, st.floats(0, 1), st.integers(0, 2))
def test_a_stripe_goes_from_its_left_to_its_right_end_and_over_its_height(
    x: float,
    y: float,
    z: float,
    angle: float,
    half_width: float,
    half_height: float,
    reflectance: float,
    count: int,
) -> None:
    faces = np.zeros((4, N_COLUMNS))
    size = half_width, 0.0005, half_height
    assert set_stripe(faces, count, (x, y, z), rotation(angle), size, reflectance) == count + 1
    matrix = np.array(rotation(angle)).reshape(3, 3)
    corners = [np.array([x, y, z]) + matrix @ [side * half_width, 0, 0] for side in (-1, 1)]
    row = faces[count]
    assert row[[X, Y]] == pytest.approx(corners[0][:2])
    assert row[[END_X, END_Y]] == pytest.approx(corners[1][:2])
    assert row[[BOTTOM, TOP]] == pytest.approx([z - half_height, z + half_height])
    assert row[[RADIUS, REFLECTANCE, GLOW, ROLE]].tolist() == [0, reflectance, 0, VISIBLE]
    assert not faces[[number for number in range(4) if number != count]].any()


@given(LENGTHS, LENGTHS, ANGLES, SIZES, SIZES)
def test_the_faces_of_a_box_run_around_it_with_their_outer_sides_outside(
    x: float, y: float, angle: float, half: float, width: float
) -> None:
    faces = np.zeros((4, N_COLUMNS))
    shape = (x, y), (math.cos(angle), math.sin(angle)), (half, width), (0.01, 0.05)
    assert set_upright(faces, 0, shape, 0.5, VISIBLE) == 4
    starts, ends = faces[:, [X, Y]], faces[:, [END_X, END_Y]]
    turn = np.array(rotation(angle)).reshape(3, 3)[:2, :2]
    corners = [np.array([x, y]) + turn @ [a * half, b * width] for a in (-1, 1) for b in (-1, 1)]
    for points in (starts, ends):
        assert np.sort(points.round(9), axis=0) == pytest.approx(np.sort(np.round(corners, 9), axis=0))
    for start, end in zip(starts, ends, strict=True):
        along, middle = end - start, (start + end) / 2 - [x, y]
        normal = np.array([along[1], -along[0]])
        assert normal @ middle > 0
        assert sum(np.allclose(end, other) for other in starts) == 1
    assert faces[:, [BOTTOM, TOP]].tolist() == [[0.01, 0.05]] * 4
