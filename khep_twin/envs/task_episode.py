"""Episodes of a task: `begin` with a seed, then `step`, with observations and rewards.

    episode = TaskEpisode(TaskSetup("ObstacleAvoidance"))
    episode.begin(seed=1)
    while not episode.over:
        result, = episode.step([(0.5, 0.5)])
        print(result.observation, result.reward)

The dm_env, Gymnasium and PettingZoo environments are built on these episodes. A step is one control period,
50 ms by default (the cycle of the Khepera Toolbox's controllers): the speeds are set as by a command D
without delay, physics, sensors and control loops run at their rates, and the robots are observed again.
An episode depends only on its seed and its actions, not on earlier episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import NotCopied
from khep_twin.envs.reset_options import ResetOptions, is_list, validate_seed
from khep_twin.envs.task_batch import TaskBatch
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation
from khep_twin.episodes.episode import Episode
from khep_twin.errors import value_text
from khep_twin.renamed import renamed_attribute

_ROW = np.zeros(1, np.int64)
"""Index of the only episode in its batch."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """Results of one robot's step.

    Attributes:
        observation: Observation after the step (n,).
        reward: Reward for this control period, 0 to 1.
        terminated: Whether the charge has run out.
    """

    observation: Observation
    reward: float
    terminated: bool
    ended = renamed_attribute("ended", "terminated")


class TaskEpisode(NotCopied):
    """One episode at a time; `begin` starts a new one.

    Args:
        setup: Prepared task.

    Attributes:
        batch: Batch with only this episode.
        guard: Lock by which its methods refuse a second thread, the batch's.
    """

    COPY_ADVICE = "another TaskEpisode of the same setup, started with the same seed"

    def __init__(self, setup: TaskSetup) -> None:
        if not isinstance(setup, TaskSetup):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ValueError(f"setup = {value_text(setup)}; expected a TaskSetup")
        self.setup = setup
        self.batch = TaskBatch(setup)
        self.guard = self.batch.guard
        self._n_robots = len(setup.playpen.robots)

    def begin(self, seed: int, options: ResetOptions | None = None) -> list[Observation]:
        """Start an episode; return each robot's observation.

        Args:
            seed: Seed of the episode.
            options: Options that replace the setup's; their seed is not used.

        Raises:
            PlaypenError: There is no room for the robots.
            ValueError: The seed is negative or too large.
        """
        self.batch.begin(_ROW, [validate_seed(seed)], [options] if options else ())
        return list(self.batch.observations[0])

    def step(self, actions: Sequence[object]) -> list[StepResult]:
        """Advance by a control period.

        Args:
            actions: Speeds of each robot's wheels, left and right, as fractions of the top speed, or in
                pulses/10 ms if not normalized; clipped, and rounded to whole pulses.

        Raises:
            DivergedError: A speed is NaN, or the physics has diverged.
            ValueError: The episode is over, the number of actions is not that of the robots, or one of them
                is not two numbers.
        """
        batch = self.batch
        if self.over:
            raise ValueError("the episode is over, or none has started; expected begin() first")
        if not is_list(actions):
            raise ValueError(f"actions = {value_text(actions)}; expected a list with one for each robot")
        if len(actions) != self._n_robots:
            raise ValueError(f"{len(actions)} actions; expected {self._n_robots}, one for each robot")
        batch.step(_ROW, [actions])
        rewards, terminated = batch.rewards[0].tolist(), batch.terminated[0].tolist()
        return [StepResult(*row) for row in zip(batch.observations[0], rewards, terminated, strict=True)]

    @property
    def over(self) -> bool:
        """True at the time limit, or if no episode has started."""
        return bool(self.batch.over[0])

    @property
    def time_s(self) -> float:
        """Simulated time [s]."""
        return float(self.batch.times[0])

    @property
    def poses(self) -> Sequence[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of the robots."""
        return [(x, y, heading) for x, y, heading in self.batch.poses[0].tolist()]

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Registers of each robot's board (N_REGISTERS,), live."""
        return list(self.batch.episodes[0].boards)

    @property
    def episode(self) -> Episode:
        """Episode of the robots, for its playpen, poses and objects."""
        return self.batch.episodes[0]

    @property
    def data(self) -> mujoco.MjData:
        """State of MuJoCo's scene, live.

        Raises:
            ValueError: The setup is `planar`.
        """
        return self.batch.episodes[0].data
