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
# pyright: reportOptionalMemberAccess=false

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
from khep_twin.episodes.cuda.words import EpisodeWords, Words, constants_of
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch, Rows
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.plane import PUSHED, PUSHED_ASIDE, true_pose
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.one_thread import one_thread
from khep_twin.step import DONE

BLOCK = 64
"""Threads of a block."""

_LAUNCH = Lock()
"""One launch at a time, until its results are there; other threads prepare episodes meanwhile."""


class PreparedEpisode(Episode):
    """Episode that begins, and is left to a card to run; arguments are those of `Episode`."""

    def __init__(self, setup: EpisodeSetup, driver: Driver | None = None) -> None:
        super().__init__(setup, driver, compiled=True)

    def _advance(self, *arguments: Any) -> int:
        if arguments[-2] < 0:
            return DONE  # the card switches the robot on
        raise RuntimeError("a card runs this episode; expected CardBatch.step")


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
        self._fresh: dict[int, Words] = {}
        self._constants = ConstantRows(len(episodes))
        self._joint = self._joint._replace(addresses=np.zeros((1, 1), np.int64))  # of the CPU's arrays
        self._layout: EpisodeWords | None = None
        self._first: tuple[object, ...] = ()
        self._table: _Table | None = None
        self._copied: Words | None = None

    @one_thread
    def begin(
        self,
        index: int,
        seed: int,
        options: EpisodeOptions = DEFAULT_OPTIONS,
        episode: Episode | None = None,
    ) -> None:
        """Start an episode, or another `episode` in its place; `switch_on` has to follow."""
        own = episode or self._own[index]
        given = _arguments(own, seed, options)
        # The arrays of robots that are not drawn anew have the same content if they are the same objects.
        arrays = () if options.vary else (*given[1:6], given[-1])
        is_as_first = arrays and self._first and all(map(operator.is_, arrays, self._first))
        if self._layout is None:
            self._layout, self._first = EpisodeWords(given), arrays
        if not self._layout.fits(given):
            raise PlaypenError(
                f"{own.playpen.name}: other numbers of obstacles, or another controller, than in the first "
                "episode; expected the same in all episodes of a batch on a card"
            )
        self._own[index], self._begun[index] = own, (seed, options)
        self._fresh[index] = self._layout.take(given)
        of_it = {"genes": given[0].genes, "home": given[0].home, "powers": given[-2]}
        self._constants.take(index, of_it if is_as_first else constants_of(given))
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
        """Episodes, each copied from the card when it is looked at; the next look may change it."""
        return _Restored(self._restored, len(self._own))

    @property
    def boards(self) -> NDArray[np.int64]:
        """States of the boards (n, n_robots, N_REGISTERS)."""
        return self.registers

    @property
    def joint_poses(self) -> Floats:
        """Poses as of `Episode.poses` (n, n_robots, 3)."""
        return np.array([[true_pose(joints)] for joints in self._told["joints"].T.tolist()])

    @property
    def sums(self) -> Floats:
        """Sums of the metrics of the robots (n, n_robots, N_SUMS)."""
        return self._told["sums"].T[:, None]

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects (n, n_objects, 3)."""
        return self._layout.objects(self._told["things"])

    def touches(self, rows: Rows) -> NDArray[np.bool_]:
        """Return whether the robots of some episodes touch anything but the floor (n_rows, n_robots)."""
        pushes = self._told["grips"]
        return ((pushes[PUSHED] != 0) | (pushes[PUSHED_ASIDE] != 0))[np.asarray(rows), None]

    @property
    def _told(self) -> dict[str, Floats]:
        if self._table is None:
            raise ValueError("no episode has been switched on; expected begin() and switch_on() first")
        return self._table.told

    def _restored(self, index: int) -> Episode:
        """Return an episode, copied from the card unless its robot is still to be switched on."""
        episode, begun = self._own[index], self._begun[index]
        given = _arguments(episode, *begun)
        if self._table is not None and index not in self._fresh:
            if self._copied is None:
                with _LAUNCH:
                    self._copied = self._table.words.copy_to_host()
            self._layout.put(self._copied[:, index], given)
        return episode

    def _finish(self, index: int) -> None:
        self._restored(index)
        super()._finish(index)

    def _take(self, index: int) -> None:
        """Leave an episode that has failed as it is."""

    def _run_jointly(self, rows: NDArray[np.int64]) -> None:
        for error in self.switch_on().values():
            raise error
        self._launch(rows, None, self.steps)

    def _launch(self, rows: NDArray[np.int64], fresh: Words | None, untils: NDArray[np.int64]) -> None:
        """Run some episodes on the card; with `fresh`, their words (n_words, n_rows), switch them on."""
        speeds = self.speeds if self._is_driven and fresh is None else self.speeds[:0]
        joint = self._joint._replace(rows=rows, untils=untils, speeds=speeds)
        blocks = min(-(-len(rows) // BLOCK), card.n_processors() * max(card.FILLING // BLOCK, 1))
        with _LAUNCH, kernel.compiling():
            if self._table is None:
                self._table = _Table(self._layout, len(self._own))
            on_card = type(joint)(*map(cuda.to_device, joint))
            kernel.kernel(self._layout.capacity)[blocks, min(BLOCK, len(rows))](
                kernel.Constants(**self._table.common, **self._constants.on_card()),
                self._table.like,
                self._layout.first,
                self._table.words,
                self._table.words if fresh is None else cuda.to_device(fresh),
                0 if fresh is None else -1,
                on_card,
            )
            for name in ("reasons", "registers", "poses"):
                getattr(on_card, name).copy_to_host(getattr(joint, name))
            self._table.tell()
        self._copied = None


class _Table:
    """Words of n episodes on the card, and what all of them have in common.

    Args:
        layout: Layout of the words.
        count: Number of episodes.

    Attributes:
        words: Words on the card (n_words, n).
        like: `kernel.LocalMemory` of arrays on the card.
        common: Constants without rows, by name.
        told: Numbers of the episodes after the last launch by the names of `EpisodeWords.told` (n_words, n).
    """

    def __init__(self, layout: EpisodeWords, count: int) -> None:
        self._layout = layout
        self.words: Any = cuda.device_array((layout.n_kept, count), np.int64)
        self.like = kernel.LocalMemory(*(cuda.to_device(np.ascontiguousarray(each)) for each in layout.like))
        of = layout.controllers
        self.common = {
            "kind": of.kind,
            "recurrent": of.recurrent,
            "top_speed": of.top_speed,
            "sizes": cuda.to_device(of.sizes),
            "line": cuda.to_device(of.line),
        }
        self.told: dict[str, Floats] = {}

    def tell(self) -> None:
        """Copy the numbers of `told` from the card."""
        for name, words in self._layout.told.items():
            shape = len(words), self.words.shape[1]
            part = self.words[words.start : words.stop].copy_to_host() if words else np.zeros(shape)
            self.told[name] = part.view(np.float64)


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
            raise TypeError(
                f"{index} of episodes on a card; expected one index, as the next look may change it"
            )
        return self._restored(range(self._count)[index])


def _arguments(episode: Episode, seed: int, options: EpisodeOptions) -> tuple[Any, ...]:
    """Begin an episode; return its arguments for compiled code."""
    episode.begin(seed, options)
    if (found := episode.joint_arguments) is None:
        raise PlaypenError(f"{episode.playpen.name}: lamps that change; expected steady ones on a card")
    return found[1]
