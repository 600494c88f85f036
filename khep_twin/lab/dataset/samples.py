"""Control periods from the log of a twin, which has all registers of the board every 20 ms.

A Khepera's state 10 ms after a sample follows from this sample and the next one: half of the sensors, each
converted every 20 ms, have new readings, and the encoders are those of the next sample less one tick of its
speed. So readings, and speeds over a period, are exact at every tick; poses between samples are interpolated.
Robots of other models need a period of whole samples.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import AMBIENT, LEFT, PROXIMITY, RIGHT, Board, Wheel
from khep_twin.envs.tasks import Task
from khep_twin.errors import LogError, choices
from khep_twin.lab.dataset.periods import Periods
from khep_twin.log.attached import calibration_of, playpen_of
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_batches
from khep_twin.log.robot_models import models_of
from khep_twin.observers import SAMPLE_NS
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import default_model

_ENCODERS = [LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]
_SPEEDS = [LEFT + Wheel.SPEED, RIGHT + Wheel.SPEED]
_MOVE_EVENT = "put to ("
"""Start of an event's text if a robot is moved by hand."""


def periods_of(
    path: Path,
    label: Label,
    robots: Sequence[str],
    task: Task,
    period_ns: int,
    progress: Callable[[float], None] | None = None,
) -> Iterator[Periods]:
    """Yield the control periods of each robot in the log of a twin, from its start.

    A period is incomplete if a wheel was not in speed mode, or if the robot was moved by hand.

    Raises:
        LogError: The log is incomplete, or lacks samples, a calibration or the task's goal.
    """
    goal = _find_goal(label, task, path)
    models = models_of(label.attachments, robots)
    for robot, model in models.items():
        if model.family != task.model:
            raise LogError(
                f"{path}: {robot}: a robot of model {model.name}; expected one of {task.model}, as in "
                f"{task.name}"
            )
    model = models[robots[0]]
    n_registers = model.episode_interface.n_registers
    if period_ns % SAMPLE_NS and model.family != default_model().family:
        raise LogError(
            f"{path}: a control period of {period_ns / 1e6:g} ms; expected a multiple of the "
            f"{SAMPLE_NS // 10**6} ms between samples, as the log is of a {model.title}"
        )
    times_ns: list[NDArray[np.int64]] = []
    registers: dict[str, list[NDArray[np.int32]]] = {robot: [] for robot in robots}
    poses: dict[str, list[NDArray[np.float64]]] = {robot: [] for robot in robots}
    moves_ns: dict[str, list[int]] = {robot: [] for robot in robots}
    for piece in read_batches(path, progress):
        for line in piece.lines.get("/events", ()):
            if line.name in moves_ns and line.text.startswith(_MOVE_EVENT):
                moves_ns[line.name].append(line.time_ns)
        for robot in robots:
            series, pose = (piece.series.get(f"/{robot}/{name}") for name in ("registers", "pose"))
            if series is None or pose is None:
                continue
            if series.values.shape[1] != n_registers or series.values.dtype != np.int64:
                raise LogError(
                    f"{path}: /{robot}/registers: {series.values.shape[1]} numbers ({series.values.dtype}); "
                    f"expected {n_registers} integers"
                )
            times_ns += [series.times_ns] if robot == robots[0] else []
            registers[robot].append(series.values.astype(np.int32))
            poses[robot].append(pose.values.astype(np.float64))
    n_samples = _count_samples(path, np.concatenate([np.zeros(0, np.int64), *times_ns]))
    for robot in robots:
        calibration = calibration_of(label.attachments, robot, path)
        if calibration is None or not registers[robot]:
            missing = "samples" if calibration is not None else "calibration"
            raise LogError(f"{path}: no {missing} of {robot}; expected a log of khep-twin")
        samples, pose = np.concatenate(registers[robot]), np.concatenate(poses[robot])
        if {len(samples), len(pose)} != {n_samples}:
            counts = f"{len(samples)} samples and {len(pose)} poses"
            raise LogError(f"{path}: {robot}: {counts}; expected {n_samples} of each")
        dark, floor = calibration.ambient.dark_counts, calibration.ambient.floor_counts
        yield _make_periods(model, samples, pose, moves_ns[robot], period_ns, (dark, floor), goal)


def _make_periods(
    model: RobotModel,
    samples: NDArray[np.int32],
    poses: NDArray[np.float64],
    moves_ns: Sequence[int],
    period_ns: int,
    light_limits: tuple[float, float],
    goal: tuple[float, float],
) -> Periods:
    """Return the control periods of one robot.

    Args:
        model: Model of the robot.
        samples: Registers every 20 ms (m, n_registers).
        poses: True x, y [m] and heading [rad] at the same times (m, 3).
        moves_ns: Times at which the robot was moved by hand [ns].
        period_ns: Control period [ns].
        light_limits: Ambient readings in the dark and in the brightest light [counts].
        goal: Position x, y of the goal [m].
    """
    interface, modes = model.episode_interface, list(model.speed_modes)
    times_ns = np.arange(0, (len(samples) - 1) * SAMPLE_NS + 1, period_ns)
    rows, remainder_ns = np.divmod(times_ns, SAMPLE_NS)
    is_between = remainder_ns > 0
    registers, pose = samples[rows].astype(np.int64), poses[rows]
    if is_between.any():
        registers[is_between] = _interpolate(samples[rows[is_between]], samples[rows[is_between] + 1])
        pose_changes = poses[rows[is_between] + 1] - pose[is_between]
        pose_changes[:, 2] = np.remainder(pose_changes[:, 2] + math.pi, 2 * math.pi) - math.pi
        pose[is_between] += pose_changes / 2
        pose[:, 2] = np.remainder(pose[:, 2] + math.pi, 2 * math.pi) - math.pi
    speeds = np.zeros((len(times_ns), 2))
    speeds[1:] = np.diff(registers[:, interface.positions], axis=0) / (period_ns // units.TICK_NS)
    speeds *= interface.speed_per_pulse
    middle_rows = -(-(times_ns[:-1] + period_ns // 2) // SAMPLE_NS)
    commanded = samples[middle_rows][:, interface.setpoints].astype(np.float64)
    # A sample at the end of a period belongs to it, as it has the setpoints of the time before.
    n_other_modes = np.cumsum((samples[:, modes] != list(model.speed_modes.values())).any(axis=1))
    is_complete = np.diff(n_other_modes[rows]) == 0
    for move_ns in moves_ns:
        # A move at a border may affect both periods.
        first_period, last_period = max(-(-move_ns // period_ns) - 1, 0), move_ns // period_ns
        is_complete[first_period : last_period + 1] = False
    return Periods(period_ns, times_ns, registers, speeds, commanded, pose, is_complete, *light_limits, goal)


def _interpolate(start: NDArray[np.int32], end: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the registers of a Khepera a tick after one sample and before the next (n, n_registers)."""
    registers = start.astype(np.int64)
    registers[:, _ENCODERS] = end[:, _ENCODERS] - end[:, _SPEEDS]
    n_converted = units.N_SENSORS // 2
    converted_sensors = (start[:, [Board.SCAN]] + np.arange(n_converted)) % units.N_SENSORS
    for first in (PROXIMITY[0], AMBIENT[0]):
        columns = first + converted_sensors
        np.put_along_axis(registers, columns, np.take_along_axis(end, columns, 1).astype(np.int64), 1)
    return registers


def _count_samples(path: Path, times_ns: NDArray[np.int64]) -> int:
    """Return the number of samples; raise a `LogError` unless there is one every 20 ms from the start."""
    expected_ns = np.arange(len(times_ns)) * SAMPLE_NS
    if (missing := np.flatnonzero(times_ns != expected_ns)).size:
        missing_s = expected_ns[missing[0]] / 1e9
        raise LogError(f"{path}: no sample at {missing_s:.2f} s; expected one every {SAMPLE_NS // 10**6} ms")
    return len(times_ns)


def _find_goal(label: Label, task: Task, path: Path) -> tuple[float, float]:
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
