"""Measuring loop of all benchmarks, and its printed table.

    rows = [Row("bare loop (floor)", 20.0, timed(bare)), Row("episode", 20.0, timed(episode))]
    print(text([measure("default", rows, rounds=5)]))

All rows of a table run once uncounted and then in turn, round by round, so that other load of the machine
affects all of them equally. A ratio is the median over the rounds of a row's speed relative to that of the
first row, the floor, in the same round; it depends least on machine and load. In a table of costs, where
time per unit is shown instead of units per time, it is the ratio of the times.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

WIDTH = 36
"""Width of a row's name in the printed table."""

SIMULATED = "simulated s per s"
COST = "ms per simulated s"

_HEAD = "".join(f"{word:>8}" for word in ("median", "best", "CPU", "ratio", "of CPU"))
_CLOCKS = ("wall", "cpu")


@dataclass(frozen=True, slots=True)
class RunTimes:
    """Times of a run.

    Attributes:
        wall: Wall time [s].
        cpu: Processor time of all threads [s]; NaN where other processes share the work.
    """

    wall: float
    cpu: float = math.nan


@dataclass(frozen=True, slots=True)
class Row:
    """A measured item.

    Attributes:
        name: Name in the table.
        work: Work of one run, in the table's unit: simulated seconds, round trips.
        run: Function that runs it once.
        note: Function that returns the text behind the numbers, of the median units per second.
    """

    name: str
    work: float
    run: Callable[[], RunTimes]
    note: Callable[[float], str] = lambda rate: ""


@dataclass(frozen=True, slots=True)
class Result:
    """A row's numbers, to four digits; NaN if not measured.

    Attributes:
        name: Name in the table.
        median: Median of all rounds, by wall time.
        best: Best of all rounds, by wall time.
        cpu: Median by processor time.
        ratio: Ratio to the first row, by wall time.
        cpu_ratio: Ratio to the first row, by processor time.
        note: Text behind the numbers.
    """

    name: str
    median: float
    best: float
    cpu: float
    ratio: float
    cpu_ratio: float
    note: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows that were measured in the same rounds.

    Attributes:
        title: Scene, or the varied size.
        unit: Unit of the numbers.
        rounds: Number of rounds.
        results: Results of the rows; ratios are to the first.
        remarks: Remarks, a line each.
    """

    title: str
    unit: str
    rounds: int
    results: tuple[Result, ...]
    remarks: tuple[str, ...] = ()


def timed(function: Callable[[], object]) -> Callable[[], RunTimes]:
    """Return a row's run of a function in this process."""

    def run() -> RunTimes:
        wall, cpu = time.perf_counter(), time.process_time()
        function()
        return RunTimes(time.perf_counter() - wall, time.process_time() - cpu)

    return run


def measure(
    title: str,
    rows: Sequence[Row],
    rounds: int,
    *,
    unit: str = SIMULATED,
    cost: bool = False,
    remarks: Sequence[str] = (),
) -> Table:
    """Measure rows in turn.

    Args:
        title: Title of the table.
        rows: Rows, the floor first.
        rounds: Number of counted rounds, after an uncounted one.
        unit: Unit of a row's work per second, or with `cost` of the time of a unit.
        cost: Whether to show milliseconds per unit, and ratios of times.
        remarks: Remarks below the table.
    """
    for row in rows:
        row.run()
    run_times = [[row.run() for row in rows] for _ in range(rounds)]
    results: list[Result] = []
    for number, row in enumerate(rows):
        walls, cpus = ([getattr(one[number], clock) / row.work for one in run_times] for clock in _CLOCKS)
        floors = ([getattr(one[0], clock) / rows[0].work for one in run_times] for clock in _CLOCKS)
        ratios = [
            statistics.median(
                _relative_speed(duration, floor) for duration, floor in zip(row_times, first, strict=True)
            )
            for row_times, first in zip((walls, cpus), floors, strict=True)
        ]
        median, best, cpu = statistics.median(walls), min(walls), statistics.median(cpus)
        numbers = [1000 * duration if cost else _per(duration) for duration in (median, best, cpu)]
        relative_numbers = [_per(ratio) if cost else ratio for ratio in ratios]
        note = row.note(_per(median))
        results.append(Result(row.name, *_rounded(*numbers), *_rounded(*relative_numbers), note=note))
    return Table(title, unit, rounds, tuple(results), tuple(remarks))


def text(tables: Sequence[Table]) -> str:
    """Return all tables as one text."""
    lines: list[str] = []
    for table in tables:
        lines += ["", f"{table.title} [{table.unit}]", f"{'':{WIDTH}}{_HEAD}"]
        for row in table.results:
            numbers = "".join(f"{_short(number):>8}" for number in (row.median, row.best, row.cpu))
            ratios = "".join(f"{_short(number):>8}" for number in (row.ratio, row.cpu_ratio))
            lines.append(f"  {row.name:{WIDTH - 2}}{numbers}{ratios}   {row.note}".rstrip())
        lines += [f"  {remark}" for remark in table.remarks]
    return "\n".join(lines[1:])


LEGEND = (
    "median and best by the clock, CPU by the processor's time of all threads; ratios to the first row,\n"
    "medians of each round's, by the clock and by the processor's time"
)
"""Explanation of the columns."""


def _relative_speed(duration: float, floor: float) -> float:
    """Return the speed relative to a floor, from the times of a unit."""
    return floor / duration if duration > 0 else math.nan


def _per(value: float) -> float:
    return 1 / value if value > 0 else math.nan


def _rounded(*values: float) -> Iterator[float]:
    return (float(f"{value:.4g}") for value in values)


def _short(value: float) -> str:
    """Return a number with three digits, and all of those before the point."""
    if math.isnan(value):
        return "-"
    return f"{value:.0f}" if value >= 99.95 else f"{value:#.3g}"
