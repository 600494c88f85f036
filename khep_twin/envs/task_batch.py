"""A batch of episodes of a task, with the data of all robots in arrays.

    batch = TaskBatch(TaskSetup("ObstacleAvoidance", planar=True), 32)
    rows = np.arange(32)
    batch.begin(rows, seeds=range(32))
    batch.step(rows, np.ones((32, 1, 2)))
    print(batch.observations, batch.rewards)

JIT-compiled code steps all episodes in one call per thread; speeds, rewards and observations of all robots
are computed as arrays. An episode depends only on its seed and its actions, not on the others.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import to_ns
from khep_twin.copies import NotCopied
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_setup import EpisodeBeginning, TaskSetup
from khep_twin.envs.tasks import Observation, State
from khep_twin.episodes.controllers import Policy
from khep_twin.episodes.device import Device
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.process.one_thread import one_thread


class TaskBatch(NotCopied):
    """Batch of episodes of a task; `begin` starts each of them.

    Args:
        setup: Prepared task, or several that differ in their playpens, which the episodes use in turn.
        count: Number of episodes.
        threads: Number of threads.
        device: "cpu"; "cuda" for an NVIDIA GPU, with `planar`; or "auto" for a GPU if they fill it.

    Attributes:
        setup: First prepared task.
        observations: Observations of the robots (n, n_robots, n_numbers).
        rewards: Rewards of the last control period, 0 to 1 (n, n_robots).
        terminated: Whether the charge has run out (n, n_robots).
        periods: Control periods since the start (n,); those of a complete episode before the first.
        seeds: Seed of each episode (n,).
        beginnings: Beginning of each episode (n,); None before the first.
        parts: Parts of the rewards by name (n, n_robots); this and the next two only with `details`.
        returns: Sums of the rewards since the start (n, n_robots).
        contacts: Whether each robot touches anything except the floor (n, n_robots).
        poses: True x, y [m] and heading [rad] of the robots, live (n, n_robots, 3).
        guard: Lock by which its methods refuse a second thread, the episodes'.
    """

    COPY_ADVICE = "another TaskBatch of the same setup, started with the same seeds"

    def __init__(
        self, setup: TaskSetup | Sequence[TaskSetup], count: int = 1, threads: int = 1, device: Device = "cpu"
    ) -> None:
        setups = [setup] if isinstance(setup, TaskSetup) else setup
        self.setup = setup = setups[0]
        self._setups = [setups[index % len(setups)] for index in range(count)]
        self._active_setups = list(self._setups)
        self._idle_episodes = defaultdict[TaskSetup, list[Episode]](list)
        devices = [item.device(device, count, setup) for item in setups]
        self._device: Device = "cpu" if "cpu" in devices else "cuda"
        self._batch = self._make_batch(threads)
        self.guard = self._batch.guard
        self.poses = self._batch.poses
        shape = count, len(setup.playpen.robots)
        self.observations: Observation = np.zeros((*shape, len(setup.task.labels)), np.float32)
        self.rewards = np.zeros(shape)
        self.terminated = np.zeros(shape, np.bool_)
        self.periods = np.full(count, setup.n_steps)
        self.seeds = np.zeros(count, np.int64)
        self._positions = list(setup.interface.positions)
        self._pulses = np.zeros((*shape, 2), np.int64)
        self._full_charge_ns = to_ns(setup.task.charge_s)
        self._charges_ns = np.zeros(shape, np.int64)
        self._goals = np.zeros((count, 2))
        self._ambient_limits = np.zeros((2, *shape))
        for row, row_setup in enumerate(self._setups):
            self._set_constants(row, row_setup)
        self.beginnings: list[EpisodeBeginning | None] = [None] * count
        self.returns = np.zeros(shape)
        self.contacts = np.zeros(shape, np.bool_)
        self.parts: dict[str, NDArray[np.float64]] = {}

    @one_thread
    def begin(
        self, rows: NDArray[np.int64], seeds: Iterable[int], options: Sequence[ResetOptions] = ()
    ) -> None:
        """Start some episodes.

        Args:
            rows: Indices of the episodes (n_rows,).
            seeds: Seed of each.
            options: Options that replace the setup's, of each episode (n,); empty for none.

        Raises:
            PlaypenError: There is no room for the robots.
            ValueError: A seed is negative or too large.
        """
        row_options = options or [ResetOptions()] * len(self._setups)
        indices: list[int] = rows.tolist()
        pairs = list(zip(indices, seeds, strict=True))
        # Prepare all of them first, so that an error changes nothing.
        beginnings = [self._setups[row].beginning(seed, row_options[row]) for row, seed in pairs]
        for beginning in beginnings if self._device == "cuda" else ():
            beginning.setup.device("cuda", 1, self.setup, beginning.options.lamps)
        for (row, seed), beginning in zip(pairs, beginnings, strict=True):
            self._batch.begin(row, seed, beginning.options, self._replacement_episode(row, beginning.setup))
            self.seeds[row], self.beginnings[row] = seed, beginning
        for error in self._batch.switch_on().values():
            raise error
        self.periods[rows], self._charges_ns[rows], self.returns[rows] = 0, self._full_charge_ns, 0.0
        self._pulses[rows] = self._batch.registers[rows][..., self._positions]
        self.rewards[rows], self.terminated[rows] = 0.0, False
        self._observe(rows, self._state(rows))

    @one_thread
    def step(self, rows: NDArray[np.int64], actions: object) -> None:
        """Advance some episodes by a control period.

        Args:
            rows: Indices of the episodes (n_rows,).
            actions: Speeds of each robot's wheels (n_rows, n_robots, 2), as fractions of the top speed, or
                in the unit of the robot's register if not normalized; clipped, and rounded.

        Raises:
            DivergedError: A speed is NaN, or the physics has diverged.
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
        if self.setup.details:
            self._record_details(rows, state)
        if self._full_charge_ns:
            self.terminated[rows] = (state.charge <= 0).reshape(shape)
        self._observe(rows, state)

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes, for the state of the scene and the boards."""
        return self._batch.episodes

    @property
    def over(self) -> NDArray[np.bool_]:
        """True for each episode at its time limit, or not yet started (n,)."""
        return self.periods >= self.setup.n_steps

    @property
    def times(self) -> NDArray[np.float64]:
        """Simulated time of each episode (n,) [s]."""
        return self.periods * self.setup.period_ns / 1e9

    def drawn(self, row: int) -> dict[str, Any]:
        """Return the values drawn by the randomization for an episode, by name."""
        beginning = self.beginnings[row]
        return beginning.drawn if beginning else {}

    def close(self) -> None:
        """Stop the threads."""
        self._batch.close()

    def _make_batch(self, threads: int) -> EpisodeBatch:
        if self._device == "cpu":
            return EpisodeBatch([setup.episode() for setup in self._setups], threads)
        from khep_twin.episodes.cuda.card_batch import CardBatch

        templates = {setup: setup.episode(self._device) for setup in dict.fromkeys(self._setups)}
        return CardBatch([templates[setup] for setup in self._setups], Policy())

    def _replacement_episode(self, row: int, setup: TaskSetup) -> Episode | None:
        """Return an episode of a setup unless the row already uses it; the replaced one is kept for reuse."""
        active_setup = self._active_setups[row]
        if active_setup is setup:
            return None
        idle = self._idle_episodes[setup]
        if self._device == "cpu":
            episode = idle.pop() if idle else setup.episode()
            self._idle_episodes[active_setup].append(self._batch.episodes[row])
        else:
            episode = idle[0] if idle else setup.episode(self._device)  # shared by all episodes of the setup
            idle[:] = [episode]
        self._active_setups[row] = setup
        self._set_constants(row, setup)
        return episode

    def _set_constants(self, row: int, setup: TaskSetup) -> None:
        """Store the constants of a setup on which an episode's states depend."""
        self._goals[row] = setup.goal
        self._ambient_limits[0, row], self._ambient_limits[1, row] = setup.dark, setup.floor

    def _record_details(self, rows: NDArray[np.int64], state: State) -> None:
        """Add the rewards to the returns, and store their parts and the contacts."""
        self.returns[rows] += self.rewards[rows]
        for name, part in self.setup.task.reward_parts(state).items():
            self.parts.setdefault(name, np.zeros(self.rewards.shape))[rows] = part.reshape(len(rows), -1)
        self.contacts[rows] = self._batch.touches(rows)

    def _state(self, rows: NDArray[np.int64]) -> State:
        """Return the state of all robots of some episodes; update their encoders and charges."""
        setup = self.setup
        registers = self._batch.registers[rows]
        pulses = registers[..., self._positions]
        speeds = (pulses - self._pulses[rows]) / (setup.period_ns // units.TICK_NS)
        speeds *= setup.interface.speed_per_pulse
        self._pulses[rows] = pulses
        at_goal, charge = np.zeros(pulses.shape[:2], np.bool_), np.ones(pulses.shape[:2])
        if setup.task.goal:
            dx, dy = np.moveaxis(self.poses[rows, :, :2] - self._goals[rows, None], 2, 0)
            at_goal = dx * dx + dy * dy <= units.metres(setup.task.reach_mm) ** 2
        if self._full_charge_ns:
            remaining_ns = np.maximum(self._charges_ns[rows] - setup.period_ns, 0)
            is_first = self.periods[rows][:, None] == 0
            charges_ns = np.where(at_goal | is_first, self._full_charge_ns, remaining_ns)
            self._charges_ns[rows], charge = charges_ns, charges_ns / self._full_charge_ns
        left, right = speeds.reshape(-1, 2).T
        boards = registers.reshape(-1, registers.shape[2]).T
        limits = self._ambient_limits if len(rows) == len(self._setups) else self._ambient_limits[:, rows]
        dark, floor = limits.reshape(2, -1)
        at_goal, charge = at_goal.reshape(-1), charge.reshape(-1)
        return State(boards, left, right, dark, floor, at_goal, charge, setup.task.model)

    def _observe(self, rows: NDArray[np.int64], state: State) -> None:
        """Set the observations of some episodes; arrays of earlier observations do not change."""
        observations = self.setup.task.observe(state, self.setup.normalize)
        if len(rows) < len(self.observations):
            self.observations = self.observations.copy()
            self.observations[rows] = observations.reshape(-1, *self.observations.shape[1:])
        else:
            self.observations = observations.reshape(self.observations.shape)
