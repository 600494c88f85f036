"""Plan of a series of runs, the results of its runs, and the names of their files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from khep_twin.errors import ControllerError
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.start_poses import StartPose

_LONGEST_CYCLE = 1.25
"""Mean time of a cycle without a notice, as a multiple of the expected one."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Number and length of the runs of a series.

    Attributes:
        runs: Number of runs.
        cycles: Calls of the controller per run; None for no limit.
        seconds: Longest duration of a run in the port's time [s]; None for no limit.
        pause: Pause between runs in the port's time [s].
    """

    runs: int = 1
    cycles: int | None = None
    seconds: float | None = None
    pause: float = 0.0

    def __post_init__(self) -> None:
        """Raise a `ControllerError` if a value is out of range, or a run has no limit."""
        if self.runs < 1 or (self.cycles is not None and self.cycles < 1):
            raise ControllerError(f"{self.runs} runs of {self.cycles} cycles; expected numbers above 0")
        if self.cycles is None and self.seconds is None:
            raise ControllerError("a run needs an end; expected a number of cycles or of seconds")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise ControllerError(f"runs of {self.seconds} s; expected a time above 0")
        if not 0 <= self.pause < math.inf:
            raise ControllerError(f"a pause of {self.pause} s; expected 0 or more")


@dataclass(frozen=True, slots=True)
class SeriesRun:
    """One run of a series.

    Attributes:
        number: Number of the run, from 1.
        start: Start pose; None if the robot started where it stood.
        cycles: Number of calls of the controller.
        duration: Duration in the port's time [s].
        metrics: Metrics by name (`khep_twin.lab.experiment.measures`).
        variables: Variables of the controller at the run's end.
        cycle_time: Mean time of a cycle, as in `Outcome` [s].
        expected_cycle_time: Expected time of a cycle, as in `Outcome` [s].
    """

    number: int
    start: StartPose | None
    cycles: int
    duration: float
    metrics: Mapping[str, float]
    variables: Mapping[str, object] = field(default_factory=dict[str, object])
    cycle_time: float = 0.0
    expected_cycle_time: float = 0.0

    def delay_text(self) -> str:
        """Return a notice that the cycles took longer than expected, as a line of text; empty otherwise."""
        if self.cycle_time <= _LONGEST_CYCLE * self.expected_cycle_time or not self.expected_cycle_time:
            return ""
        return (
            f"cycles took {self.cycle_time * 1e3:.0f} ms on average; expected "
            f"{self.expected_cycle_time * 1e3:.0f} ms: this machine, the twin's or the line is slow"
        )

    def text(self, runs: int) -> str:
        """Return the run, one of `runs`, as a line of text; a single run has a line for each metric."""
        summary = f"{self.cycles} cycles in {self.duration:.1f} s"
        if runs == 1:
            return "\n".join([summary, *metric_lines([self.metrics])])
        names = ("fitness", "distance_m")
        values = [f"{name} {self.metrics[name]:.3g}" for name in names if name in self.metrics]
        return "  ".join([f"run {self.number:3d}", summary, *values])


def metric_lines(robots: Sequence[Mapping[str, float]]) -> list[str]:
    """Return a line for each metric, with the value of each robot; undefined metrics are omitted."""
    lines: list[str] = []
    for name in robots[0]:
        values = [metrics[name] for metrics in robots]
        if not math.isnan(values[0]):
            row = "".join(f"{value:<12.4g}" for value in values).rstrip()
            unit = "" if len(robots) > 1 or name.endswith(("_m", "_s")) else UNITS.get(name, "")
            lines.append(f"{name.replace('_', ' '):20}{row} {unit}".rstrip())
    return lines


def numbered_path(path: Path, number: int) -> Path:
    """Return the path of the file of one run: NAME-001.SUFFIX."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


def run_files(path: Path, runs: int) -> list[Path]:
    """Return the file of each run: `path` for a single run, NAME-001.SUFFIX and so on for several."""
    return [path] if runs == 1 else [numbered_path(path, number) for number in range(1, runs + 1)]
