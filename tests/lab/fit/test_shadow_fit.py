"""Calibrations from the values that a shadow learned."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from nine_sensors import nine_playpen

from khep_twin.lab.fit.shadow_fit import fit_learned, read_learned
from khep_twin.sensing import calibration
from khep_twin.shadow.particles import LearnedValues, value_names
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog
from khep_twin.units import SENSOR_LABELS

START = calibration.read("khepera1")[0]


@pytest.mark.parametrize("sensors", [SENSOR_LABELS, "abcdefghi", "abcde"])
def test_a_row_has_all_that_was_learned(sensors: Sequence[str]) -> None:
    names = value_names(sensors)
    row = np.arange(len(names), dtype=np.float64)
    learned = LearnedValues.from_row(row)
    assert [len(part) for part in learned] == [3, 3, len(sensors), len(sensors)]
    assert np.array_equal(learned.row, row)
    assert names[4] == "deviation of right over left"
    assert len(set(names)) == len(names)


def test_what_the_drive_has_determined_is_taken_and_the_rest_stays() -> None:
    gains, deviations = np.full(8, 1.2), np.full(8, 0.05)
    deviations[3] = 0.3
    fit = fit_learned(
        LearnedValues(np.full(3, 1.01), np.full(3, 1.0), gains, deviations), START, SENSOR_LABELS
    )
    near, before = fit.calibration.proximity.gain_counts_mm2, START.proximity.gain_counts_mm2
    assert near[0] == pytest.approx(1.2 * before[0])
    assert near[3] == before[3]
    assert fit.calibration.wheels == START.wheels
    assert [value.path[1:] for value in fit.values] == [("gain_counts_mm2", i) for i in range(8) if i != 3]
    assert fit.values[0].interval == pytest.approx(1.96 * near[0] * 0.05)
    assert fit.lines[-1].endswith("wheel radius, right over left, wheel base, gain of right 10")


def test_the_gains_of_all_sensors_are_in_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = ShadowLog(path := tmp_path / "nine.mcap", nine_playpen(tmp_path, monkeypatch), ShadowSettings())
    log.write_learned(LearnedValues(np.ones(3), np.ones(3), np.linspace(1.1, 1.3, 9), np.full(9, 0.01)))
    log.close()
    learned = read_learned(path)
    assert learned is not None
    fit = fit_learned(*learned)
    gains = fit.calibration.proximity.gain_counts_mm2
    assert gains == pytest.approx(1_058_000 * np.linspace(1.1, 1.3, 9))
    assert fit.lines[-2].startswith("tail             gain 1.375e+06 +- ")
