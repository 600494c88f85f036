"""Tasks as Gymnasium environments (extra `rl`), single or vectorized.

    import khep_twin

    environment = khep_twin.make("khep_twin/ObstacleAvoidance-v0", vary=True)
    observation, info = environment.reset(seed=1)
    observation, reward, terminated, truncated, info = environment.step(environment.action_space.sample())

    many = khep_twin.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=8)

`make` and `make_vec` are Gymnasium's functions, except that a new time replaces the limit of a spec. A
program with `gymnasium.make` also imports `khep_twin`, or names it:
`gymnasium.make("khep_twin:khep_twin/ObstacleAvoidance-v0")` (`registration`).

Observation: the task's terms, each number normalized to -1 to 1 (`tasks.terms_of` defines order and ranges).
Action: speeds of left and right wheel, -1 to 1; 1 is 20 pulses/10 ms, 160 mm/s.
With `normalize=False` both are in the robot's units, counts and pulses/10 ms.
With `planar=True` a 2-D model replaces MuJoCo, and runs many times faster.
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import CopiedByArguments
from khep_twin.drawing.mujoco_viewer import has_screen
from khep_twin.envs.arguments import check_choice
from khep_twin.envs.info import Info, end_info, ground_truth, start_info, step_info
from khep_twin.envs.registration import TimeLimitedSpec, register, remove_stale_limit
from khep_twin.envs.renderer import Picture, Renderer, View
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.errors import MissingExtraError
from khep_twin.process.one_thread import one_thread

try:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.spaces import Box, Space
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error

if TYPE_CHECKING:
    from khep_twin.drawing.window import PictureWindow

Options = ParamSpec("Options")
Environment = TypeVar("Environment")

RENDER_MODES = ("human", "rgb_array")


def _replace_limit(
    function: Callable[Concatenate[str | EnvSpec, Options], Environment],
) -> Callable[Concatenate[str | EnvSpec, Options], Environment]:
    """Return `gymnasium.make` or `make_vec`, in which a new time replaces the limit of a spec."""

    @wraps(function)
    def make_environment(
        id: str | EnvSpec, *arguments: Options.args, **options: Options.kwargs
    ) -> Environment:
        return function(remove_stale_limit(id, options), *arguments, **options)

    return make_environment


make, make_vec = _replace_limit(gymnasium.make), _replace_limit(gymnasium.make_vec)


def spaces(setup: TaskSetup) -> tuple[Space[Any], Space[Any]]:
    """Return the observation space and action space of a task."""
    low, high = setup.task.bounds(setup.normalize)
    limit = setup.action_limit
    return Box(low, high, dtype=np.float32), Box(-limit, limit, (2,), np.float32)


def render_metadata(render_mode: str | None, period_ns: int) -> Info:
    """Return Gymnasium's metadata: the render modes usable here, and a frame for each control period.

    Raises:
        KhepTwinError: The render mode is unknown.
    """
    if render_mode is not None:
        check_choice("render_mode", render_mode, RENDER_MODES)
    modes = RENDER_MODES if has_screen() else RENDER_MODES[1:]
    return {"render_modes": list(modes), "render_fps": 1e9 / period_ns}


def open_window(render_mode: str | None, metadata: Info) -> "PictureWindow | None":
    """Return the window of the render mode "human", which opens with the first picture; None for others."""
    if render_mode != "human":
        return None
    from khep_twin.drawing.window import PictureWindow

    return PictureWindow("khep_twin", metadata["render_fps"])


class KheperaEnvironment(  # pyright: ignore[reportIncompatibleVariableOverride]
    TimeLimitedSpec, CopiedByArguments, gymnasium.Env[Observation, NDArray[np.float32]]
):
    """A task for one robot.

    An episode is truncated at its time limit, and terminated when the robot's charge has run out. A copy,
    also by `pickle`, has the same arguments and random numbers, and needs a `reset`.

    `info` holds the ground truth, unknown to the robot: "x" and "y" [m], "heading" [rad], "time" [s], and
    "seed", by which `reset(options={"seed": ...})` repeats the episode. Module `info` lists its other keys.

    Args:
        task: Task, or its name.
        render_mode: "rgb_array", "human" for a window that shows each step in real time, or None.
        view: View of pictures: "scene" by MuJoCo, "map", or "auto" (`renderer.Renderer`).
        options: Options of `TaskSetup`: playpen, start, lamps, randomize, noise, vary, period_ns, seconds,
            max_episode_steps, planar, compiled, normalize, details, line.

    Attributes:
        labels: Labels of the observation's numbers.
        max_episode_steps: Time limit of an episode in steps, also that of `spec`.
        guard: Lock by which its methods refuse a second thread (`one_thread`).
    """

    COPIED_ATTRIBUTES = ("_spec", "_np_random", "_np_random_seed")
    metadata: Info = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: Task | str = "ObstacleAvoidance",
        *,
        render_mode: str | None = None,
        view: View = "auto",
        **options: Any,
    ) -> None:
        self._setup = TaskSetup(task, **options)
        self._episode = TaskEpisode(self._setup)
        self.guard = self._episode.guard
        self._is_over = True
        self.render_mode = render_mode
        self.metadata = render_metadata(render_mode, self._setup.period_ns)
        self._renderer = Renderer(view)
        self._window = open_window(render_mode, self.metadata)
        self.max_episode_steps = self._setup.n_steps
        self.labels = self._setup.task.labels
        self.observation_space, self.action_space = spaces(self._setup)

    @one_thread
    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Start an episode; a seed makes it and all later episodes reproducible.

        Args:
            seed: Seed of this and all later episodes.
            options: Options that replace the environment's in this episode: seed, start, lamps, playpen
                (`ResetOptions`).
        """
        request = ResetOptions.of(options)
        super().reset(seed=seed)
        drawn_seed = int(self.np_random.integers(2**31))
        observation = self._episode.begin(drawn_seed if request.seed is None else request.seed, request)[0]
        self._is_over, batch = False, self._episode.batch
        self._show()
        return observation, ground_truth(batch) | start_info(batch)

    @one_thread
    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Advance by a control period with these speeds of left and right wheel (2,).

        Raises:
            ValueError: The episode is over, or none has started, or the action is not two numbers.
        """
        if self._is_over:
            raise ValueError("the episode is over, or none has started; expected reset() first")
        (outcome,) = self._episode.step([action])
        truncated = self._episode.over
        self._is_over, batch = truncated or outcome.terminated, self._episode.batch
        info = ground_truth(batch) | step_info(batch)
        if self._is_over:
            info |= end_info(batch)
        self._show()
        return outcome.observation, outcome.reward, outcome.terminated, truncated, info

    @one_thread
    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the current state in mode "rgb_array"; otherwise None."""
        if self.render_mode != "rgb_array":
            return None
        return self._renderer.picture(self._episode.episode)

    @one_thread
    def close(self) -> None:
        """Release the resources of rendering."""
        self._renderer.close()
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._renderer.picture(self._episode.episode))


register()
