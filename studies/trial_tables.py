"""Options of the trials of `studies.twin_trials`, selection of noticeable trials, and printed tables."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from khep_twin.shadow.shadow import ShadowSettings

Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterable[Any]]
"""Map of a function over arguments, on one or several cores, in order."""


class Options(NamedTuple):
    """Options of the trials.

    Attributes:
        folder: Folder of the recordings.
        runs: Number of runs of each kind.
        seconds: Length of a run of a sound robot [s].
        hours: Length of all healthy runs together [h].
        first: Seed of the first run.
        faults: Faults of the alarms' trials.
        playpens: Playpens of the healthy runs.
        hosts: Hosts of healthy runs and the alarms' trials; without any, all that a seed may have.
        times: Times of the line of healthy runs and the alarms' trials.
        settings: Settings of the shadow.
        detail: Print a line for each run.
        picture: Path of a picture of the reliability; None for none.
        run: Map over all cores.
    """

    folder: Path
    runs: int
    seconds: float
    hours: float
    first: int
    faults: Sequence[str]
    playpens: Sequence[str]
    hosts: Sequence[str]
    times: str
    settings: ShadowSettings
    detail: bool
    picture: Path | None
    run: Map


_TRIES = 6
"""Largest number of seeds for each requested trial; many faults are not noticeable."""

T = TypeVar("T")


def noticeable(run: Callable[..., T | None], fault: str, options: Options) -> Iterator[tuple[int, T]]:
    """Yield the seeds and results of the requested number of trials; results of None are left out.

    `run` takes the fault, the seed, the folder, the settings, hosts and times.
    """
    seed, missing = options.first, options.runs
    while missing and seed < options.first + _TRIES * options.runs:
        tasks = [
            (fault, trial_seed, options.folder, options.settings, options.hosts, options.times)
            for trial_seed in range(seed, seed + missing)
        ]
        for task, outcome in zip(tasks, options.run(run, tasks), strict=True):
            if outcome is not None:
                missing -= 1
                yield task[1], outcome
        seed += len(tasks)


def head(*names: str) -> None:
    """Print the head of a table."""
    row(*names)
    row(*["---"] * len(names))


def row(*cells: object) -> None:
    """Print a row of a table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def note(lines: Iterable[str]) -> None:
    """Print lines below a row."""
    for line in lines:
        print(f"    {line}", flush=True)


def count_text(names: Counter[str]) -> str:
    """Return names with their numbers, the most frequent first."""
    return ", ".join(f"{number} {name}" for name, number in names.most_common())
