"""Calibrations from the values that a shadow learned."""

import numpy as np
import pytest

from khep_twin.lab.fit.shadow_fit import fit_learned
from khep_twin.sensing import calibration
from khep_twin.shadow.particles import VALUE_NAMES, LearnedValues

START = calibration.read("khepera1")[0]


def test_a_row_has_all_that_was_learned() -> None:
    row = np.arange(len(VALUE_NAMES), dtype=np.float64)
    learned = LearnedValues.from_row(row)
    assert [len(part) for part in learned] == [3, 3, 8, 8]
    assert np.array_equal(learned.row, row)
    assert VALUE_NAMES[4] == "deviation of right over left"
    assert len(set(VALUE_NAMES)) == len(VALUE_NAMES)


def test_what_the_drive_has_determined_is_taken_and_the_rest_stays() -> None:
    gains, deviations = np.full(8, 1.2), np.full(8, 0.05)
    deviations[3] = 0.3
    fit = fit_learned(LearnedValues(np.full(3, 1.01), np.full(3, 1.0), gains, deviations), START)
    near, before = fit.calibration.proximity.gain_counts_mm2, START.proximity.gain_counts_mm2
    assert near[0] == pytest.approx(1.2 * before[0])
    assert near[3] == before[3]
    assert fit.calibration.wheels == START.wheels
    assert [value.path[1:] for value in fit.values] == [("gain_counts_mm2", i) for i in range(8) if i != 3]
    assert fit.values[0].interval == pytest.approx(1.96 * near[0] * 0.05)
    assert fit.lines[-1].endswith("wheel radius, right over left, wheel base, gain of right 10")
