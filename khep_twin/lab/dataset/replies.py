"""Control periods from the log of a real robot, which has only what crossed its line.

Sensors and speeds are those of the last reply to N, O and E at the end of each period, commanded speeds those
of the host's commands D. There is no pose, no calibration and no playpen.
"""

from collections.abc import Mapping, Sequence
from functools import partial, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, N_REGISTERS, PROXIMITY
from khep_twin.board.protocol import Command
from khep_twin.envs.tasks import Task
from khep_twin.errors import LogError
from khep_twin.firmware import parse
from khep_twin.lab.dataset.periods import Periods
from khep_twin.log.channels import TextLine
from khep_twin.log.reader import TimeSeries, read_series
from khep_twin.units import COUNTS_LIMIT

_ASKED = {"proximity": ("proximity", "N"), "light": ("ambient", "O"), "speed": ("speed", "E")}
"""Channel of each observation term, and the command whose replies it has."""

_READINGS = {"proximity": PROXIMITY, "light": AMBIENT}
"""Registers of each observation term that consists of counts."""


def periods_of(path: Path, robot: str, task: Task, period_ns: int) -> Periods:
    """Return the control periods of a real robot, from the first at which all that is observed is known.

    A period is not whole if a reply at one of its borders is older than a period, or if its wheels had
    positions (command C) or duties (P) instead of speeds.

    Raises:
        LogError: The log is not whole, or lacks what the task observes or rewards.
    """
    recording = read_series(path)
    lines = recording.lines.get(f"/{robot}/serial", [])
    times_ns, speeds, others = _commands(lines)
    found = {
        term: recording.series.get(f"/{robot}/{_ASKED[term][0]}")
        for term in task.observation_terms
        if term in _ASKED
    }
    _check(path, task, len(times_ns) > 0, found)
    series = {term: each for term, each in found.items() if each is not None}
    first_ns = max(int(times_ns[0]), *(int(each.times_ns[0]) for each in series.values()))
    last_ns = max(int(each.times_ns[-1]) for each in series.values())
    # A border is known by the replies of the period before it. Others are left out: a pause may last years.
    known = [np.unique(-((first_ns - each.times_ns) // period_ns)) for each in series.values()]
    numbers = reduce(partial(np.intersect1d, assume_unique=True), known)
    numbers = numbers[(numbers >= 0) & (numbers <= (last_ns - first_ns) // period_ns)]
    borders_ns = first_ns + numbers * period_ns
    registers = np.zeros((len(borders_ns), N_REGISTERS), np.int64)
    counted = np.zeros((len(borders_ns), 2))
    for term, each in series.items():
        _check_values(path, term, each)
        rows = np.searchsorted(each.times_ns, borders_ns, "right") - 1
        if term in _READINGS:
            registers[:, _READINGS[term]] = each.values[rows]
        else:
            counted = each.values[rows, :2].astype(np.float64)
    commanded = speeds[np.searchsorted(times_ns, borders_ns[:-1] + period_ns // 2, "right") - 1]
    before = np.searchsorted(times_ns, borders_ns, "right")
    counts = np.concatenate([[0], np.cumsum(others)])
    whole = (np.diff(numbers) == 1) & (counts[before[1:]] == counts[before[:-1] - 1])
    return Periods(
        period_ns, borders_ns, registers, counted, commanded.astype(np.float64), None, whole, 1.0, 0.0
    )


def _commands(lines: Sequence[TextLine]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the commands to the wheels from the first D on.

    Returns:
        Times (n,) [ns], speeds in force (n, 2) [pulses/10 ms], and 1 where others than speeds are (n,).
    """
    times_ns: list[int] = []
    speeds: list[tuple[int, int]] = []
    others: list[int] = []
    for line in lines:
        match parse(line.text.encode()) if line.name == "host" else None:
            case Command("D", (int(left), int(right))):
                speeds.append((left, right))
                others.append(0)
            case Command("C" | "P", _) if speeds:
                speeds.append(speeds[-1])
                others.append(1)
            case _:
                continue
        times_ns.append(line.time_ns)
    return np.array(times_ns, np.int64), np.array(speeds, np.int64), np.array(others, np.int64)


def _check(path: Path, task: Task, driven: bool, found: Mapping[str, TimeSeries | None]) -> None:
    """Raise a `LogError` that says what the log lacks for the task."""
    missing = [f"replies to {_ASKED[term][1]} ({term})" for term, each in found.items() if each is None]
    missing += [] if driven else ["commands D (speeds)"]
    missing += ["a calibration (light)"] if "light" in found else []
    missing += [f"the true pose (goal {task.goal!r})"] if task.goal else []
    if missing or not found:
        what = ", ".join(missing) or "anything that the task observes"
        raise LogError(
            f"{path}: the log of a real robot, without {what}, which {task.name} needs; expected the log "
            "of a twin, or a task of proximity and speed with a host that sends D, N and E"
        )


def _check_values(path: Path, term: str, series: TimeSeries) -> None:
    """Raise a `LogError` if the replies of a channel are no readings of a robot."""
    values, (width, low, high) = series.values, (8, 0, COUNTS_LIMIT) if term in _READINGS else (4, -128, 127)
    if values.shape[1] != width or not ((values >= low) & (values <= high)).all():
        raise LogError(
            f"{path}: {_ASKED[term][0]}: {values.shape[1]} numbers from {values.min():g} to "
            f"{values.max():g}; expected {width} from {low} to {high}"
        )
