"""Control periods from the log of a real robot, which has only the data of its serial line.

Readings and speeds are those of the last reply to N, O and E at the end of each period, commanded speeds
those of the host's commands D. There is no pose, no calibration and no playpen.
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

_CHANNELS = {"proximity": ("proximity", "N"), "light": ("ambient", "O"), "speed": ("speed", "E")}
"""Channel of each observation term, and the command of its replies."""

_READINGS = {"proximity": PROXIMITY, "light": AMBIENT}
"""Registers of each observation term that consists of counts."""


def periods_of(path: Path, robot: str, task: Task, period_ns: int) -> Periods:
    """Return the control periods of a real robot, from the first with all observations.

    A period is incomplete if a reply at one of its borders is older than a period, or if its wheels had
    positions (command C) or duties (P) instead of speeds.

    Raises:
        LogError: The log is incomplete, or lacks data for the task's observations or rewards.
    """
    recording = read_series(path)
    lines = recording.lines.get(f"/{robot}/serial", [])
    times_ns, speeds, is_other_mode = _commands(lines)
    channels = {
        term: recording.series.get(f"/{robot}/{_CHANNELS[term][0]}")
        for term in task.observation_terms
        if term in _CHANNELS
    }
    _check_data(path, task, len(times_ns) > 0, channels)
    series = {term: channel for term, channel in channels.items() if channel is not None}
    first_ns = max(int(times_ns[0]), *(int(channel.times_ns[0]) for channel in series.values()))
    last_ns = max(int(channel.times_ns[-1]) for channel in series.values())
    # A border is known if the period before it has replies. Only these are kept: a pause may last years.
    borders = [np.unique(-((first_ns - channel.times_ns) // period_ns)) for channel in series.values()]
    indices = reduce(partial(np.intersect1d, assume_unique=True), borders)
    indices = indices[(indices >= 0) & (indices <= (last_ns - first_ns) // period_ns)]
    borders_ns = first_ns + indices * period_ns
    registers = np.zeros((len(borders_ns), N_REGISTERS), np.int64)
    measured = np.zeros((len(borders_ns), 2))
    for term, channel in series.items():
        _check_values(path, term, channel)
        rows = np.searchsorted(channel.times_ns, borders_ns, "right") - 1
        if term in _READINGS:
            registers[:, _READINGS[term]] = channel.values[rows]
        else:
            measured = channel.values[rows, :2].astype(np.float64)
    commanded = speeds[np.searchsorted(times_ns, borders_ns[:-1] + period_ns // 2, "right") - 1]
    n_commands = np.searchsorted(times_ns, borders_ns, "right")
    n_other_modes = np.concatenate([[0], np.cumsum(is_other_mode)])
    is_complete = (np.diff(indices) == 1) & (
        n_other_modes[n_commands[1:]] == n_other_modes[n_commands[:-1] - 1]
    )
    return Periods(
        period_ns, borders_ns, registers, measured, commanded.astype(np.float64), None, is_complete, 1.0, 0.0
    )


def _commands(lines: Sequence[TextLine]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the motor commands from the first D on.

    Returns:
        Times (n,) [ns], speeds in force (n, 2) [pulses/10 ms], and 1 for C and P (n,).
    """
    times_ns: list[int] = []
    speeds: list[tuple[int, int]] = []
    is_other_mode: list[int] = []
    for line in lines:
        match parse(line.text.encode()) if line.name == "host" else None:
            case Command("D", (int(left), int(right))):
                speeds.append((left, right))
                is_other_mode.append(0)
            case Command("C" | "P", _) if speeds:
                speeds.append(speeds[-1])
                is_other_mode.append(1)
            case _:
                continue
        times_ns.append(line.time_ns)
    return np.array(times_ns, np.int64), np.array(speeds, np.int64), np.array(is_other_mode, np.int64)


def _check_data(path: Path, task: Task, has_speeds: bool, channels: Mapping[str, TimeSeries | None]) -> None:
    """Raise a `LogError` with the data that the log lacks for the task."""
    missing_terms = [term for term, channel in channels.items() if channel is None]
    missing = [f"replies to {_CHANNELS[term][1]} ({term})" for term in missing_terms]
    missing += [] if has_speeds else ["commands D (speeds)"]
    missing += ["a calibration (light)"] if "light" in channels else []
    missing += [f"the true pose (goal {task.goal!r})"] if task.goal else []
    if missing or not channels:
        items = ", ".join(missing) or "anything that the task observes"
        raise LogError(
            f"{path}: the log of a real robot, without {items}, which {task.name} needs; expected the log "
            "of a twin, or a task of proximity and speed with a host that sends D, N and E"
        )


def _check_values(path: Path, term: str, series: TimeSeries) -> None:
    """Raise a `LogError` if the values of a channel are not possible readings of a robot."""
    values, (width, low, high) = series.values, (8, 0, COUNTS_LIMIT) if term in _READINGS else (4, -128, 127)
    if values.shape[1] != width or not ((values >= low) & (values <= high)).all():
        raise LogError(
            f"{path}: {_CHANNELS[term][0]}: {values.shape[1]} numbers from {values.min():g} to "
            f"{values.max():g}; expected {width} from {low} to {high}"
        )
