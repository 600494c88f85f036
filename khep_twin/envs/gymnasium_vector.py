"""Many robots as one vectorized Gymnasium environment, stepped by threads (extra `rl`).

    import gymnasium
    import khep_twin.envs.gymnasium  # registers the environments

    environments = gymnasium.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=8)
    observations, infos = environments.reset(seed=1)
    actions = environments.action_space.sample()
    observations, rewards, terminated, truncated, infos = environments.step(actions)

Compiled episodes release Python's lock while they step, so that threads run at the same time.
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.envs.gymnasium import Info, KheperaEnvironment, spaces
from khep_twin.envs.renderer import View
from khep_twin.envs.task_episode import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.errors import KhepTwinError, MissingExtraError, choices

try:
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error

Result = TypeVar("Result")


class KheperaVectorEnvironment(VectorEnv[Observation, NDArray[np.float32], NDArray[np.generic]]):
    """Many robots, each in a playpen of its own, stepped by threads.

    Each gives the same results as a single environment, for any number of threads: robot i starts with the
    seed + i. What follows the end of an episode is Gymnasium's autoreset mode:

        NEXT_STEP   the next step starts an episode; it ignores the action, and has reward 0
        SAME_STEP   the step that ends an episode returns the observation of the next one; `infos` has its
                    own last ones as "final_obs" and "final_info"
        DISABLED    `reset(options={"reset_mask": over})` starts the episodes of a mask (num_envs,)

    Args:
        num_envs: Number of environments.
        task: Task, or its name.
        threads: Number of threads; by default one per core.
        autoreset_mode: Autoreset mode, or its value.
        options: Options of `KheperaEnvironment`.

    Attributes:
        labels: Labels of an observation's numbers.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: Task | str = "ObstacleAvoidance",
        *,
        render_mode: str | None = None,
        view: View = "auto",
        threads: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        self.closed = True  # nothing to close if an argument is wrong
        for name, number in (("environments", num_envs), ("threads", 1 if threads is None else threads)):
            if number < 1:
                raise ValueError(f"{number} {name}; expected 1 or more")
        self._autoreset_mode = _checked_mode(autoreset_mode)
        setup = TaskSetup(task, **options)
        self._all = [
            KheperaEnvironment(setup=setup, render_mode=render_mode, view=view) for _ in range(num_envs)
        ]
        self.labels = setup.task.labels
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**self._all[0].metadata, "autoreset_mode": self._autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(setup)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._threads = min(threads or len(os.sched_getaffinity(0)), num_envs)
        self._pool = ThreadPoolExecutor(max(self._threads - 1, 1))  # beside the caller's
        self._observations: list[Observation] = [np.zeros(len(self.labels), np.float32)] * num_envs
        self._over = np.zeros(num_envs, np.bool_)
        self.closed = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in each environment, or in those of the option "reset_mask" (num_envs,)."""
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; expected {self.num_envs}")
        others = dict(options or {})
        chosen = self._chosen(others.pop("reset_mask", None))
        begun = self._share_out(chosen, lambda i: self._all[i].reset(seed=seeds[i], options=others))
        infos: Info = {}
        for index, (observation, info) in zip(chosen, begun, strict=True):
            self._observations[index], self._over[index] = observation, False
            infos = self._add_info(infos, info, index)
        return np.stack(self._observations), infos

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Advance all by a control period with these speeds of left and right wheel (num_envs, 2)."""
        if np.shape(actions)[:1] != (self.num_envs,):
            raise ValueError(f"actions of shape {np.shape(actions)}; expected ({self.num_envs}, 2)")
        if self._autoreset_mode is AutoresetMode.DISABLED and self._over.any():
            raise ValueError(
                f"the episodes of environments {np.flatnonzero(self._over).tolist()} are over; "
                'expected reset(options={"reset_mask": ...}) first'
            )
        results = self._share_out(range(self.num_envs), lambda index: self._step_one(index, actions[index]))
        observations, rewards, ended, late, each_info = zip(*results, strict=True)
        self._observations = list(observations)
        terminated, truncated = np.array(ended, np.bool_), np.array(late, np.bool_)
        self._over = terminated | truncated
        infos: Info = {}
        for index, info in enumerate(each_info):
            infos = self._add_info(infos, info, index)
        return np.stack(observations), np.array(rewards, np.float64), terminated, truncated, infos

    def render(self) -> tuple[Any, ...]:
        """Return a picture of each environment."""
        return tuple(each.render() for each in self._all)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._pool.shutdown()
        for each in self._all:
            each.close()

    def _step_one(
        self, index: int, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, Info]:
        each, mode = self._all[index], self._autoreset_mode
        if mode is AutoresetMode.NEXT_STEP and self._over[index]:
            observation, info = each.reset()
            return observation, 0.0, False, False, info
        observation, reward, terminated, truncated, info = each.step(action)
        if mode is AutoresetMode.SAME_STEP and (terminated or truncated):
            final = {"final_obs": observation, "final_info": info}
            observation, info = each.reset()
            info = {**final, **info}
        return observation, reward, terminated, truncated, info

    def _chosen(self, mask: NDArray[np.bool_] | None) -> Sequence[int]:
        """Return the indices of the environments of a reset mask."""
        if mask is None:
            return range(self.num_envs)
        given = np.asarray(mask)
        if given.shape != (self.num_envs,) or given.dtype != np.bool_ or not given.any():
            raise ValueError(
                f"reset_mask = {mask!r}; expected an array of {self.num_envs} bool, at least one of them true"
            )
        return [int(index) for index in np.flatnonzero(given)]

    def _share_out(self, indices: Sequence[int], action: Callable[[int], Result]) -> list[Result]:
        """Call a function for each of some environments; each thread has a share."""
        results: list[Any] = [None] * len(indices)

        def work(first: int) -> None:
            for place in range(first, len(indices), self._threads):
                results[place] = action(indices[place])

        shares = [self._pool.submit(work, first) for first in range(1, min(self._threads, len(indices)))]
        try:
            work(0)
        finally:
            wait(shares)  # so that no thread is still at work when one has raised an error
        for share in shares:
            share.result()
        return results


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode by its value."""
    values = [each.value for each in AutoresetMode]
    if not isinstance(mode, AutoresetMode) and mode not in values:
        raise KhepTwinError(f"autoreset_mode {mode!r}: unknown; {choices(str(mode), values)}")
    return AutoresetMode(mode)
