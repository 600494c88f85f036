"""Tasks as Gymnasium environments (extra `rl`), single or vectorized.

    import gymnasium
    import khep_twin.envs.gymnasium  # registers the environments

    environment = gymnasium.make("khep_twin/ObstacleAvoidance-v0", vary=True)
    observation, info = environment.reset(seed=1)
    observation, reward, terminated, truncated, info = environment.step(environment.action_space.sample())

    many = gymnasium.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=8)

Observation: the task's terms, each 0 to 1 or -1 to 1 (`tasks.TERMS` has order and units).
Action: speeds of left and right wheel, -20 to 20 [pulses/10 ms], 8 mm/s each, rounded to integers.
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.envs.renderer import Picture, Renderer, View
from khep_twin.envs.task_episode import TaskEpisode, TaskSetup, clipped
from khep_twin.envs.tasks import TASKS, TOP_SPEED, Observation, Task
from khep_twin.errors import KhepTwinError, MissingExtraError, choices

try:
    import gymnasium
    from gymnasium.spaces import Box, Space
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error

Info = dict[str, Any]
"""Gymnasium's type of metadata, options and ground truth."""

RENDER_MODES = ("rgb_array",)

Result = TypeVar("Result")


def ground_truth(episode: TaskEpisode, robot: int, seed: int) -> Info:
    """Return what a robot's trial has in `info`."""
    x, y, heading = episode.poses[robot]
    return {"x": x, "y": y, "heading": heading, "time": episode.time_s, "seed": seed}


def spaces(task: Task) -> tuple[Space[Any], Space[Any]]:
    """Return a task's observation space and action space [pulses/10 ms]."""
    low, high = task.bounds
    return Box(low, high, dtype=np.float32), Box(-TOP_SPEED, TOP_SPEED, (2,), np.float32)


class KheperaEnvironment(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A task for one robot.

    An episode is truncated at its time limit, and terminates when the robot's charge has run out.

    `info` has ground truth, unknown to the robot: "x" and "y" [m], "heading" [rad], "time" [s], and "seed",
    which repeats the episode: `reset(options={"seed": ...})`.

    Args:
        task: Task, or its name.
        render_mode: "rgb_array", or None for no pictures.
        view: View of pictures: "scene" by MuJoCo, "map", or "auto" (`view.Painter`).
        setup: Prepared task, instead of the task and options.
        options: Options of `TaskSetup`: playpen, noise, vary, period_ns, seconds, compiled.

    Attributes:
        labels: Labels of the observation's numbers.
    """

    metadata: Info = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: Task | str = "ObstacleAvoidance",
        *,
        render_mode: str | None = None,
        view: View = "auto",
        setup: TaskSetup | None = None,
        **options: Any,
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise KhepTwinError(f"render_mode {render_mode!r}: unknown; {choices(render_mode, RENDER_MODES)}")
        self._setup = setup or TaskSetup(task, **options)
        self._episode = TaskEpisode(self._setup)
        self._seed = 0
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": 1e9 / self._setup.period_ns}
        self._painter = Renderer(self._setup.playpen, view)
        self.labels = self._setup.task.labels
        self.observation_space, self.action_space = spaces(self._setup.task)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Start an episode; a seed makes it and all later episodes reproducible."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31))
        self._seed = int((options or {}).get("seed", drawn))
        return self._episode.begin(self._seed)[0], ground_truth(self._episode, 0, self._seed)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Advance by a control period at these speeds of left and right wheel [pulses/10 ms] (2,)."""
        (outcome,) = self._episode.step([clipped(action)])
        info = ground_truth(self._episode, 0, self._seed)
        return outcome.observation, outcome.reward, outcome.ended, self._episode.over, info

    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the present state; None without a render mode."""
        if self.render_mode is None:
            return None
        return self._painter.picture(self._episode.data, self._episode.poses)

    def close(self) -> None:
        """Release the resources of rendering."""
        self._painter.close()


class KheperaVectorEnvironment(VectorEnv[Observation, NDArray[np.float32], NDArray[np.generic]]):
    """Many robots, each in a playpen of its own, stepped by threads.

    Each gives the same results as a single environment, for any number of threads: robot i starts with the
    seed + i. After the end of an episode the next step starts another, ignores the action, and has reward 0.

    Args:
        num_envs: Number of environments.
        task: Task, or its name.
        threads: Number of threads; by default one per core.
        options: Options of `KheperaEnvironment`.
    """

    metadata: ClassVar[Info] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        **KheperaEnvironment.metadata,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        task: Task | str = "ObstacleAvoidance",
        *,
        render_mode: str | None = None,
        view: View = "auto",
        threads: int | None = None,
        **options: Any,
    ) -> None:
        for name, number in (("environments", num_envs), ("threads", 1 if threads is None else threads)):
            if number < 1:
                raise ValueError(f"{number} {name}; expected 1 or more")
        setup = TaskSetup(task, **options)
        self._all = [
            KheperaEnvironment(setup=setup, render_mode=render_mode, view=view) for _ in range(num_envs)
        ]
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self.single_action_space = spaces(setup.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._threads = min(threads or len(os.sched_getaffinity(0)), num_envs)
        self._pool = ThreadPoolExecutor(self._threads)
        self._over = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in each environment."""
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; expected {self.num_envs}")
        begun = self._share_out(lambda i: self._all[i].reset(seed=seeds[i], options=options))
        self._over[:] = False
        return np.stack([observation for observation, _ in begun]), self._infos([info for _, info in begun])

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Advance all by a control period at these speeds [pulses/10 ms] (num_envs, 2)."""

        def one(index: int) -> tuple[Observation, float, bool, bool, Info]:
            each = self._all[index]
            if self._over[index]:
                observation, info = each.reset()
                return observation, 0.0, False, False, info
            return each.step(actions[index])

        if np.shape(actions)[:1] != (self.num_envs,):
            raise ValueError(f"actions of shape {np.shape(actions)}; expected ({self.num_envs}, 2)")
        observations, rewards, ended, late, infos = zip(*self._share_out(one), strict=True)
        terminated, truncated = np.array(ended, np.bool_), np.array(late, np.bool_)
        self._over = terminated | truncated
        return (
            np.stack(observations),
            np.array(rewards, np.float64),
            terminated,
            truncated,
            self._infos(infos),
        )

    def render(self) -> tuple[Any, ...]:
        """Return a picture of each environment."""
        return tuple(each.render() for each in self._all)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._pool.shutdown()
        for each in self._all:
            each.close()

    def _share_out(self, action: Callable[[int], Result]) -> list[Result]:
        """Call a function for each environment; each thread has a share."""
        results: dict[int, Result] = {}

        def work(first: int) -> None:
            for index in range(first, self.num_envs, self._threads):
                results[index] = action(index)

        for done in [self._pool.submit(work, first) for first in range(self._threads)]:
            done.result()
        return [results[index] for index in range(self.num_envs)]

    def _infos(self, infos: Sequence[Info]) -> Info:
        found: Info = {}
        for index, info in enumerate(infos):
            found = self._add_info(found, info, index)
        return found


def register() -> None:
    """Register the tasks with Gymnasium as khep_twin/NAME-v0."""
    for name in TASKS:
        if (known := f"khep_twin/{name}-v0") not in gymnasium.registry:
            gymnasium.register(
                known,
                entry_point=f"{__name__}:{KheperaEnvironment.__name__}",
                vector_entry_point=f"{__name__}:{KheperaVectorEnvironment.__name__}",
                kwargs={"task": name},
            )


register()
