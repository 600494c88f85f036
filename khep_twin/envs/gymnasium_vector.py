"""A Gymnasium vector environment of many robots, stepped by threads (extra `rl`).

    import khep_twin

    environments = khep_twin.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=8)
    observations, infos = environments.reset(seed=1)
    actions = environments.action_space.sample()
    observations, rewards, terminated, truncated, infos = environments.step(actions)

One call of JIT-compiled code per thread steps all episodes; rewards and observations are computed as arrays
(`task_batch`).
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import CopiedByArguments
from khep_twin.envs.arguments import check_choice, check_mapping, shape_of
from khep_twin.envs.gymnasium import render_metadata, spaces
from khep_twin.envs.info import Info, end_info, start_info
from khep_twin.envs.registration import TimeLimitedSpec
from khep_twin.envs.renderer import Renderer, View
from khep_twin.envs.reset_options import ResetOptions, is_list, validate_seed
from khep_twin.envs.task_batch import TaskBatch
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.episodes.device import Device
from khep_twin.episodes.episode_batch import Slots
from khep_twin.episodes.episode_options import as_integer, check_count
from khep_twin.errors import KhepTwinError, MissingExtraError, value_text
from khep_twin.playpen import PlaypenLike
from khep_twin.process.machine import n_cores
from khep_twin.process.one_thread import one_thread

try:
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error


class KheperaVectorEnvironment(  # pyright: ignore[reportIncompatibleVariableOverride]
    TimeLimitedSpec, CopiedByArguments, VectorEnv[Observation, NDArray[np.float32], NDArray[np.generic]]
):
    """Vector environment of many robots, each in a separate playpen, stepped by threads.

    Each gives the same results as a single environment, for any number of threads: environment i is reset
    with seed + i. Gymnasium's autoreset mode defines the step after the end of an episode:

        NEXT_STEP   the next step starts an episode, ignores the action, and has reward 0
        SAME_STEP   the step that ends an episode returns the observation of the next episode; `infos` holds
                    the last observation and info as "final_obs" and "final_info"
        DISABLED    `reset(options={"reset_mask": mask})` starts the episodes of a mask (num_envs,)

    A copy, also by `pickle`, has the same arguments and random numbers, and needs a `reset`.

    Args:
        num_envs: Number of environments.
        task: Task, or its name.
        threads: Number of threads; by default one per core.
        device: "cpu"; "cuda" for an NVIDIA GPU, with `planar`; or "auto" for a GPU if they fill it.
        autoreset_mode: Autoreset mode, or its value.
        playpen: Playpen instead of the task's, or a list, whose items the environments use in turn.
        options: Other options of `KheperaEnvironment`.

    Attributes:
        labels: Labels of an observation's numbers.
        max_episode_steps: Time limit of an episode in steps, also that of `spec`.
        guard: Lock by which its methods refuse a second thread (`one_thread`).
    """

    COPIED_ATTRIBUTES = ("_spec", "_rngs")

    def __init__(
        self,
        num_envs: int = 1,
        task: Task | str = "ObstacleAvoidance",
        *,
        render_mode: str | None = None,
        view: View = "auto",
        threads: int | None = None,
        device: Device = "cpu",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        playpen: PlaypenLike | Sequence[PlaypenLike] | None = None,
        **options: Any,
    ) -> None:
        self.closed = True  # nothing to close if an argument is invalid
        num_envs = check_count(num_envs, "environments")
        max_threads = n_cores() if threads is None else check_count(threads, "threads")
        self._autoreset_mode = _parse_mode(autoreset_mode)
        playpens = cast(list[Any], list(playpen) if isinstance(playpen, list | tuple) else [playpen])
        if not playpens:
            raise KhepTwinError(
                key="playpen", value=playpen, expected="one playpen, or a list of at least one"
            )
        setups = [TaskSetup(task, playpen=item, **options) for item in playpens[:num_envs]]
        setup = setups[0]
        self._renderers = [Renderer(view) for _ in range(num_envs)]
        self.labels = setup.task.labels
        self.num_envs = num_envs
        self.render_mode = render_mode
        metadata = render_metadata(render_mode, setup.period_ns)
        if render_mode == "human":
            expected = "rgb_array, or one environment by khep_twin.make"
            raise KhepTwinError(key="render_mode", value=render_mode, expected=expected)
        self.metadata = {**metadata, "autoreset_mode": self._autoreset_mode}
        self.max_episode_steps = setup.n_steps
        self.single_observation_space, self.single_action_space = spaces(setup)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._batch = TaskBatch(setups, num_envs, min(max_threads, num_envs), device)
        self.guard = self._batch.guard
        self._all_rows = np.arange(num_envs)
        self._is_over = np.zeros(num_envs, np.bool_)
        self._is_unstarted = ~self._is_over
        self._rngs: list[Any] = [None] * num_envs
        self.closed = False

    @one_thread
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in each environment, or in those of the option "reset_mask" (num_envs,).

        Args:
            seed: Seed of the first environment's episodes, or a list with one per environment.
            options: The mask, and options that replace the environments' in these episodes: seed, start,
                lamps, playpen (`ResetOptions`), each for all, or a list with one per environment.
        """
        self._check_open()
        first = as_integer(seed)
        if seed is None or first is not None:
            seeds = [None if first is None else first + index for index in range(self.num_envs)]
        elif is_list(seed):
            seeds = list(cast(Sequence[int | None], seed))
        else:
            raise ValueError(f"seed = {value_text(seed)}; expected an integer, or a list of them")
        seeds = [None if number is None else validate_seed(number) for number in seeds]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; expected {self.num_envs}")
        reset_options = dict(check_mapping("options", options))
        rows = self._masked_rows(reset_options.pop("reset_mask", None))
        self._start_episodes(rows, seeds, ResetOptions.of_each(reset_options, self.num_envs))
        return self._observations(), self._infos(rows, started_rows=rows)

    @one_thread
    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Advance all by a control period, with speeds of left and right wheel (num_envs, 2)."""
        self._check_open()
        batch, mode = self._batch, self._autoreset_mode
        shape = shape_of(actions)
        if shape != (self.num_envs, 2):
            raise ValueError(f"actions of shape {shape}; expected ({self.num_envs}, 2)")
        rows, started_rows = self._all_rows, self._all_rows[:0]
        if self._is_unstarted.any():
            unstarted = np.flatnonzero(self._is_unstarted).tolist()
            raise ValueError(f"no episode has started in environments {unstarted}; expected reset() first")
        if self._is_over.any():
            if mode is AutoresetMode.DISABLED:
                raise ValueError(
                    f"the episodes of environments {np.flatnonzero(self._is_over).tolist()} are over; "
                    'expected reset(options={"reset_mask": ...}) first'
                )
            if mode is AutoresetMode.NEXT_STEP:
                rows, started_rows = np.flatnonzero(~self._is_over), np.flatnonzero(self._is_over)
                self._start_episodes(started_rows)
        if len(rows):
            batch.step(rows, np.asarray(actions)[rows, None])
        rewards, terminated, truncated = batch.rewards[:, 0].copy(), batch.terminated[:, 0].copy(), batch.over
        self._is_over = terminated | truncated
        ended_rows = np.flatnonzero(self._is_over)
        if mode is not AutoresetMode.SAME_STEP or not len(ended_rows):
            infos = self._infos(self._all_rows, rows, ended_rows, started_rows)
            return self._observations(), rewards, terminated, truncated, infos
        final_observations = np.full(self.num_envs, None, object)
        final_observations[ended_rows] = list(batch.observations[ended_rows, 0])
        final_infos: Info = {"final_obs": final_observations, "_final_obs": self._is_over.copy()}
        final_infos["final_info"] = self._infos(ended_rows, ended_rows, ended_rows)
        final_infos["_final_info"] = self._is_over.copy()
        continuing_rows = np.flatnonzero(~self._is_over)
        self._start_episodes(ended_rows)
        infos = final_infos | self._infos(self._all_rows, continuing_rows, started_rows=ended_rows)
        return self._observations(), rewards, terminated, truncated, infos

    @one_thread
    def render(self) -> tuple[Any, ...]:
        """Return a picture of each environment."""
        if self.render_mode is None:
            return (None,) * self.num_envs
        pairs = zip(self._renderers, self._batch.episodes, strict=True)
        return tuple(renderer.picture(episode) for renderer, episode in pairs)

    @one_thread
    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads, and release the resources of rendering."""
        self._batch.close()
        for renderer in self._renderers:
            renderer.close()

    def _check_open(self) -> None:
        if self.closed:
            raise ValueError("the environments are closed; expected new ones")

    def _start_episodes(
        self, rows: NDArray[np.int64], seeds: Sequence[int | None] = (), options: Sequence[ResetOptions] = ()
    ) -> None:
        """Start some episodes, like `KheperaEnvironment.reset` with each seed and options."""
        episode_seeds: list[int] = []
        for row in map(int, rows):
            seed = seeds[row] if seeds else None
            if self._rngs[row] is None or seed is not None:
                self._rngs[row] = np_random(seed)[0]
            drawn_seed = int(self._rngs[row].integers(2**31))
            requested_seed = options[row].seed if options else None
            episode_seeds.append(drawn_seed if requested_seed is None else requested_seed)
        self._batch.begin(rows, episode_seeds, options)
        self._is_over[rows] = self._is_unstarted[rows] = False

    def _observations(self) -> Observation:
        """Return a copy of the observations (num_envs, n)."""
        return self._batch.observations[:, 0].copy()

    def _infos(
        self,
        rows: NDArray[np.int64],
        stepped_rows: Slots = (),
        ended_rows: Slots = (),
        started_rows: Slots = (),
    ) -> Info:
        """Return the infos of some environments in Gymnasium's form: arrays, each with its mask.

        Args:
            rows: Indices of the environments, including those below.
            stepped_rows: Indices of those that were stepped.
            ended_rows: Indices of those whose episode is over.
            started_rows: Indices of those whose episode has just started.
        """
        batch, infos = self._batch, Info()
        x, y, heading = batch.poses[:, 0].T
        truth = {"x": x, "y": y, "heading": heading, "time": batch.times, "seed": batch.seeds}
        self._add(infos, truth, rows)
        if batch.setup.details and len(stepped_rows):
            if batch.parts:
                parts = self._add({}, {name: part[:, 0] for name, part in batch.parts.items()}, stepped_rows)
                infos |= {"reward_parts": parts, "_reward_parts": self._row_mask(stepped_rows)}
            self._add(infos, {"contact": batch.contacts[:, 0]}, stepped_rows)
        for row in started_rows:
            self._add_info(infos, start_info(batch, int(row)), int(row))
        for row in ended_rows:
            self._add_info(infos, end_info(batch, row=int(row)), int(row))
        return infos

    def _add(self, infos: Info, arrays: Mapping[str, NDArray[np.generic]], rows: Slots) -> Info:
        """Add arrays of some environments, each with its mask; return the infos."""
        mask, has_all_rows = self._row_mask(rows), len(rows) == self.num_envs
        for name, numbers in arrays.items():
            infos[name] = numbers.copy() if has_all_rows else np.where(mask, numbers, numbers.dtype.type(0))
            infos[f"_{name}"] = mask.copy()
        return infos

    def _row_mask(self, rows: Slots) -> NDArray[np.bool_]:
        mask = np.zeros(self.num_envs, np.bool_)
        mask[np.asarray(rows, np.int64)] = True
        return mask

    def _masked_rows(self, mask: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """Return the indices of the environments of a reset mask."""
        if mask is None:
            return self._all_rows
        reset_mask = np.asarray(mask) if shape_of(mask) else np.zeros(0)
        if reset_mask.shape != (self.num_envs,) or reset_mask.dtype != np.bool_ or not reset_mask.any():
            raise ValueError(
                f"reset_mask = {value_text(mask)}; expected an array of {self.num_envs} bool, "
                "at least one of them true"
            )
        return np.flatnonzero(reset_mask)


def _parse_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode by its value."""
    values = [member.value for member in AutoresetMode]
    if not isinstance(mode, AutoresetMode):
        check_choice("autoreset_mode", mode, values)
    return AutoresetMode(mode)
