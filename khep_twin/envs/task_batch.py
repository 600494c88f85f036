"""Episodes of a task side by side, with the numbers of all robots in arrays.

    batch = TaskBatch(TaskSetup("ObstacleAvoidance", planar=True), 32)
    rows = np.arange(32)
    batch.begin(rows, seeds=range(32))
    batch.step(rows, np.ones((32, 1, 2)))
    print(batch.observations, batch.rewards)

Compiled code steps all episodes in one call for each thread; speeds, rewards and observations of all robots
are computed as arrays. An episode depends on its seed and its actions alone, not on the others.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.clock import to_ns
from khep_twin.copies import NotCopied
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, State
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.one_thread import one_thread

_ENCODERS = [LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]


class TaskBatch(NotCopied):
    """Episodes of a task; each one begins with `begin`.

    Args:
        setup: Prepared task.
        count: Number of episodes.
        threads: Number of threads.

    Attributes:
        setup: Prepared task.
        observations: Observations of the robots (n, n_robots, n_numbers).
        rewards: Rewards of the last control period, 0 to 1 (n, n_robots).
        ended: Whether the charge has run out (n, n_robots).
        periods: Control periods since the start (n,); those of a whole episode before the first.
        seeds: Seed of each episode (n,).
        poses: True x, y [m] and heading [rad] of the robots, live (n, n_robots, 3).
        guard: Guard of its methods, its episodes'.
    """

    INSTEAD = "another TaskBatch of the same setup, begun with the same seeds"

    def __init__(self, setup: TaskSetup, count: int = 1, threads: int = 1) -> None:
        self.setup = setup
        self._batch = EpisodeBatch([setup.episode() for _ in range(count)], threads)
        self.guard, self.poses = self._batch.guard, self._batch.poses
        shape = count, len(setup.playpen.robots)
        self.observations: Observation = np.zeros((*shape, len(setup.task.labels)), np.float32)
        self.rewards, self.ended = np.zeros(shape), np.zeros(shape, np.bool_)
        self.periods, self.seeds = np.full(count, setup.n_steps), np.zeros(count, np.int64)
        self._pulses = np.zeros((*shape, 2), np.int64)
        self._charge_ns = to_ns(setup.task.charge_s)
        self._charges_ns = np.zeros(shape, np.int64)

    @one_thread
    def begin(self, rows: NDArray[np.int64], seeds: Iterable[int]) -> None:
        """Start some episodes.

        Args:
            rows: Indices of the episodes (n_rows,).
            seeds: Seed of each.

        Raises:
            PlaypenError: There is no room for the robots.
            ValueError: A seed is negative or too large.
        """
        setup = self.setup
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            robots = setup.started(seed).robots
            starts = [(robot.x_mm, robot.y_mm, robot.heading_deg) for robot in robots]
            self._batch.begin(row, seed, EpisodeOptions(start=starts, noise=setup.noise, vary=setup.vary))
            self.seeds[row] = seed
        self.periods[rows], self._charges_ns[rows] = 0, self._charge_ns
        self._pulses[rows] = self._batch.registers[rows][..., _ENCODERS]
        self.rewards[rows], self.ended[rows] = 0.0, False
        self._observe(rows, self._state(rows))

    @one_thread
    def step(self, rows: NDArray[np.int64], actions: object) -> None:
        """Advance some episodes by a control period.

        Args:
            rows: Indices of the episodes (n_rows,).
            actions: Speeds of each robot's wheels (n_rows, n_robots, 2), as parts of the top speed, or, if
                not normalized, in pulses/10 ms; clipped, and rounded to whole pulses.

        Raises:
            DivergedError: A speed is no number, or the physics left its bounds.
            ValueError: An action is not two numbers, or there is not one for each robot.
        """
        speeds, shape = self.setup.speeds(actions), (len(rows), self.rewards.shape[1])
        if speeds.shape != (*shape, 2):
            raise ValueError(f"actions of shape {speeds.shape}; expected {(*shape, 2)}")
        self._batch.speeds[rows] = speeds
        failed = self._batch.step(rows, self.setup.steps_per_period)
        self.periods[rows] += 1
        if failed:
            self.periods[list(failed)] -= 1
            raise next(iter(failed.values()))
        state = self._state(rows)
        self.rewards[rows] = self.setup.task.rewards(state).reshape(shape)
        if self._charge_ns:
            self.ended[rows] = (state.charge <= 0).reshape(shape)
        self._observe(rows, state)

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes, for the state of the scene and the boards."""
        return self._batch.episodes

    @property
    def over(self) -> NDArray[np.bool_]:
        """True for each episode whose time is over, or which has not begun (n,)."""
        return self.periods >= self.setup.n_steps

    @property
    def times(self) -> NDArray[np.float64]:
        """Simulated time of each episode (n,) [s]."""
        return self.periods * self.setup.period_ns / 1e9

    def close(self) -> None:
        """End the threads."""
        self._batch.close()

    def _state(self, rows: NDArray[np.int64]) -> State:
        """Return the state of all robots of some episodes; count what their wheels and charges have done."""
        setup = self.setup
        registers = self._batch.registers[rows]
        counted = registers[..., _ENCODERS]
        speeds = (counted - self._pulses[rows]) / (setup.period_ns // units.TICK_NS)
        self._pulses[rows] = counted
        at_goal, charge = np.zeros(counted.shape[:2], np.bool_), np.ones(counted.shape[:2])
        if setup.task.goal:
            dx, dy = self.poses[rows, :, 0] - setup.goal[0], self.poses[rows, :, 1] - setup.goal[1]
            at_goal = dx * dx + dy * dy <= units.metres(setup.task.reach_mm) ** 2
        if self._charge_ns:
            left_ns = np.maximum(self._charges_ns[rows] - setup.period_ns, 0)
            begun = self.periods[rows][:, None] == 0
            charges_ns = np.where(at_goal | begun, self._charge_ns, left_ns)
            self._charges_ns[rows], charge = charges_ns, charges_ns / self._charge_ns
        left, right = speeds.reshape(-1, 2).T
        boards = registers.reshape(-1, registers.shape[2]).T
        return State(boards, left, right, setup.dark, setup.floor, at_goal.reshape(-1), charge.reshape(-1))

    def _observe(self, rows: NDArray[np.int64], state: State) -> None:
        """Set the observations of some episodes; arrays of earlier ones stay as they are."""
        seen = self.setup.task.observe(state, self.setup.normalize)
        if len(rows) < len(self.observations):
            self.observations = self.observations.copy()
            self.observations[rows] = seen.reshape(-1, *self.observations.shape[1:])
        else:
            self.observations = seen.reshape(self.observations.shape)
