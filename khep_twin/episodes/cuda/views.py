"""Data of an episode in a thread's own memory, with constants that threads share.

A thread's local memory is an array of words. `record_at` and `array_at` return parts of it; `split` and
`things_at` return a record and a table of which some numbers are in it, and the others are shared.
These forms are for numba's simulator of CUDA; `lowering` has those for a card.
"""

from typing import Any

import numpy as np

from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.casting import PlaneScene
from khep_twin.episodes.planar.plane import ACROSS, DISTANCE, N_COLUMNS, Plane

N_LIVE = ACROSS + 1 - DISTANCE
"""Columns of a fixed obstacle that change: its distance, and its impulses on the body."""


def record_at(local: Any, first: int, like: Any) -> Any:
    """Return a record as those of an array, at a word of local memory."""
    kind = like.dtype
    return _Record(np.asarray(local)[first : first + kind.itemsize // 8].view(kind)[0])


def array_at(local: Any, first: int, like: Any) -> Any:
    """Return an array of a shape and type, at a word of local memory."""
    return np.asarray(local)[first : first + like.size].view(like.dtype).reshape(like.shape)


def row_of(rows: Any, lane: int) -> Any:
    """Return the row of an episode in constants: its own, or the only one."""
    row = np.asarray(getattr(rows, "_ary", rows))[min(lane, len(rows) - 1)]
    if row.dtype.names is None:
        return row
    return [_Record(each) for each in row] if row.ndim else _Record(row)


def split(record: Any, over: Any) -> Any:
    """Return a record with the fields of another one, or of a named tuple, in place of its own."""
    return _Split(record, over)


def things_at(fixed: Any, own: Any, n_fixed: int) -> Any:
    """Return the table `Plane.things` of an episode.

    Args:
        fixed: Table in which the fixed obstacles' constants are (n, N_COLUMNS).
        own: The changing columns of fixed obstacles, then movable ones (n_words,).
        n_fixed: Number of fixed obstacles.
    """
    return _Things(fixed, own, n_fixed)


def scene_of(plane: Plane) -> Any:
    """Return the scene of a plane, as the stepping core queries it."""
    return PlaneScene(plane)


class _Record:
    """A record of NumPy, its fields as attributes."""

    def __init__(self, record: np.void) -> None:
        self._record = record

    def __getattr__(self, name: str) -> Any:
        names: Any = self._record.dtype.names
        if name not in names:
            raise AttributeError(name)
        value = self._record[name]
        return _Record(value) if isinstance(value, np.void) else value


class _Split:
    def __init__(self, record: Any, over: Any) -> None:
        self._record, self._over = record, over

    def __getattr__(self, name: str) -> Any:
        return getattr(self._over if hasattr(self._over, name) else self._record, name)


class _Things:
    def __init__(self, fixed: Any, own: Any, n_fixed: int) -> None:
        self._fixed, self._own, self._n_fixed = fixed, own, n_fixed

    def __len__(self) -> int:
        return len(self._fixed)

    def __getitem__(self, at: tuple[int, int]) -> float:
        word = own_word(at[0], at[1], self._n_fixed)
        return self._fixed[at] if word < 0 else self._own[word]

    def __setitem__(self, at: tuple[int, int], value: float) -> None:
        self._own[own_word(at[0], at[1], self._n_fixed)] = value


def own_word(thing: int, column: int, n_fixed: int) -> int:
    """Return the index of a number among an episode's own; below 0 for a constant."""
    if thing >= n_fixed:
        return n_fixed * N_LIVE + (thing - n_fixed) * N_COLUMNS + column
    if flat.DISTANCE <= column <= flat.ACROSS:
        return thing * N_LIVE + column - flat.DISTANCE
    return -1
