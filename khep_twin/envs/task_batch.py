"""Episodes of a task side by side, with the numbers of all robots in arrays.

    batch = TaskBatch(TaskSetup("ObstacleAvoidance", planar=True), 32)
    rows = np.arange(32)
    batch.begin(rows, seeds=range(32))
    batch.step(rows, np.ones((32, 1, 2)))
    print(batch.observations, batch.rewards)

Compiled code steps all episodes in one call for each thread; speeds, rewards and observations of all robots
are computed as arrays. An episode depends on its seed and its actions alone, not on the others.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.clock import to_ns
from khep_twin.copies import NotCopied
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_setup import EpisodeBeginning, TaskSetup
from khep_twin.envs.tasks import Observation, State
from khep_twin.episodes.controllers import Policy
from khep_twin.episodes.device import Device
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.one_thread import one_thread

_ENCODERS = [LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]


class TaskBatch(NotCopied):
    """Episodes of a task; each one begins with `begin`.

    Args:
        setup: Prepared task, or several that differ in their playpens: episode i has the i-th of them, and
            so on from the first one again.
        count: Number of episodes.
        threads: Number of threads.
        device: "cpu"; "cuda" for an NVIDIA card, in the plane; or "auto" for a card that the episodes fill.

    Attributes:
        setup: Prepared task, the first.
        observations: Observations of the robots (n, n_robots, n_numbers).
        rewards: Rewards of the last control period, 0 to 1 (n, n_robots).
        ended: Whether the charge has run out (n, n_robots).
        periods: Control periods since the start (n,); those of a whole episode before the first.
        seeds: Seed of each episode (n,).
        beginnings: Beginning of each episode (n,); None before the first.
        parts: Parts of the rewards by name, if the setup has `details`, as the next two (n, n_robots).
        returns: Sums of the rewards since the start (n, n_robots).
        touches: Whether each robot touches something but the floor (n, n_robots).
        poses: True x, y [m] and heading [rad] of the robots, live (n, n_robots, 3).
        guard: Guard of its methods, its episodes'.
    """

    INSTEAD = "another TaskBatch of the same setup, begun with the same seeds"

    def __init__(
        self,
        setup: TaskSetup | Sequence[TaskSetup],
        count: int = 1,
        threads: int = 1,
        device: Device = "cpu",
    ) -> None:
        setups = [setup] if isinstance(setup, TaskSetup) else setup
        self.setup = setup = setups[0]
        self._own = [setups[index % len(setups)] for index in range(count)]
        self._used = list(self._own)
        self._idle = defaultdict[TaskSetup, list[Episode]](list)
        chosen = [each.device(device, count, setup) for each in setups]
        self._device: Device = "cpu" if "cpu" in chosen else "cuda"
        self._batch = self._new_batch(threads)
        self.guard, self.poses = self._batch.guard, self._batch.poses
        shape = count, len(setup.playpen.robots)
        self.observations: Observation = np.zeros((*shape, len(setup.task.labels)), np.float32)
        self.rewards, self.ended = np.zeros(shape), np.zeros(shape, np.bool_)
        self.periods, self.seeds = np.full(count, setup.n_steps), np.zeros(count, np.int64)
        self._pulses = np.zeros((*shape, 2), np.int64)
        self._charge_ns = to_ns(setup.task.charge_s)
        self._charges_ns = np.zeros(shape, np.int64)
        self._goals, self._ends = np.zeros((count, 2)), np.zeros((2, *shape))
        for row, each in enumerate(self._own):
            self._know(row, each)
        self.beginnings: list[EpisodeBeginning | None] = [None] * count
        self.returns, self.touches = np.zeros(shape), np.zeros(shape, np.bool_)
        self.parts: dict[str, NDArray[np.float64]] = {}

    @one_thread
    def begin(
        self, rows: NDArray[np.int64], seeds: Iterable[int], options: Sequence[ResetOptions] = ()
    ) -> None:
        """Start some episodes.

        Args:
            rows: Indices of the episodes (n_rows,).
            seeds: Seed of each.
            options: Options of each episode in place of the setup's own (n,); none, if empty.

        Raises:
            PlaypenError: There is no room for the robots.
            ValueError: A seed is negative or too large.
        """
        given = options or [ResetOptions()] * len(self._own)
        numbers: list[int] = rows.tolist()
        pairs = list(zip(numbers, seeds, strict=True))
        # All of them first, so that a mistake changes nothing.
        beginnings = [self._own[row].beginning(seed, given[row]) for row, seed in pairs]
        for begun in beginnings if self._device == "cuda" else ():
            begun.setup.device("cuda", 1, self.setup, begun.options.lamps)
        for (row, seed), begun in zip(pairs, beginnings, strict=True):
            self._batch.begin(row, seed, begun.options, self._exchanged(row, begun.setup))
            self.seeds[row], self.beginnings[row] = seed, begun
        for error in self._batch.switch_on().values():
            raise error
        self.periods[rows], self._charges_ns[rows], self.returns[rows] = 0, self._charge_ns, 0.0
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
        if self.setup.details:
            self._note_details(rows, state)
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

    def drawn(self, row: int) -> dict[str, Any]:
        """Return what the randomization has drawn for an episode, by name."""
        begun = self.beginnings[row]
        return begun.drawn if begun else {}

    def close(self) -> None:
        """End the threads."""
        self._batch.close()

    def _new_batch(self, threads: int) -> EpisodeBatch:
        if self._device == "cpu":
            return EpisodeBatch([each.episode() for each in self._own], threads)
        from khep_twin.episodes.cuda.card_batch import CardBatch

        shared = {each: each.episode(self._device) for each in dict.fromkeys(self._own)}
        return CardBatch([shared[each] for each in self._own], Policy())

    def _exchanged(self, row: int, setup: TaskSetup) -> Episode | None:
        """Return an episode of a setup if another one is in use, which is kept for later."""
        used = self._used[row]
        if used is setup:
            return None
        idle = self._idle[setup]
        if self._device == "cpu":
            another = idle.pop() if idle else setup.episode()
            self._idle[used].append(self._batch.episodes[row])
        else:
            another = idle[0] if idle else setup.episode(self._device)  # for all episodes of the setup
            idle[:] = [another]
        self._used[row] = setup
        self._know(row, setup)
        return another

    def _know(self, row: int, setup: TaskSetup) -> None:
        """Take the numbers of a setup that an episode's states depend on."""
        self._goals[row] = setup.goal
        self._ends[0, row], self._ends[1, row] = setup.dark, setup.floor

    def _note_details(self, rows: NDArray[np.int64], state: State) -> None:
        """Add the rewards to the returns, and take their parts and the contacts."""
        self.returns[rows] += self.rewards[rows]
        for name, part in self.setup.task.reward_parts(state).items():
            self.parts.setdefault(name, np.zeros(self.rewards.shape))[rows] = part.reshape(len(rows), -1)
        self.touches[rows] = self._batch.touches(rows)

    def _state(self, rows: NDArray[np.int64]) -> State:
        """Return the state of all robots of some episodes; count what their wheels and charges have done."""
        setup = self.setup
        registers = self._batch.registers[rows]
        counted = registers[..., _ENCODERS]
        speeds = (counted - self._pulses[rows]) / (setup.period_ns // units.TICK_NS)
        self._pulses[rows] = counted
        at_goal, charge = np.zeros(counted.shape[:2], np.bool_), np.ones(counted.shape[:2])
        if setup.task.goal:
            dx, dy = np.moveaxis(self.poses[rows, :, :2] - self._goals[rows, None], 2, 0)
            at_goal = dx * dx + dy * dy <= units.metres(setup.task.reach_mm) ** 2
        if self._charge_ns:
            left_ns = np.maximum(self._charges_ns[rows] - setup.period_ns, 0)
            begun = self.periods[rows][:, None] == 0
            charges_ns = np.where(at_goal | begun, self._charge_ns, left_ns)
            self._charges_ns[rows], charge = charges_ns, charges_ns / self._charge_ns
        left, right = speeds.reshape(-1, 2).T
        boards = registers.reshape(-1, registers.shape[2]).T
        ends = self._ends if len(rows) == len(self._own) else self._ends[:, rows]
        dark, floor = ends.reshape(2, -1)
        return State(boards, left, right, dark, floor, at_goal.reshape(-1), charge.reshape(-1))

    def _observe(self, rows: NDArray[np.int64], state: State) -> None:
        """Set the observations of some episodes; arrays of earlier ones stay as they are."""
        seen = self.setup.task.observe(state, self.setup.normalize)
        if len(rows) < len(self.observations):
            self.observations = self.observations.copy()
            self.observations[rows] = seen.reshape(-1, *self.observations.shape[1:])
        else:
            self.observations = seen.reshape(self.observations.shape)
