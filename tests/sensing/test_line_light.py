"""Light of lamps on faces and cylinders, against the law of illuminance in vectors."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from khep_twin.sensing.line_light import INTENSITY, face_illuminance
from khep_twin.sensing.line_scene import N_COLUMNS, LineScene
from khep_twin.units import BULB_RADIUS

LENGTHS = st.floats(-2, 2)
HEIGHTS = st.floats(0, 0.5)
ANGLES = st.floats(-math.pi, math.pi)


def scene(face: list[float], lamps: list[tuple[float, ...]], room_lux: float) -> LineScene:
    """Return a scene with one face and lamps: x, y, z, power and 1 if the light is not blocked."""
    unused: Any = None
    row = np.zeros((1, N_COLUMNS))
    row[0, : len(face)] = face
    table = np.array(lamps).reshape(-1, 5)
    return LineScene(
        row, np.array([1]), table[:, :4], np.array([room_lux]), unused, unused, unused,
        table[:, 4].astype(int), unused,
    )  # fmt: skip


def expected_lux(
    lamps: list[tuple[float, ...]], point: np.ndarray, normal: np.ndarray, room_lux: float
) -> float:
    total = room_lux
    for *position, power, is_visible in lamps:
        ray = np.array(position) - point
        distance = float(np.linalg.norm(ray))
        assume(distance > BULB_RADIUS)
        total += is_visible * INTENSITY * power * max(float(ray @ normal) / distance, 0.0) / distance**2
    return total


LAMPS = st.lists(st.tuples(LENGTHS, LENGTHS, HEIGHTS, st.floats(0, 50), st.sampled_from([0, 1])), max_size=3)


@given(LAMPS, LENGTHS, LENGTHS, HEIGHTS, ANGLES, st.floats(0.01, 1), st.floats(0, 500))
def test_a_face_has_the_light_of_each_lamp_that_is_before_it(
    lamps: list[tuple[float, ...]],
    x: float,
    y: float,
    height: float,
    angle: float,
    length: float,
    room_lux: float,
) -> None:
    # From the left end to the right end, as seen from outside: the normal is a quarter turn to the right.
    end = [x + length * math.cos(angle), y + length * math.sin(angle)]
    normal = np.array([math.sin(angle), -math.cos(angle), 0.0])
    lux = face_illuminance(scene([x, y, *end], lamps, room_lux), 0, x, y, height)
    assert lux == pytest.approx(expected_lux(lamps, np.array([x, y, height]), normal, room_lux), rel=1e-6)


@given(LAMPS, LENGTHS, LENGTHS, HEIGHTS, ANGLES, st.floats(0.005, 0.2), st.floats(0, 500))
def test_a_cylinder_has_the_light_of_each_lamp_that_its_point_faces(
    lamps: list[tuple[float, ...]],
    x: float,
    y: float,
    height: float,
    angle: float,
    radius: float,
    room_lux: float,
) -> None:
    normal = np.array([math.cos(angle), math.sin(angle), 0.0])
    point = np.array([x, y, height]) + radius * normal
    lux = face_illuminance(scene([x, y, 0, 0, radius], lamps, room_lux), 0, *point.tolist())
    assert lux == pytest.approx(expected_lux(lamps, point, normal, room_lux), rel=1e-6)


@given(st.floats(0, 2 * BULB_RADIUS), st.floats(0, 50))
def test_the_light_within_a_bulb_is_finite(distance: float, power: float) -> None:
    lamps = [(distance, 0.0, 0.0, power, 1)]
    lux = face_illuminance(scene([0, 0, 0, 1], lamps, 0.0), 0, 0.0, 0.0, 0.0)
    assert 0 <= lux <= INTENSITY * power / BULB_RADIUS**2 * (1 + 1e-9)
