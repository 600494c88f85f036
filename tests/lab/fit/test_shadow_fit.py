"""Calibrations from what a shadow has learned."""

import math

import numpy as np
import pytest

from khep_twin.lab.fit.shadow_fit import GAIN_ERROR, HEADING_ERROR_DEG, fit_learned
from khep_twin.sensing import calibration
from khep_twin.shadow.learned import LEARNED, Learned

START = calibration.read("khepera1")[0]


def test_a_row_has_all_that_was_learned() -> None:
    row = np.arange(len(LEARNED), dtype=np.float64)
    found = Learned.of_row(row)
    assert [len(part) for part in found] == [3, 3, 8, 8, 8, 8, 8, 8]
    assert np.array_equal(found.row, row)
    assert LEARNED[4] == "deviation of right over left"
    assert len(set(LEARNED)) == len(LEARNED)


def test_what_the_drive_has_determined_is_taken_and_the_rest_stays() -> None:
    gains, apart, vague = np.full(8, 1.2), np.full(8, 0.05), np.full(8, 1e3)
    apart[3] = 0.3
    turns, apart_turns = np.full(8, math.radians(4)), np.full(8, math.radians(0.5))
    found = fit_learned(
        Learned(np.full(3, 1.01), np.ones(3), gains, apart, turns, apart_turns, np.ones(8), vague), START
    )
    near, before = found.calibration.proximity, START.proximity
    assert near.gain_counts_mm2[0] == pytest.approx(1.2 * before.gain_counts_mm2[0])
    assert near.gain_counts_mm2[3] == before.gain_counts_mm2[3]
    assert np.subtract(found.calibration.heading_deg, START.heading_deg) == pytest.approx(np.full(8, 4))
    assert near.threshold_counts == before.threshold_counts
    assert found.calibration.wheels == START.wheels
    taken = [("gain_counts_mm2", i) for i in range(8) if i != 3] + [("heading_deg", i) for i in range(8)]
    assert [value.path[1:] for value in found.values] == taken
    assert found.values[0].interval == pytest.approx(
        1.96 * near.gain_counts_mm2[0] * np.hypot(0.05, GAIN_ERROR)
    )
    assert found.values[-1].interval == pytest.approx(1.96 * math.hypot(0.5, HEADING_ERROR_DEG))
    kept = "wheel radius, right over left, wheel base, right 10: gain, left 90: threshold, "
    assert kept in found.lines[-1]
