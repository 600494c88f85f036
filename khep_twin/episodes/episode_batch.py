"""Episodes side by side: all of them run for the same time in one call of compiled code for each thread.

    setup = EpisodeSetup(Playpen.load("obstacles"), planar=True)
    batch = EpisodeBatch([Episode(setup) for _ in range(32)], threads=1)
    for index in range(32):
        batch.begin(index, seed=index)
    batch.speeds[:] = 10, 8
    failures = batch.step(range(32), setup.steps_per_period)
    print(batch.registers[:, 0, PROXIMITY], batch.poses[:, 0])

Results are those of the single episodes, bit for bit. Episodes whose arrays differ in shape, such as those of
different playpens, are run by one call for each group. Episodes that compiled code cannot run alone (plain
ones, lamps that change, turrets, faults to come) are run one by one from Python.
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
from khep_twin.episodes.stepping import AWAITED, JointRun, Run, run
from khep_twin.errors import DivergedError
from khep_twin.one_thread import one_thread
from khep_twin.step import DONE, NO_SPEED

Rows = Sequence[int] | NDArray[np.int64]
"""Indices of episodes (n_rows,)."""


class EpisodeBatch(NotCopied):
    """Episodes without controllers, of setups that have their number of robots in common.

    Args:
        episodes: Episodes, all in MuJoCo or all in the plane.
        threads: Number of threads.

    Attributes:
        speeds: Speeds of the wheels, which each step sets first (n, n_robots, 2) [pulses/10 ms].
        registers: States of the boards (n, n_robots, N_REGISTERS).
        poses: True x, y [m] and heading [rad] of the robots (n, n_robots, 3).
        steps: Physics steps that each has done (n,).
        last_step: Step at which episodes at a line end.
        guard: Guard of its methods.
    """

    INSTEAD = "another EpisodeBatch of new episodes, begun with the same seeds"

    def __init__(self, episodes: Sequence[Episode], threads: int) -> None:
        self.guard, self._own = RLock(), list(episodes)
        count, n_robots = len(episodes), len(episodes[0].boards)
        self._joint = JointRun.of(count, n_robots, 0)
        self.speeds, self.registers, self.poses = self._joint.speeds, self._joint.registers, self._joint.poses
        self.steps: NDArray[np.int64] = self._joint.untils
        self.last_step = NEVER
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None  # beside the caller's
        self._run: Run = run
        self._given: list[tuple[Any, ...]] = [()] * count  # keeps the arrays
        self._groups: dict[tuple[object, ...], int] = {}  # by line and shapes of their arrays
        self._group_of = np.zeros(count, np.int64)
        self._runs_jointly, self._at_line = np.zeros(count, np.bool_), np.zeros(count, np.bool_)

    @one_thread
    def begin(
        self,
        index: int,
        seed: int,
        options: EpisodeOptions = DEFAULT_OPTIONS,
        episode: Episode | None = None,
    ) -> None:
        """Start an episode, or another `episode` in its place; errors are those of `Episode.begin`."""
        episode = self._own[index] = episode or self._own[index]
        self._runs_jointly[index], self._joint.untils[index] = False, 0
        episode.begin(seed, options)
        self._at_line[index] = episode.is_at_line
        if episode.is_at_line:
            episode.next_reading(self.last_step)
            self.steps[index] = episode.steps
        self._take(index)

    @one_thread
    def step(self, rows: Rows, steps: int) -> dict[int, DivergedError]:
        """Set the speeds of some episodes and run them for some steps; return the failures by episode.

        Episodes at a line run until their speeds are awaited again.
        """
        joint, chosen = self._joint, np.asarray(rows, np.int64)
        at_line: list[int] = chosen[self._at_line[chosen]].tolist()
        joint.untils[chosen] += steps
        joint.untils[at_line] = self.last_step
        together = self._runs_jointly[chosen]
        if together.all():
            apart: list[int] = []
        else:
            apart, chosen = chosen[~together].tolist(), chosen[together]
        failures: dict[int, DivergedError] = {}
        if len(chosen):
            self._run_jointly(chosen)
            failures = self._failures(chosen)
        for index in apart:
            self._attempt(index, lambda index: self._step_alone(index, steps), failures)
        for index in at_line:
            self.steps[index] = self._own[index].steps
        return failures

    def switch_on(self) -> dict[int, DivergedError]:
        """Switch on the robots of episodes that have begun, where `begin` has not; return the failures."""
        return {}

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes."""
        return self._own

    @property
    def boards(self) -> NDArray[np.int64]:
        """States of the boards (n, n_robots, N_REGISTERS), at a line also what no policy has read yet."""
        return np.array([episode.boards for episode in self._own])

    def touches(self, rows: Rows) -> NDArray[np.bool_]:
        """Return whether the robots of some episodes touch anything but the floor (n_rows, n_robots)."""
        robots = range(self.speeds.shape[1])
        return np.array([[self._own[row].touches(robot) for robot in robots] for row in rows], np.bool_)

    def memory(self, index: int) -> Episode:
        """Return the memory in which an episode was begun last."""
        return self._own[index]

    @property
    def joint_poses(self) -> NDArray[np.float64]:
        """Poses as of `Episode.poses` (n, n_robots, 3); headings may differ from `poses` in the last bit."""
        return np.array([episode.poses for episode in self._own])

    @property
    def sums(self) -> NDArray[np.float64]:
        """Sums of the metrics of the robots (n, n_robots, N_SUMS)."""
        return np.array([episode.sums for episode in self._own])

    @property
    def objects(self) -> NDArray[np.float64]:
        """Positions x, y [m] and headings [rad] of the movable objects (n, n_objects, 3)."""
        return np.array([episode.objects for episode in self._own])

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _failures(self, rows: NDArray[np.int64]) -> dict[int, DivergedError]:
        """Act for early returns from a joint run; return the failures by episode."""
        failures: dict[int, DivergedError] = {}
        for index in rows[self._joint.reasons[rows] != DONE].tolist():
            self._attempt(index, self._finish, failures)
        return failures

    def _attempt(self, index: int, action: Callable[[int], None], failures: dict[int, DivergedError]) -> None:
        """Do something with an episode, note its failure, and look at it again."""
        episode = self._own[index]
        try:
            action(index)
        except DivergedError as error:
            failures[index] = error
            self._joint.untils[index] = episode.steps
        self._take(index)

    def _finish(self, index: int) -> None:
        """Act for an early return from a joint run, and run the rest."""
        reason, until = int(self._joint.reasons[index]), int(self._joint.untils[index])
        if reason == NO_SPEED:
            self._drive(index)  # which tells the speed
        self._own[index].finish_steps(reason, until)

    def _step_alone(self, index: int, steps: int) -> None:
        self._drive(index)
        if self._at_line[index]:
            self._own[index].next_reading(self.last_step)
        else:
            self._own[index].step(steps)

    def _drive(self, index: int) -> None:
        for robot, (left, right) in enumerate(self.speeds[index].tolist()):
            self._own[index].drive(left, right, robot)

    def _take(self, index: int) -> None:
        """Take the arrays of an episode, and what it shows."""
        episode = self._own[index]
        episode.observe(self._joint, index)
        found = episode.joint_arguments
        self._runs_jointly[index] = False
        if found is None:
            return
        self._run, given = found
        arrays = list(_arrays(given))
        if not self._groups:
            addresses = np.zeros((len(self._own), len(arrays)), np.int64)
            self._joint = self._joint._replace(addresses=addresses)
        kind = (episode.is_at_line, *(each.shape for each in arrays))
        self._group_of[index] = self._groups.setdefault(kind, len(self._groups))
        self._given[index] = given
        self._joint.addresses[index] = [each.ctypes.data for each in arrays]
        self._runs_jointly[index] = True

    def _run_jointly(self, rows: NDArray[np.int64]) -> None:
        if len(self._groups) > 1:
            rows = rows[np.argsort(self._group_of[rows], kind="stable")]
        if self._pool is None:
            self._run_share(rows)
            return
        shares = np.array_split(rows, min(self._threads, len(rows)))
        others = [self._pool.submit(self._run_share, share) for share in shares[1:]]
        self._run_share(shares[0])
        for other in others:
            other.result()

    def _run_share(self, rows: NDArray[np.int64]) -> None:
        """Run episodes that are sorted by their groups."""
        groups = [rows]
        if len(self._groups) > 1:
            groups = np.split(rows, np.flatnonzero(np.diff(self._group_of[rows])) + 1)
        for group in groups:
            self._run(self._given[int(group[0])], 0, AWAITED, self._joint._replace(rows=group))


def _arrays(values: tuple[Any, ...]) -> Iterator[NDArray[Any]]:
    """Yield the arrays in nested tuples, in order."""
    for value in values:
        if isinstance(value, np.ndarray):
            yield cast("NDArray[Any]", value)
        elif isinstance(value, tuple):
            yield from _arrays(cast("tuple[Any, ...]", value))
