"""Control periods from the log of a twin, which has the whole board every 20 ms.

Between two samples, 10 ms after the first, the state follows from both: half of the sensors have been
converted, each of them once in 20 ms, and the encoders were a tick's speed away from the later sample. So
readings, and speeds counted over a period, are exact at each whole tick; poses there are interpolated.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import AMBIENT, LEFT, N_REGISTERS, PROXIMITY, RIGHT, SETPOINTS, Board, Mode, Wheel
from khep_twin.envs.tasks import Task
from khep_twin.errors import LogError, choices
from khep_twin.lab.dataset.periods import Periods
from khep_twin.log.attached import calibration_of, playpen_of
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_pieces
from khep_twin.world import SAMPLE_NS

_ENCODERS = [LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]
_SPEEDS = [LEFT + Wheel.SPEED, RIGHT + Wheel.SPEED]
_MODES = [LEFT + Wheel.MODE, RIGHT + Wheel.MODE]
_PUT = "put to ("
"""Beginning of the event of a robot that is moved by hand."""


def periods_of(
    path: Path,
    label: Label,
    robots: Sequence[str],
    task: Task,
    period_ns: int,
    progress: Callable[[float], None] | None = None,
) -> Iterator[Periods]:
    """Yield the control periods of each robot in the log of a twin, from its start.

    A period is not whole if a wheel was not in speed mode, or if the robot was moved by hand.

    Raises:
        LogError: The log is not whole, or lacks samples, a calibration or the task's goal.
    """
    goal = _goal(label, task, path)
    times_ns: list[NDArray[np.int64]] = []
    registers: dict[str, list[NDArray[np.int32]]] = {robot: [] for robot in robots}
    poses: dict[str, list[NDArray[np.float64]]] = {robot: [] for robot in robots}
    moves_ns: dict[str, list[int]] = {robot: [] for robot in robots}
    for piece in read_pieces(path, progress):
        for line in piece.lines.get("/events", ()):
            if line.name in moves_ns and line.text.startswith(_PUT):
                moves_ns[line.name].append(line.time_ns)
        for robot in robots:
            found, pose = (piece.series.get(f"/{robot}/{name}") for name in ("registers", "pose"))
            if found is None or pose is None:
                continue
            if found.values.shape[1] != N_REGISTERS or found.values.dtype != np.int64:
                raise LogError(
                    f"{path}: /{robot}/registers: {found.values.shape[1]} numbers ({found.values.dtype}); "
                    f"expected {N_REGISTERS} integers"
                )
            times_ns += [found.times_ns] if robot == robots[0] else []
            registers[robot].append(found.values.astype(np.int32))
            poses[robot].append(pose.values.astype(np.float64))
    n_samples = _checked_samples(path, np.concatenate([np.zeros(0, np.int64), *times_ns]))
    for robot in robots:
        calibration = calibration_of(label.attachments, robot, path)
        if calibration is None or not registers[robot]:
            missing = "samples" if calibration is not None else "calibration"
            raise LogError(f"{path}: no {missing} of {robot}; expected a log of khep-twin")
        sampled, pose = np.concatenate(registers[robot]), np.concatenate(poses[robot])
        if {len(sampled), len(pose)} != {n_samples}:
            found = f"{len(sampled)} samples and {len(pose)} poses"
            raise LogError(f"{path}: {robot}: {found}; expected {n_samples} of each")
        dark, floor = calibration.ambient.dark_counts, calibration.ambient.floor_counts
        yield _periods(sampled, pose, moves_ns[robot], period_ns, (dark, floor), goal)


def _periods(
    samples: NDArray[np.int32],
    poses: NDArray[np.float64],
    moves_ns: Sequence[int],
    period_ns: int,
    light: tuple[float, float],
    goal: tuple[float, float],
) -> Periods:
    """Return the control periods of one robot.

    Args:
        samples: Registers every 20 ms (m, N_REGISTERS).
        poses: True x, y [m] and heading [rad] at the same times (m, 3).
        moves_ns: Times at which the robot was moved by hand [ns].
        period_ns: Control period [ns].
        light: Ambient readings in the dark and in the brightest light [counts].
        goal: Position x, y of the goal [m].
    """
    times_ns = np.arange(0, (len(samples) - 1) * SAMPLE_NS + 1, period_ns)
    rows, rest_ns = np.divmod(times_ns, SAMPLE_NS)
    between = rest_ns > 0
    registers, pose = samples[rows].astype(np.int64), poses[rows]
    if between.any():
        registers[between] = _between(samples[rows[between]], samples[rows[between] + 1])
        step = poses[rows[between] + 1] - pose[between]
        step[:, 2] = np.remainder(step[:, 2] + math.pi, 2 * math.pi) - math.pi
        pose[between] += step / 2
        pose[:, 2] = np.remainder(pose[:, 2] + math.pi, 2 * math.pi) - math.pi
    speeds = np.zeros((len(times_ns), 2))
    speeds[1:] = np.diff(registers[:, _ENCODERS], axis=0) / (period_ns // units.TICK_NS)
    middles = -(-(times_ns[:-1] + period_ns // 2) // SAMPLE_NS)
    commanded = samples[middles][:, SETPOINTS].astype(np.float64)
    # Samples at the end of a period are its own, as they have the setpoints of the time before.
    others = np.cumsum((samples[:, _MODES] != Mode.SPEED).any(axis=1))
    whole = np.diff(others[rows]) == 0
    for move_ns in moves_ns:
        # At a border it may have been sampled before or after.
        first, last = max(-(-move_ns // period_ns) - 1, 0), move_ns // period_ns
        whole[first : last + 1] = False
    return Periods(period_ns, times_ns, registers, speeds, commanded, pose, whole, *light, goal)


def _between(before: NDArray[np.int32], after: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the registers a tick after one sample and a tick before the next (n, N_REGISTERS)."""
    registers = before.astype(np.int64)
    registers[:, _ENCODERS] = after[:, _ENCODERS] - after[:, _SPEEDS]
    half = units.N_SENSORS // 2
    converted = (before[:, [Board.SCAN]] + np.arange(half)) % units.N_SENSORS
    for first in (PROXIMITY[0], AMBIENT[0]):
        columns = first + converted
        np.put_along_axis(registers, columns, np.take_along_axis(after, columns, 1).astype(np.int64), 1)
    return registers


def _checked_samples(path: Path, times_ns: NDArray[np.int64]) -> int:
    """Return the number of samples; raise a `LogError` unless there is one every 20 ms from the start."""
    due_ns = np.arange(len(times_ns)) * SAMPLE_NS
    if (missing := np.flatnonzero(times_ns != due_ns)).size:
        at_s = due_ns[missing[0]] / 1e9
        raise LogError(f"{path}: no sample at {at_s:.2f} s; expected one every {SAMPLE_NS // 10**6} ms")
    return len(times_ns)


def _goal(label: Label, task: Task, path: Path) -> tuple[float, float]:
    """Return the position of the task's goal [m]; 0, 0 without one."""
    if not task.goal:
        return 0.0, 0.0
    playpen = playpen_of(label.attachments, path)
    positions = {
        item.name: (units.metres(item.x_mm), units.metres(item.y_mm))
        for item in (*playpen.patches, *playpen.cylinders)
        if item.name
    }
    if task.goal not in positions:
        raise LogError(
            f"{path}: its playpen has no patch or cylinder {task.goal!r}, the goal of {task.name}; "
            f"{choices(task.goal, positions)}"
        )
    return positions[task.goal]
