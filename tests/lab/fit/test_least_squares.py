"""Least squares against closed forms: weighted means, priors, fixed parameters."""

import numpy as np
import pytest

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import CONFIDENCE, Parameter, least_squares


def test_a_prior_counts_as_one_more_measurement() -> None:
    """Mean of 4 readings and a prior, all of variance 1."""
    readings = np.array([1.8, 2.0, 2.0, 2.2])
    estimate = least_squares(
        lambda x: x - readings, [Parameter("mean", 0, 1, prior=1.0)], "more", unit_variance=True
    )
    assert estimate.values[0] == pytest.approx(1.6, abs=1e-6)
    assert estimate.intervals[0] == pytest.approx(CONFIDENCE / np.sqrt(5), rel=1e-6)


def line(x: np.ndarray) -> np.ndarray:
    """A slope and an error of the origin, which the readings hardly distinguish."""
    at = np.array([1.0, 1.01, 0.99, 1.0])
    return x[0] * at + x[1] - np.array([2.0, 2.1, 1.9, 2.0])


def test_a_parameter_that_is_not_determined_stays_and_widens_the_others() -> None:
    def fit(prior: float) -> tuple[float, float, float]:
        estimate = least_squares(
            line,
            [Parameter("slope", 1, 1), Parameter("origin", 0, prior, prior=prior, optional=True)],
            "more",
            unit_variance=True,
        )
        assert estimate.fixed.tolist() == [False, True]
        assert estimate.values[1] == 0
        return float(estimate.values[0]), float(estimate.intervals[0]), float(estimate.intervals[1])

    slope, exact, _ = fit(1e-9)
    assert slope == pytest.approx(2, abs=1e-3)
    assert exact == pytest.approx(CONFIDENCE / 2, rel=1e-4)
    # A deviation of the origin by 0.4 shifts the slope by the same amount.
    slope, wide, message = fit(0.4)
    assert slope == pytest.approx(2, abs=1e-3)
    assert wide == pytest.approx(CONFIDENCE * np.hypot(1 / 2, 0.4), rel=1e-3)
    assert message == pytest.approx(CONFIDENCE * 0.4)


def test_columns_of_owners_give_what_dense_derivatives_give() -> None:
    """Two groups of readings with separate levels and a common slope."""
    group, at = np.array([0, 0, 0, 1, 1, 1]), np.array([0.0, 1, 2, 0, 1, 2])
    values = np.array([1.0, 2.1, 2.9, 5.0, 6.2, 6.9])

    def left(x: np.ndarray) -> np.ndarray:
        return (x[group] + x[2] * at - values) / 0.1

    parameters = [Parameter(name, 0, 1, prior=10) for name in ("a", "b", "slope")]
    owners = np.column_stack([group, np.full(6, 2)])
    dense = least_squares(left, parameters, "more")
    grouped = least_squares(left, parameters, "more", sparsity=owners)
    np.testing.assert_allclose(grouped.values, dense.values, atol=1e-8)
    np.testing.assert_allclose(grouped.intervals, dense.intervals, rtol=1e-8)


def test_a_bound_holds_and_the_others_find_their_best_values_at_it() -> None:
    at, values = np.array([0.0, 1, 2, 3]), np.array([0.0, -1, -2, -3])
    estimate = least_squares(
        lambda x: x[0] + x[1] * at - values, [Parameter("a", 1, 1), Parameter("b", 1, 1, low=0)], "more"
    )
    np.testing.assert_allclose(estimate.values, [-1.5, 0], atol=1e-6)


def test_an_outlier_has_less_weight() -> None:
    readings = np.array([0.0] * 9 + [100.0])
    estimate = least_squares(lambda x: x - readings, [Parameter("mean", 0, 1)], "more", outlier=1.0)
    assert estimate.values[0] < 0.5


def test_a_parameter_without_effect_is_refused_by_name() -> None:
    with pytest.raises(FitError, match="idle: cannot be determined; expected more"):
        least_squares(
            lambda x: x[0] - np.arange(3.0), [Parameter("level", 0, 1), Parameter("idle", 0, 1)], "more"
        )
