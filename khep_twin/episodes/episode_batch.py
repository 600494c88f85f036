"""Batches of episodes: all run for the same time, in one call of compiled code per thread.

    setup = EpisodeSetup(Playpen.load("obstacles"), planar=True)
    interface = setup.core.interface
    batch = EpisodeBatch([Episode(setup) for _ in range(32)], threads=1)
    for index in range(32):
        batch.begin(index, seed=index)
    batch.speeds[:] = 10, 8
    failures = batch.step(range(32), setup.steps_per_period)
    print(batch.registers[:, 0, slice(*interface.proximity)], batch.poses[:, 0])

Results equal those of single episodes bitwise. A batch has slots, each of which runs one episode at a time.
Episodes whose arrays differ in shape, like those of different playpens, need one call per group. Episodes
in which Python must act (uncompiled ones, lamps that change, turrets, future faults) run one by one.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import RLock
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import NotCopied
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.line import NEVER
from khep_twin.episodes.stepping import Run, SlotArrays, run
from khep_twin.errors import DivergedError
from khep_twin.process.one_thread import one_thread
from khep_twin.renamed import renamed_attribute
from khep_twin.step import Reason, Stop

Slots = Sequence[int] | NDArray[np.int64]
"""Indices of slots (n_slots,)."""


class EpisodeBatch(NotCopied):
    """Episodes without controllers, of setups with the same number of robots.

    Args:
        episodes: Episodes, all in MuJoCo or all in the plane.
        threads: Number of threads.

    Attributes:
        speeds: Speeds of the wheels, set at the start of each step [register], and values of commands to
            turrets (n, n_robots, 2 + n_commands).
        registers: Registers of the robots, and readings of turrets (n, n_robots, n_registers or more).
        poses: True x, y [m] and heading [rad] of the robots (n, n_robots, 3).
        steps: Number of physics steps of each episode (n,).
        last_step: Step at which episodes at a line stop.
        guard: Lock of its methods.
    """

    COPY_ADVICE = "another EpisodeBatch of new episodes, started with the same seeds"

    def __init__(self, episodes: Sequence[Episode], threads: int) -> None:
        self.guard = RLock()
        self._episodes = list(episodes)
        self._arrays = arrays = SlotArrays.of(len(episodes), *episodes[0].shape)
        n_slots = len(episodes)
        self.speeds, self.registers, self.poses = arrays.speeds, arrays.registers, arrays.poses
        self.steps: NDArray[np.int64] = arrays.end_steps
        self.last_step = NEVER
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None  # beside the caller's
        self._run: Run = run
        self._arguments: list[tuple[Any, ...]] = [()] * n_slots  # keeps the arrays alive
        self._group_numbers: dict[tuple[object, ...], int] = {}  # by line and shapes of their arrays
        self._slot_groups = np.zeros(n_slots, np.int64)
        self._runs_compiled = np.zeros(n_slots, np.bool_)
        self._is_at_line = np.zeros(n_slots, np.bool_)

    @one_thread
    def begin(
        self, index: int, seed: int, options: EpisodeOptions = DEFAULT_OPTIONS, episode: Episode | None = None
    ) -> None:
        """Start an episode in a slot, or replace it by `episode`; errors are those of `Episode.begin`."""
        episode = self._episodes[index] = episode or self._episodes[index]
        self._runs_compiled[index], self._arrays.end_steps[index] = False, 0
        episode.begin(seed, options)
        self._is_at_line[index] = episode.is_at_line
        if episode.is_at_line:
            episode.next_reading(self.last_step)
            self.steps[index] = episode.steps
        self._update_slot(index)

    @one_thread
    def step(self, slots: Slots, steps: int) -> dict[int, DivergedError]:
        """Set the speeds of some slots and run their episodes for some steps; return the failures by slot.

        Episodes at a line run until they await speeds again.
        """
        arrays, chosen_slots = self._arrays, np.asarray(slots, np.int64)
        line_slots: list[int] = chosen_slots[self._is_at_line[chosen_slots]].tolist()
        arrays.end_steps[chosen_slots] += steps
        arrays.end_steps[line_slots] = self.last_step
        runs_compiled = self._runs_compiled[chosen_slots]
        if runs_compiled.all():
            single_slots: list[int] = []
        else:
            single_slots, chosen_slots = chosen_slots[~runs_compiled].tolist(), chosen_slots[runs_compiled]
        failures: dict[int, DivergedError] = {}
        if len(chosen_slots):
            self._run_slots(chosen_slots)
            failures = self._failures(chosen_slots)
        for index in single_slots:
            self._attempt(index, lambda index: self._step_alone(index, steps), failures)
        for index in line_slots:
            self.steps[index] = self._episodes[index].steps
        return failures

    def switch_on(self) -> dict[int, DivergedError]:
        """Switch on robots that `begin` has left off; return the failures by slot."""
        return {}

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes of the slots."""
        return self._episodes

    @property
    def boards(self) -> NDArray[np.int64]:
        """Registers of the robots (n, n_robots, n_registers), at a line before a policy has read them."""
        return np.array([episode.boards for episode in self._episodes])

    def touches(self, slots: Slots) -> NDArray[np.bool_]:
        """Return whether the robots of some slots touch anything but the floor (n_slots, n_robots)."""
        robots, episodes = range(self.speeds.shape[1]), [self._episodes[slot] for slot in slots]
        return np.array([[episode.touches(robot) for robot in robots] for episode in episodes], np.bool_)

    def slot_episode(self, index: int) -> Episode:
        """Return the episode of a slot, also if its start has failed."""
        return self._episodes[index]

    joint_poses = renamed_attribute("joint_poses", "episode_poses")

    @property
    def episode_poses(self) -> NDArray[np.float64]:
        """Poses as by `Episode.poses` (n, n_robots, 3); headings may differ from `poses` in the last bit."""
        return np.array([episode.poses for episode in self._episodes])

    @property
    def sums(self) -> NDArray[np.float64]:
        """Sums of the metrics of the robots (n, n_robots, N_SUMS)."""
        return np.array([episode.sums for episode in self._episodes])

    @property
    def objects(self) -> NDArray[np.float64]:
        """Positions x, y [m] and headings [rad] of the movable objects (n, n_objects, 3)."""
        return np.array([episode.objects for episode in self._episodes])

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _failures(self, slots: NDArray[np.int64]) -> dict[int, DivergedError]:
        """Handle early returns of the stepping core; return the failures by slot."""
        failures: dict[int, DivergedError] = {}
        for index in slots[self._arrays.reasons[slots] != Reason.DONE].tolist():
            self._attempt(index, self._finish, failures)
        return failures

    def _attempt(self, index: int, action: Callable[[int], None], failures: dict[int, DivergedError]) -> None:
        """Call a function for a slot, record its failure, and update the slot."""
        episode = self._episodes[index]
        try:
            action(index)
        except DivergedError as error:
            failures[index] = error
            self._arrays.end_steps[index] = episode.steps
        self._update_slot(index)

    def _finish(self, index: int) -> None:
        """Handle an early return of the stepping core, and run the remaining steps."""
        reason, end_step = int(self._arrays.reasons[index]), int(self._arrays.end_steps[index])
        if reason == Reason.NO_SPEED:
            self._drive(index)  # raises an error that states the speed
        self._episodes[index].finish_steps(reason, end_step)

    def _step_alone(self, index: int, steps: int) -> None:
        self._drive(index)
        if self._is_at_line[index]:
            self._episodes[index].next_reading(self.last_step)
        else:
            self._episodes[index].step(steps)

    def _drive(self, index: int) -> None:
        for robot, (left, right, *values) in enumerate(self.speeds[index].tolist()):
            self._episodes[index].drive(left, right, robot, values)

    def _update_slot(self, index: int) -> None:
        """Copy the results of an episode, and register its arrays for compiled code."""
        episode = self._episodes[index]
        episode.observe(self._arrays, index)
        call = episode.compiled_call
        self._runs_compiled[index] = False
        if call is None:
            return
        self._run, arguments = call
        arrays = list(_iterate_nested_arrays(arguments))
        if not self._group_numbers:
            addresses = np.zeros((len(self._episodes), len(arrays)), np.int64)
            self._arrays = self._arrays._replace(addresses=addresses)
        group_key = (episode.is_at_line, *(array.shape for array in arrays))
        self._slot_groups[index] = self._group_numbers.setdefault(group_key, len(self._group_numbers))
        self._arguments[index] = tuple(arguments)  # numba passes a plain tuple faster
        self._arrays.addresses[index] = [array.ctypes.data for array in arrays]
        self._runs_compiled[index] = True

    def _run_slots(self, slots: NDArray[np.int64]) -> None:
        if len(self._group_numbers) > 1:
            slots = slots[np.argsort(self._slot_groups[slots], kind="stable")]
        if self._pool is None:
            self._run_groups(slots)
            return
        parts = np.array_split(slots, min(self._threads, len(slots)))
        futures = [self._pool.submit(self._run_groups, part) for part in parts[1:]]
        self._run_groups(parts[0])
        for future in futures:
            future.result()

    def _run_groups(self, slots: NDArray[np.int64]) -> None:
        """Run slots sorted by group, one call of compiled code per group (equal line and array shapes)."""
        groups = [slots]
        if len(self._group_numbers) > 1:
            groups = np.split(slots, np.flatnonzero(np.diff(self._slot_groups[slots])) + 1)
        for group in groups:
            self._run(
                self._arguments[int(group[0])], 0, int(Stop.AWAITED), self._arrays._replace(indices=group)
            )


def _iterate_nested_arrays(values: tuple[Any, ...]) -> Iterator[NDArray[Any]]:
    """Yield the arrays in nested tuples, in order."""
    for value in values:
        if isinstance(value, np.ndarray):
            yield cast("NDArray[Any]", value)
        elif isinstance(value, tuple):
            yield from _iterate_nested_arrays(cast("tuple[Any, ...]", value))
