"""The likelihood of ultrasonic readings."""

import math

import numpy as np
import pytest

from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.shadow.sonar_model import distances_of, sonar_likelihoods


def test_readings_are_distances_and_codes() -> None:
    distances = distances_of(KHEPERA_4, np.array([0, 30, 250, 1000, 2000]))
    assert distances[:4].tolist() == [0.0, 0.3, 2.5, math.inf]
    assert np.isnan(distances[4])


def test_a_distance_is_likely_where_it_is_expected_and_an_outlier_nowhere_impossible() -> None:
    expected = np.array([[0.5, 0.5], [0.55, 0.5], [1.5, math.inf], [0.0, 0.0]])
    likelihoods, largest = sonar_likelihoods(expected, np.array([0.5, 0.5]))
    first, second = likelihoods.T
    assert first[0] == second[0] == pytest.approx(largest[0])
    assert largest[0] > first[1] > first[2] > 0
    assert first[2] == first[3] == second[2] == second[3]


def test_a_code_is_likely_where_the_same_is_expected_and_a_disabled_sensor_tells_nothing() -> None:
    expected = np.array([[0.0, math.inf, 1.0], [0.3, 1.0, 0.0]])
    likelihoods, largest = sonar_likelihoods(expected, np.array([0.0, math.inf, math.nan]))
    assert (likelihoods[0, :2] > 10 * likelihoods[1, :2]).all()
    assert likelihoods[:, 2].tolist() == [1, 1]
    assert largest == pytest.approx(likelihoods[0])
