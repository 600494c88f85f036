"""Episodes in a plane side by side on a card: an `EpisodeBatch` whose steps are launches of `kernel`.

    setup = EpisodeSetup(Playpen.load("obstacles"), planar=True)
    batch = CardBatch([PreparedEpisode(setup, Policy())] * 4096, Policy())
    for index in range(4096):
        batch.begin(index, seed=index)
    failures = batch.switch_on()
    batch.speeds[:] = 10, 8
    failures |= batch.step(range(4096), setup.steps_per_period)

The CPU prepares an episode, and the card runs it. It is copied back when it is looked at, or when it has
failed: what an episode answers is written once.

Imported only where numba-cuda is installed.
"""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportArgumentType=false, reportOptionalSubscript=false

import operator
from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from khep_twin.episodes.controllers import Driver, Floats, Policy
from khep_twin.episodes.cuda import card, kernel
from khep_twin.episodes.cuda.rows import ConstantRows
from khep_twin.episodes.cuda.words import EpisodeWords, Given, constants_of
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.plane import true_pose
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.one_thread import one_thread
from khep_twin.step import DONE

BLOCK = 64
"""Threads of a block."""

BLOCKS_PER_PROCESSOR = 4
"""Blocks that a multiprocessor runs at once: as many as its registers allow, with 255 for each thread."""

_LAUNCH = Lock()
"""One launch at a time, until its results are there; others of the process prepare theirs meanwhile."""


class PreparedEpisode(Episode):
    """Episode that begins, and is left to a card to run; arguments are those of `Episode`."""

    def __init__(self, setup: EpisodeSetup, driver: Driver | None = None) -> None:
        super().__init__(setup, driver, compiled=True)

    def _advance(self, *arguments: Any) -> int:
        return DONE


class CardBatch(EpisodeBatch):
    """Episodes that a card runs; see `EpisodeBatch`.

    Args:
        episodes: Memory in which the CPU prepares each of them; the same one may serve several.
        driver: Their controller; the caller sets the speeds of a policy.
    """

    INSTEAD = "another CardBatch of new episodes, begun with the same seeds"

    def __init__(self, episodes: Sequence[Episode], driver: Driver) -> None:
        super().__init__(episodes, threads=1)
        self._is_driven = isinstance(driver, Policy)
        self._begun: list[tuple[int, EpisodeOptions]] = [(0, DEFAULT_OPTIONS)] * len(episodes)
        self._fresh: dict[int, NDArray[np.int64]] = {}
        self._constants = ConstantRows(len(episodes))
        self._joint = self._joint._replace(addresses=np.zeros((1, 1), np.int64))  # of the CPU's arrays
        self._table: _Table | None = None
        self._first: tuple[object, ...] | None = None
        self._copied: NDArray[np.int64] | None = None

    @one_thread
    def begin(
        self,
        index: int,
        seed: int,
        options: EpisodeOptions = DEFAULT_OPTIONS,
        episode: Episode | None = None,
    ) -> None:
        """Start an episode, or another `episode` in its place; `switch_on` has to follow."""
        self._own[index] = episode or self._own[index]
        self._begun[index] = seed, options
        given = self._prepared(index)
        if self._table is None:
            self._table = _Table(given, len(self._own))
        if not self._table.layout.fits(given):
            raise PlaypenError(
                f"{self._own[index].playpen.name}: other numbers of obstacles than in the first playpen; "
                "expected the same in all playpens of a batch on a card"
            )
        self._fresh[index] = self._table.layout.take(given)
        # The arrays of robots that are not drawn anew have the same content if they are the same objects.
        arrays = () if options.vary else (*given[1:6], given[-1])
        if arrays and self._first is not None and all(map(operator.is_, arrays, self._first)):
            own = {"genes": given[0].genes, "home": given[0].home, "powers": given[-2]}
            self._constants.take(index, own)
        else:
            self._constants.take(index, constants_of(given))
        self._first = arrays if self._first is None else self._first
        self.steps[index], self._runs_jointly[index] = 0, True

    @one_thread
    def switch_on(self) -> dict[int, DivergedError]:
        """Switch on the robots of the episodes that have begun; return the failures by episode."""
        if not self._fresh:
            return {}
        rows, fresh = np.array(list(self._fresh)), np.stack(list(self._fresh.values()), axis=1)
        self._fresh.clear()
        self._launch(rows, fresh, np.full(len(self._own), -1))
        return self._failures(rows)

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes, each copied from the card when it is looked at."""
        return _Restored(self._restored, len(self._own))

    @property
    def joint_poses(self) -> Floats:
        """Poses by `Episode.poses` (n, n_robots, 3)."""
        joints = self._begun_table.copied(self._begun_table.layout.joints)
        return np.array([[true_pose(joint)] for joint in joints.T.tolist()])

    @property
    def sums(self) -> Floats:
        """Sums of the metrics of the robots (n, n_robots, N_SUMS)."""
        return self._begun_table.copied(self._begun_table.layout.sums).T[:, None]

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects (n, n_objects, 3)."""
        layout = self._begun_table.layout
        return layout.objects(self._begun_table.copied(range(layout.first.things, layout.first.order)))

    @property
    def _begun_table(self) -> "_Table":
        if self._table is None:
            raise ValueError("no episode has begun; expected begin() first")
        return self._table

    def _prepared(self, index: int) -> Given:
        """Begin an episode in the CPU's memory; return its arguments."""
        episode, (seed, options) = self._own[index], self._begun[index]
        episode.begin(seed, options)
        found = episode.joint_arguments
        if found is None:
            raise PlaypenError(
                f"{episode.playpen.name}: has lamps that change; expected steady ones on a card"
            )
        return found[1]

    def _restored(self, index: int) -> Episode:
        """Return an episode, copied from the card unless its robot is still to be switched on."""
        table, given = self._begun_table, self._prepared(index)
        if index not in self._fresh:
            if self._copied is None:
                self._copied = table.words.copy_to_host()
            table.layout.put(self._copied[:, index], given)
        return self._own[index]

    def _finish(self, index: int) -> None:
        self._restored(index)
        super()._finish(index)

    def _take(self, index: int) -> None:
        """Leave an episode that has failed as it is."""

    def _run_jointly(self, rows: NDArray[np.int64]) -> None:
        self._launch(rows, None, self.steps)

    def _launch(
        self, rows: NDArray[np.int64], fresh: NDArray[np.int64] | None, untils: NDArray[np.int64]
    ) -> None:
        """Run some episodes on the card; with `fresh`, their words (n_words, n_rows), switch them on."""
        joint, table = self._joint, self._begun_table
        speeds = joint.speeds if self._is_driven and fresh is None else joint.speeds[:0]
        given = joint._replace(rows=rows, untils=untils, speeds=speeds)
        on_card = type(joint)(*(cuda.to_device(array) for array in given))
        blocks = min(-(-len(rows) // BLOCK), card.n_processors() * BLOCKS_PER_PROCESSOR)
        with _LAUNCH, kernel.compiling():
            kernel.kernel(table.layout.capacity)[blocks, min(BLOCK, len(rows))](
                kernel.Constants(**table.common, **self._constants.on_card()),
                table.like,
                table.layout.first,
                table.words,
                table.words if fresh is None else cuda.to_device(fresh),
                0 if fresh is None else -1,
                on_card,
            )
            for name in ("reasons", "registers", "poses"):
                getattr(on_card, name).copy_to_host(getattr(joint, name))
        self._copied = None


class _Table:
    """Words of n episodes on the card, and what all of them have in common.

    Args:
        given: Arguments of the first episode.
        count: Number of episodes.
    """

    def __init__(self, given: Given, count: int) -> None:
        self.layout = EpisodeWords(given)
        self.words: Any = cuda.device_array((self.layout.n_kept, count), np.int64)
        self.like = kernel.Arena(*(cuda.to_device(np.ascontiguousarray(each)) for each in self.layout.like))
        of = given[0]
        self.common = {
            "kind": of.kind,
            "recurrent": of.recurrent,
            "top_speed": of.top_speed,
            "sizes": cuda.to_device(of.sizes),
            "line": cuda.to_device(of.line),
        }

    def copied(self, words: range) -> Floats:
        """Return some words of all episodes (n_words, n)."""
        return self.words[words.start : words.stop].copy_to_host().view(np.float64)


class _Restored(Sequence[Episode]):
    """Episodes of a batch.

    Args:
        restored: Function that copies an episode from the card.
        count: Number of episodes.
    """

    def __init__(self, restored: Callable[[int], Episode], count: int) -> None:
        self._restored, self._count = restored, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self._restored(each) for each in range(*index.indices(self._count))]
        return self._restored(range(self._count)[index])
