"""Episodes of a task from logs, as arrays: observations, actions, rewards, terminations and truncations.

    for episode in episodes_of("run.mcap", find("ObstacleAvoidance"), 50_000_000):
        print(episode.observations.shape, episode.rewards.mean())

The values are those of the task's environment for the same drive (`khep_twin.envs.gymnasium`), normalized to
-1 to 1. The action of a period is the commanded speeds in its middle.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import n_steps, to_ns
from khep_twin.envs.tasks import Observation, State, Task
from khep_twin.errors import LogError
from khep_twin.files.paths import StrPath
from khep_twin.lab.dataset import replies, samples
from khep_twin.lab.dataset.periods import Periods, check_period
from khep_twin.lab.report.export import choose_robots
from khep_twin.log.reader import read_first_messages


@dataclass(frozen=True, slots=True)
class OfflineEpisode:
    """An episode of n steps, with the observation before the first step.

    Attributes:
        observations: Observations (n + 1, m), -1 to 1.
        actions: Speeds of left and right wheel (n, 2), -1 to 1.
        rewards: Rewards (n,), 0 to 1.
        terminations: True in the step that ended the task (n,).
        truncations: True in the last step, at the time limit or before an incomplete period (n,).
        infos: Ground truth by name, (n + 1,) each: "x", "y" [m], "heading" [rad], "time" [s].
        source: Origin of the episode by name, e.g. "log" and "robot".
        seed: Seed of the environment; None for a log.
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    infos: Mapping[str, NDArray[np.float64]]
    source: Mapping[str, str]
    seed: int | None = None


def episodes_of(
    path: StrPath,
    task: Task,
    period_ns: int,
    robot: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[OfflineEpisode]:
    """Yield the episodes of a log's robots.

    An episode ends when the task ends, and is truncated at the task's time limit and at an incomplete period
    (`samples.periods_of`, `replies.periods_of`); the next one starts there.

    Args:
        path: Path of the log.
        task: Task of the observations and rewards.
        period_ns: Control period [ns], a multiple of 10 ms.
        robot: Name of the robot; by default each robot of the log.
        progress: Function that is called with the fraction of the log that has been read, 0 to 1.

    Raises:
        LogError: The log is incomplete, or lacks data for the task; the period does not fit the task.
    """
    path, limit_ns = Path(path), to_ns(task.seconds)
    check_period(period_ns, limit_ns)
    recording = read_first_messages(path)
    robots = choose_robots(recording, robot)
    if "relay" in recording.label.metadata:
        all_periods = iter([replies.periods_of(path, robots[0], task, period_ns)])
    elif f"/{robots[0]}/registers" in recording.series:
        all_periods = samples.periods_of(path, recording.label, robots, task, period_ns, progress)
    else:
        raise LogError(f"{path}: no registers of {robots[0]}; expected the log of a twin or of a real robot")
    for name, periods in zip(robots, all_periods, strict=True):
        stretches = periods.stretches(n_steps(limit_ns, period_ns))
        if not stretches:
            raise LogError(
                f"{path}: {name}: no control period of {period_ns / 1e6:g} ms with all data for {task.name} "
                "and with speeds of the wheels; expected a longer log or another --period"
            )
        for first, last in stretches:
            yield _episode(task, periods, first, last, {"log": path.name, "robot": name})


def _episode(
    task: Task, periods: Periods, first: int, last: int, source: Mapping[str, str]
) -> OfflineEpisode:
    """Return the episode from one border to another, or to an earlier end of the task."""
    full_ns = charge_ns = to_ns(task.charge_s)
    observations: list[Observation] = []
    rewards: list[float] = []
    for border in range(first, last + 1):
        at_goal = _is_at_goal(task, periods, border)
        if border > first and full_ns:
            charge_ns = full_ns if at_goal else max(charge_ns - periods.period_ns, 0)
        left, right = periods.speeds[border].tolist()
        registers, charge = periods.registers[border], charge_ns / full_ns if full_ns else 1.0
        state = State(registers, left, right, periods.dark, periods.floor, at_goal, charge, task.model)
        observations.append(task.observe(state))
        rewards.append(task.reward(state))
        if charge <= 0:
            last = border
            break
    steps = slice(first, last)
    borders = slice(first, last + 1)
    terminations = np.zeros(last - first, np.bool_)
    terminations[-1] = charge_ns == 0 and full_ns > 0
    truncations = np.zeros(last - first, np.bool_)
    truncations[-1] = not terminations[-1]
    infos = {"time": periods.times_ns[borders] / 1e9}
    if periods.poses is not None:
        infos |= dict(zip(("x", "y", "heading"), periods.poses[borders].T, strict=True))
    actions = np.clip(periods.commanded[steps] / task.top_speed, -1, 1).astype(np.float32)
    return OfflineEpisode(
        np.stack(observations),
        actions,
        np.array(rewards[1:], np.float64),
        terminations,
        truncations,
        infos,
        source,
    )


def _is_at_goal(task: Task, periods: Periods, border: int) -> bool:
    """Return whether the robot is at the task's goal."""
    if not task.goal or periods.poses is None:
        return False
    x, y, _ = periods.poses[border].tolist()
    dx, dy = x - periods.goal[0], y - periods.goal[1]
    radius = units.metres(task.reach_mm)
    return dx * dx + dy * dy <= radius * radius
