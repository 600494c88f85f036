"""Statistics of series, against those of scipy."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from khep_twin.errors import ControllerError
from khep_twin.lab.experiment.figures import default_columns, draw
from khep_twin.lab.experiment.series_files import Row
from khep_twin.lab.experiment.series_statistics import (
    difference,
    finite_values,
    measured_columns,
    summarize,
    table,
)

RNG = np.random.default_rng(5)
ONE, OTHER = RNG.normal(3.0, 0.5, 12).tolist(), RNG.normal(3.8, 1.5, 7).tolist()


def test_a_summary_has_students_interval() -> None:
    column, by_scipy = summarize(ONE), stats.ttest_1samp(ONE, 0).confidence_interval(0.95)
    assert column.mean == pytest.approx(np.mean(ONE))
    assert column.sd == pytest.approx(np.std(ONE, ddof=1))
    assert (column.mean - column.ci95, column.mean + column.ci95) == pytest.approx([*by_scipy])
    assert (column.count, column.low, column.high) == (12, min(ONE), max(ONE))


def test_a_difference_has_welchs_interval() -> None:
    change = difference(ONE, OTHER)
    by_scipy = stats.ttest_ind(OTHER, ONE, equal_var=False)
    interval = by_scipy.confidence_interval(0.95)
    assert (change.mean - change.ci95, change.mean + change.ci95) == pytest.approx([*interval])
    assert change.is_clear == (by_scipy.pvalue < 0.05)


def test_single_and_equal_runs_have_no_interval_or_none_at_all() -> None:
    assert math.isnan(summarize([2.0]).sd)
    assert math.isnan(summarize([2.0]).ci95)
    assert summarize([2.0, 2.0]).ci95 == 0
    assert not difference([1.0], [2.0]).is_clear
    assert difference([1.0, 1.0], [2.0, 2.0]).is_clear
    assert not difference([1.0, 1.0], [1.0, 1.0]).is_clear


ROWS: list[Row] = [
    {"run": number + 1, "cycles": 5, "fitness": value, "word": "a", "learned": number / 2}
    for number, value in enumerate(ONE)
]
OTHER_ROWS: list[Row] = [
    {"run": number + 1, "cycles": 5, "fitness": value, "odd": math.nan} for number, value in enumerate(OTHER)
]


def test_columns_are_numbers_that_were_measured() -> None:
    assert measured_columns([ROWS, OTHER_ROWS]) == ["fitness", "learned"]
    assert measured_columns([ROWS], ["learned", "learned"]) == ["learned"]
    assert finite_values(OTHER_ROWS, "odd") == []
    with pytest.raises(ControllerError, match=r"column fitnes: not a number in these runs; did you mean 'fi"):
        measured_columns([ROWS], ["fitnes"])


def test_the_table_has_a_line_for_each_series_and_difference() -> None:
    lines = table(["old", "new"], [ROWS, OTHER_ROWS], ["fitness", "learned"]).splitlines()
    assert lines[0].split() == ["series", "runs", "mean", "+-", "95", "%", "sd", "least", "most"]
    assert lines[1].split()[:4] == ["fitness", "old", "12", f"{np.mean(ONE):.4g}"]
    assert lines[3].split()[:3] == ["less", "the", "first"]
    assert len(lines) == 5


def test_a_figure_has_a_panel_for_each_number(tmp_path: Path) -> None:
    from khep_twin.drawing.map import save

    names = ["fitness", "learned"]
    figure = draw(["old", "new"], [ROWS, OTHER_ROWS], names)
    assert [axes.get_ylabel() for axes in figure.axes] == names
    lines = figure.axes[0].get_lines()
    assert [*lines[0].get_ydata()] == ONE
    assert default_columns(["light_gained", "fitness", "mine"]) == ["fitness", "light_gained"]
    for suffix in ("png", "svg", "pdf"):
        save(figure, tmp_path / f"series.{suffix}")
        assert (tmp_path / f"series.{suffix}").stat().st_size > 2000
