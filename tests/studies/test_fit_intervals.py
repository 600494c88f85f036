"""The intervals that a fit prints have their nominal coverage of the robot's values."""

import numpy as np
import pytest

from khep_twin.lab.fit.least_squares import CONFIDENCE
from khep_twin.sensing import calibration
from studies.fit_intervals import errors, study


@pytest.mark.long
def test_hidden_robots_measured_with_a_ruler_lie_within_the_told_intervals() -> None:
    """Robots of the study, whose sensors share the ruler's errors."""
    (*robots,) = study(calibration.read("khepera1")[0], 20, period=0.1)
    assert min(map(len, robots)) > 45
    all_errors = np.array([error for values in robots for _, error in errors(values)])
    assert np.mean(np.abs(all_errors) <= CONFIDENCE) >= 0.85
    # Intervals that are far too wide would contain them, too.
    assert np.sqrt(np.mean(all_errors**2)) > 0.5
