"""Statistics of series: means and confidence intervals of metrics, and differences of two series."""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from khep_twin.errors import ControllerError, choices
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.series_files import Row, columns

CONFIDENCE = 0.95

NOT_MEASURED = {"run", "start_x_mm", "start_y_mm", "start_heading_deg", "cycles"}
"""Columns that are settings of a run instead of results."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a column over the runs of a series.

    Attributes:
        count: Number of runs that have it.
        mean: Mean value.
        sd: Standard deviation from run to run; NaN with a single run.
        ci95: Half of the mean's 95 % confidence interval, by Student's t for independent, normally
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
    """Difference between the means of two series, with half of its 95 % confidence interval.

    The interval is by Welch's t for unequal variances.
    """

    mean: float
    ci95: float

    @property
    def clear(self) -> bool:
        """True if 0 lies outside the confidence interval."""
        return abs(self.mean) > self.ci95


def summary(values: Sequence[float]) -> Summary:
    """Return the summary of at least one value."""
    count, mean = len(values), math.fsum(values) / len(values)
    sd = float(np.std(values, ddof=1)) if count > 1 else math.nan
    return Summary(count, mean, sd, _ci95(sd / math.sqrt(count), count - 1), min(values), max(values))


def difference(before: Sequence[float], after: Sequence[float]) -> Difference:
    """Return the mean of the values after less that before."""
    one, other = summary(before), summary(after)
    parts = [each.sd**2 / each.count for each in (one, other)]
    error = math.sqrt(sum(parts))
    if not error:
        return Difference(other.mean - one.mean, 0.0)
    # Welch and Satterthwaite's degrees of freedom.
    freedom = math.nan
    if not math.isnan(error):
        pairs = zip(parts, (one, other), strict=True)
        freedom = sum(parts) ** 2 / sum(part**2 / (each.count - 1) for part, each in pairs)
    return Difference(other.mean - one.mean, _ci95(error, freedom))


def values(rows: Sequence[Row], name: str) -> list[float]:
    """Return a column's finite numbers, of the runs that have it."""
    there = [row[name] for row in rows if name in row]
    return [float(value) for value in there if isinstance(value, int | float) and math.isfinite(value)]


def measured(series: Sequence[Sequence[Row]], wanted: Sequence[str] | None = None) -> list[str]:
    """Return the names of the numeric columns of one series or several, or those `wanted` in their order.

    Raises:
        ControllerError: There is no such column.
    """
    there = [
        name
        for name in columns([row for rows in series for row in rows])
        if name not in NOT_MEASURED and any(values(rows, name) for rows in series)
    ]
    for name in wanted or ():
        if name not in there:
            raise ControllerError(f"column {name}: not a number in these runs; {choices(name, there)}")
    return there if wanted is None else list(dict.fromkeys(wanted))


def table(labels: Sequence[str], series: Sequence[Sequence[Row]], names: Sequence[str]) -> str:
    """Return series as text: a line for each column of each series, and each difference to the first."""
    head = ("", "series", "runs", "mean", "+- 95 %", "sd", "least", "most")
    lines: list[tuple[str, ...]] = [head]
    for name in names:
        first: list[float] | None = None
        title = f"{name} [{UNITS[name]}]" if UNITS.get(name) else name
        for label, rows in zip(labels, series, strict=True):
            found = values(rows, name)
            if not found:
                continue
            told = summary(found)
            numbers = (told.mean, told.ci95, told.sd, told.low, told.high)
            lines.append((title, label, str(told.count), *map(_number, numbers)))
            title = ""
            if first is None:
                first = found
            else:
                apart = difference(first, found)
                clear = "differs" if apart.clear else "no clear difference"
                lines.append(
                    ("", "  less the first", "", _number(apart.mean), _number(apart.ci95), clear, "", "")
                )
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _ci95(error: float, freedom: float) -> float:
    """Return half of the confidence interval of a mean with this standard error."""
    if math.isnan(error) or not freedom > 0:
        return math.nan
    return float(student.ppf((1 + CONFIDENCE) / 2, freedom)) * error


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4g}"
