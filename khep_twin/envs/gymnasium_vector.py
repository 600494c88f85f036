"""Many robots as one vectorized Gymnasium environment, stepped by threads (extra `rl`).

    import khep_twin

    environments = khep_twin.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=8)
    observations, infos = environments.reset(seed=1)
    actions = environments.action_space.sample()
    observations, rewards, terminated, truncated, infos = environments.step(actions)

All episodes are stepped by one call of compiled code for each thread, and their rewards and observations are
computed as arrays (`task_batch`).
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

import operator
from collections.abc import Mapping, Sequence
from typing import Any, SupportsIndex, cast

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import MadeAnew
from khep_twin.envs.gymnasium import rendering, spaces
from khep_twin.envs.info import Info, of_end, of_start
from khep_twin.envs.renderer import Renderer, View
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_batch import TaskBatch
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.episodes.device import Device
from khep_twin.episodes.episode_batch import Rows
from khep_twin.episodes.episode_options import checked_count
from khep_twin.errors import KhepTwinError, MissingExtraError, choices
from khep_twin.machine import n_cores
from khep_twin.one_thread import one_thread
from khep_twin.playpen import PlaypenLike

try:
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error


class KheperaVectorEnvironment(MadeAnew, VectorEnv[Observation, NDArray[np.float32], NDArray[np.generic]]):
    """Many robots, each in its own playpen, stepped by threads.

    Each gives the same results as a single environment, for any number of threads: robot i starts with the
    seed + i. What follows the end of an episode is Gymnasium's autoreset mode:

        NEXT_STEP   the next step starts an episode; it ignores the action, and has reward 0
        SAME_STEP   the step that ends an episode returns the observation of the next one; `infos` has its
                    own last ones as "final_obs" and "final_info"
        DISABLED    `reset(options={"reset_mask": over})` starts the episodes of a mask (num_envs,)

    A copy, also by `pickle`, has the same arguments and random numbers; its episodes begin with `reset`.

    Args:
        num_envs: Number of environments.
        task: Task, or its name.
        threads: Number of threads; by default one per core.
        device: "cpu"; "cuda" for an NVIDIA card, in the plane; or "auto" for a card that they fill.
        autoreset_mode: Autoreset mode, or its value.
        playpen: Playpen instead of the task's, or a list of them: environment i has the i-th, and so on from
            the first one again.
        options: Other options of `KheperaEnvironment`.

    Attributes:
        labels: Labels of an observation's numbers.
        guard: Guard of its methods.
    """

    KEPT = ("spec", "_rngs")

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
        self.closed = True  # nothing to close if an argument is wrong
        num_envs = checked_count(num_envs, "environments")
        most = n_cores() if threads is None else checked_count(threads, "threads")
        self._autoreset_mode = _checked_mode(autoreset_mode)
        playpens = cast(list[Any], list(playpen) if isinstance(playpen, list | tuple) else [playpen])
        if not playpens:
            raise KhepTwinError(
                key="playpen", value=playpen, expected="one playpen, or a list of at least one"
            )
        setups = [TaskSetup(task, playpen=each, **options) for each in playpens[:num_envs]]
        setup = setups[0]
        self._painters = [Renderer(view) for _ in range(num_envs)]
        self.labels = setup.task.labels
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**rendering(render_mode, setup), "autoreset_mode": self._autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(setup)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._batch = TaskBatch(setups, num_envs, min(most, num_envs), device)
        self.guard, self._rows = self._batch.guard, np.arange(num_envs)
        self._over = np.zeros(num_envs, np.bool_)
        self._unbegun = ~self._over
        self._rngs: list[Any] = [None] * num_envs
        self.closed = False

    @one_thread
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in each environment, or in those of the option "reset_mask" (num_envs,).

        Args:
            seed: Seed of the first environment's episodes, or a list with one for each.
            options: The mask, and options in place of the environments' own in these episodes: seed, start,
                lamps, playpen (`ResetOptions`), each for all, or a list with one for each environment.
        """
        self._insist_on_threads()
        if seed is None or isinstance(seed, SupportsIndex):
            seeds = [None if seed is None else operator.index(seed) + index for index in range(self.num_envs)]
        else:
            seeds = list[int | None](seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; expected {self.num_envs}")
        others = dict(options or {})
        chosen = self._chosen(others.pop("reset_mask", None))
        self._begin(chosen, seeds, ResetOptions.of_each(others, self.num_envs))
        return self._seen(), self._infos(chosen, begun=chosen)

    @one_thread
    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Advance all by a control period with these speeds of left and right wheel (num_envs, 2)."""
        self._insist_on_threads()
        batch, mode = self._batch, self._autoreset_mode
        if np.shape(actions) != (self.num_envs, 2):
            raise ValueError(f"actions of shape {np.shape(actions)}; expected ({self.num_envs}, 2)")
        rows, begun = self._rows, self._rows[:0]
        if self._unbegun.any():
            unbegun = np.flatnonzero(self._unbegun).tolist()
            raise ValueError(f"no episode has begun in environments {unbegun}; expected reset() first")
        if self._over.any():
            if mode is AutoresetMode.DISABLED:
                raise ValueError(
                    f"the episodes of environments {np.flatnonzero(self._over).tolist()} are over; "
                    'expected reset(options={"reset_mask": ...}) first'
                )
            if mode is AutoresetMode.NEXT_STEP:
                rows, begun = np.flatnonzero(~self._over), np.flatnonzero(self._over)
                self._begin(begun)
        if len(rows):
            batch.step(rows, np.asarray(actions)[rows, None])
        rewards, terminated, truncated = batch.rewards[:, 0].copy(), batch.ended[:, 0].copy(), batch.over
        self._over = terminated | truncated
        ended = np.flatnonzero(self._over)
        if mode is not AutoresetMode.SAME_STEP or not len(ended):
            infos = self._infos(self._rows, rows, ended, begun)
            return self._seen(), rewards, terminated, truncated, infos
        last = np.full(self.num_envs, None, object)
        last[ended] = list(batch.observations[ended, 0])
        final = {"final_obs": last, "_final_obs": self._over.copy()}
        final |= {"final_info": self._infos(ended, ended, ended), "_final_info": self._over.copy()}
        going_on = np.flatnonzero(~self._over)
        self._begin(ended)
        infos = final | self._infos(self._rows, going_on, begun=ended)
        return self._seen(), rewards, terminated, truncated, infos

    @one_thread
    def render(self) -> tuple[Any, ...]:
        """Return a picture of each environment."""
        if self.render_mode is None:
            return (None,) * self.num_envs
        pairs = zip(self._painters, self._batch.episodes, strict=True)
        return tuple(painter.picture(episode) for painter, episode in pairs)

    @one_thread
    def close_extras(self, **kwargs: Any) -> None:
        """End the threads, and release the resources of rendering."""
        self._batch.close()
        for painter in self._painters:
            painter.close()

    def _insist_on_threads(self) -> None:
        if self.closed:
            raise ValueError("the environments are closed; expected new ones")

    def _begin(
        self,
        rows: NDArray[np.int64],
        seeds: Sequence[int | None] = (),
        options: Sequence[ResetOptions] = (),
    ) -> None:
        """Start some episodes, as `KheperaEnvironment.reset` with each seed and options does."""
        chosen: list[int] = []
        for row in map(int, rows):
            seed = seeds[row] if seeds else None
            if self._rngs[row] is None or seed is not None:
                self._rngs[row] = np_random(seed)[0]
            drawn, given = int(self._rngs[row].integers(2**31)), options[row].seed if options else None
            chosen.append(drawn if given is None else given)
        self._batch.begin(rows, chosen, options)
        self._over[rows] = self._unbegun[rows] = False

    def _seen(self) -> Observation:
        """Return a copy of the observations (num_envs, n)."""
        return self._batch.observations[:, 0].copy()

    def _infos(
        self,
        rows: NDArray[np.int64],
        stepped: Rows = (),
        ended: Rows = (),
        begun: Rows = (),
    ) -> Info:
        """Return the infos of some environments, in Gymnasium's form, with the mask of each array.

        Args:
            rows: Environments, all those of the others among them.
            stepped: Those that were stepped.
            ended: Those whose episode is over.
            begun: Those whose episode has begun.
        """
        batch, infos = self._batch, Info()
        x, y, heading = batch.poses[:, 0].T
        truth = {"x": x, "y": y, "heading": heading, "time": batch.times, "seed": batch.seeds}
        self._put(infos, truth, rows)
        if batch.setup.details and len(stepped):
            if batch.parts:
                parts = self._put({}, {name: part[:, 0] for name, part in batch.parts.items()}, stepped)
                infos |= {"reward_parts": parts, "_reward_parts": self._mask(stepped)}
            self._put(infos, {"contact": batch.touches[:, 0]}, stepped)
        for row in begun:
            self._add_info(infos, of_start(batch, int(row)), int(row))
        for row in ended:
            self._add_info(infos, of_end(batch, 0, int(row)), int(row))
        return infos

    def _put(self, infos: Info, arrays: Mapping[str, NDArray[Any]], rows: Rows) -> Info:
        """Add arrays of some environments, each with its mask; return the infos."""
        mask, are_all = self._mask(rows), len(rows) == self.num_envs
        for name, numbers in arrays.items():
            infos[name] = numbers.copy() if are_all else np.where(mask, numbers, numbers.dtype.type(0))
            infos[f"_{name}"] = mask.copy()
        return infos

    def _mask(self, rows: Rows) -> NDArray[np.bool_]:
        mask = np.zeros(self.num_envs, np.bool_)
        mask[np.asarray(rows, np.int64)] = True
        return mask

    def _chosen(self, mask: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """Return the indices of the environments of a reset mask."""
        if mask is None:
            return self._rows
        given = np.asarray(mask)
        if given.shape != (self.num_envs,) or given.dtype != np.bool_ or not given.any():
            raise ValueError(
                f"reset_mask = {mask!r}; expected an array of {self.num_envs} bool, at least one of them true"
            )
        return np.flatnonzero(given)


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode by its value."""
    values = [each.value for each in AutoresetMode]
    if not isinstance(mode, AutoresetMode) and mode not in values:
        raise KhepTwinError(f"autoreset_mode {mode!r}: unknown; {choices(str(mode), values)}")
    return AutoresetMode(mode)
