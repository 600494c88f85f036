"""Objects in front of a robot: distances and bearings from its poses, also with misplacements."""

import math

import numpy as np
import pytest

from khep_twin.errors import FitError
from khep_twin.lab.fit.placement import Misplacement, Placement, Ruler
from khep_twin.units import BODY_RADIUS

APPROACH = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.01, 0.3]])


def test_a_cylinder_to_the_left_is_seen_at_a_larger_bearing_the_nearer_it_comes() -> None:
    moved = Misplacement(0.002, math.radians(5))
    distances, bearings = Placement(APPROACH, 0.03, 0.01).object_positions(moved)
    away = BODY_RADIUS + 0.042
    centre = away * np.array([math.cos(moved.bearing), math.sin(moved.bearing)])
    to = centre - APPROACH[:, :2]
    np.testing.assert_allclose(distances, np.hypot(*to.T) - 0.01 - BODY_RADIUS)
    np.testing.assert_allclose(bearings, np.arctan2(to[:, 1], to[:, 0]) - APPROACH[:, 2])
    assert bearings[1] > bearings[0] == pytest.approx(math.radians(5))


def test_a_wall_that_stands_askew_comes_nearer_by_less_than_the_way() -> None:
    distances, bearings = Placement(APPROACH, 0.03).object_positions(Misplacement(0.0, 0.1))
    normal = np.array([math.cos(0.1), math.sin(0.1)])
    np.testing.assert_allclose(distances, 0.03 - APPROACH[:, :2] @ normal)
    np.testing.assert_allclose(bearings, 0.1 - APPROACH[:, 2])


def test_a_robot_that_turns_more_than_it_counts_sees_the_wall_farther_behind() -> None:
    turn = np.column_stack([np.zeros((3, 2)), [0, 1, 2]])
    _, bearings = Placement(turn, 0.03).object_positions(Misplacement(turn_error=0.01))
    np.testing.assert_allclose(bearings, [0, -1.01, -2.02])


def test_a_robot_of_unequal_wheels_turns_about_a_point_beside_its_axle() -> None:
    turn = np.column_stack([np.zeros((3, 2)), [0, math.pi / 2, math.pi]])
    moved = Misplacement(centre=0.001)
    distances, _ = Placement(turn, 0.03).object_positions(moved)
    np.testing.assert_allclose(distances, [0.03, 0.029, 0.03])
    distances, _ = Placement(turn, 0.03, 0.01).object_positions(moved)
    away = np.hypot([0.04 + BODY_RADIUS, 0.039 + BODY_RADIUS, 0.04 + BODY_RADIUS], [0, 0.001, 0.002])
    np.testing.assert_allclose(distances, away - 0.01 - BODY_RADIUS)


@pytest.mark.parametrize(("mm", "deg"), [(-1, 1.5), (0.5, -1), (0.5, math.nan), (50, 1)])
def test_a_ruler_that_no_test_can_be_fitted_with_is_refused(mm: float, deg: float) -> None:
    with pytest.raises(FitError, match="expected a standard deviation of 0 to"):
        Ruler(mm, deg)
