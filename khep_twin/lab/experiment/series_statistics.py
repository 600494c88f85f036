"""Statistics of series: means and confidence intervals of metrics, and differences of two series."""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student
from scipy.stats import ttest_ind

from khep_twin.errors import ControllerError, choices
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.series_files import Row, columns

CONFIDENCE = 0.95

NOT_MEASURED = {"run", "start_x_mm", "start_y_mm", "start_heading_deg", "cycles"}
"""Columns with settings of a run, not results."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a column over the runs of a series.

    Attributes:
        count: Number of runs with this column.
        mean: Mean value.
        sd: Standard deviation from run to run; NaN with a single run.
        ci95: Half width of the mean's 95 % confidence interval, by Student's t for independent, normally
            distributed runs (assumed).
        low: Smallest value.
        high: Largest value.
    """

    count: int
    mean: float
    sd: float
    ci95: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of the means of two series, and the half width of its 95 % confidence interval (Welch)."""

    mean: float
    ci95: float

    @property
    def is_clear(self) -> bool:
        """True if 0 lies outside the confidence interval."""
        return abs(self.mean) > self.ci95


def summarize(values: Sequence[float]) -> Summary:
    """Return the summary of at least one value."""
    count, mean = len(values), math.fsum(values) / len(values)
    sd = float(np.std(values, ddof=1)) if count > 1 else math.nan
    return Summary(count, mean, sd, _ci95(sd / math.sqrt(count), count - 1), min(values), max(values))


def difference(before: Sequence[float], after: Sequence[float]) -> Difference:
    """Return the mean of `after` less the mean of `before`."""
    summary_before, summary_after = summarize(before), summarize(after)
    mean = summary_after.mean - summary_before.mean
    if min(len(before), len(after)) < 2 or not summary_before.sd + summary_after.sd:
        return Difference(mean, summary_before.sd + summary_after.sd)  # NaN for a single run, or 0
    low, high = ttest_ind(after, before, equal_var=False).confidence_interval(CONFIDENCE)
    return Difference(mean, float(high - low) / 2)


def finite_values(rows: Sequence[Row], name: str) -> list[float]:
    """Return the finite numbers of a column."""
    entries = [row[name] for row in rows if name in row]
    return [float(value) for value in entries if isinstance(value, int | float) and math.isfinite(value)]


def measured_columns(series: Sequence[Sequence[Row]], requested: Sequence[str] | None = None) -> list[str]:
    """Return the names of the numeric columns of one or several series, or the requested ones in their order.

    Raises:
        ControllerError: A requested column is not numeric, or does not exist.
    """
    numeric = [
        name
        for name in columns([row for rows in series for row in rows])
        if name not in NOT_MEASURED and any(finite_values(rows, name) for rows in series)
    ]
    for name in requested or ():
        if name not in numeric:
            raise ControllerError(f"column {name}: not a number in these runs; {choices(name, numeric)}")
    return numeric if requested is None else list(dict.fromkeys(requested))


def table(labels: Sequence[str], series: Sequence[Sequence[Row]], names: Sequence[str]) -> str:
    """Return series as text: a line for each column and series, and the differences from the first series."""
    header = ("", "series", "runs", "mean", "+- 95 %", "sd", "least", "most")
    lines: list[tuple[str, ...]] = [header]
    for name in names:
        first_values: list[float] | None = None
        title = f"{name} [{UNITS[name]}]" if UNITS.get(name) else name
        for label, rows in zip(labels, series, strict=True):
            numbers = finite_values(rows, name)
            if not numbers:
                continue
            statistics = summarize(numbers)
            estimates = (statistics.mean, statistics.ci95, statistics.sd, statistics.low, statistics.high)
            lines.append((title, label, str(statistics.count), *map(_format_number, estimates)))
            title = ""
            if first_values is None:
                first_values = numbers
            else:
                change = difference(first_values, numbers)
                verdict = "differs" if change.is_clear else "no clear difference"
                mean, ci95 = map(_format_number, (change.mean, change.ci95))
                lines.append(("", "  less the first", "", mean, ci95, verdict, "", ""))
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _ci95(standard_error: float, dof: float) -> float:
    """Return the half width of the confidence interval of a mean with this standard error."""
    if math.isnan(standard_error) or not dof > 0:
        return math.nan
    return float(student.ppf((1 + CONFIDENCE) / 2, dof)) * standard_error


def _format_number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4g}"
