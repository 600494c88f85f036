"""Data of an episode in a thread's local memory, with constants that threads share.

A thread's local memory is an array of 64-bit words. `record_at` and `array_at` return parts of it. `overlay`
and `obstacles_at` return a record and a table with some numbers in it, and the others in shared constants.
The functions of this module run in numba's CUDA simulator; `lowering` replaces them on a GPU.
"""

from functools import cache
from typing import Any

import numpy as np

from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.casting import PlaneScene
from khep_twin.episodes.planar.plane import DISTANCE, N_COLUMNS, TANGENT_IMPULSE, Plane
from khep_twin.robots.core import CORES, Core, core_of_fields

N_STATE_COLUMNS = TANGENT_IMPULSE + 1 - DISTANCE
"""Columns of a fixed obstacle that change: its distance, and its impulses on the body."""


def record_at(local: Any, offset: int, template: Any) -> Any:
    """Return a record of a template's type, at a word of local memory."""
    record_type = template.dtype
    return _Record(np.asarray(local)[offset : offset + record_type.itemsize // 8].view(record_type)[0])


def array_at(local: Any, offset: int, template: Any) -> Any:
    """Return an array of a template's shape and type, at a word of local memory."""
    return np.asarray(local)[offset : offset + template.size].view(template.dtype).reshape(template.shape)


def constant_of(table: Any, slot: int) -> Any:
    """Return a slot's constant from a table: its row, or the only one."""
    row = np.asarray(getattr(table, "_ary", table))[min(slot, len(table) - 1)]
    if row.dtype.names is None:
        return row
    return [_Record(record) for record in row] if row.ndim else _Record(row)


def overlay(record: Any, override: Any) -> Any:
    """Return a record with some fields replaced by those of another record or of a named tuple."""
    return _overlay_class(core_of_fields(record.names))(record, override)


@cache
def _overlay_class(core: Core | None) -> "type[_Overlay]":
    """Return the class of overlays of a core's states, which is in `CORES`; for None, of other records."""
    if core is None:
        return _Overlay
    CORES[kind := type(core.name, (_Overlay,), {})] = core
    return kind


def obstacles_at(fixed: Any, state: Any, n_fixed: int) -> Any:
    """Return the table `Plane.obstacles` of an episode.

    Args:
        fixed: Table with the constants of the fixed obstacles (n, N_COLUMNS).
        state: The changing columns of fixed obstacles, then movable ones (n_words,).
        n_fixed: Number of fixed obstacles.
    """
    return _Obstacles(fixed, state, n_fixed)


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

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields."""
        names: Any = self._record.dtype.names
        return names


class _Overlay:
    def __init__(self, record: Any, override: Any) -> None:
        self._record, self._override = record, override

    def __getattr__(self, name: str) -> Any:
        return getattr(self._override if hasattr(self._override, name) else self._record, name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields of the record."""
        return self._record.names


class _Obstacles:
    def __init__(self, fixed: Any, state: Any, n_fixed: int) -> None:
        self._fixed, self._state, self._n_fixed = fixed, state, n_fixed

    def __len__(self) -> int:
        return len(self._fixed)

    def __getitem__(self, index: tuple[int, int]) -> float:
        word = state_word(index[0], index[1], self._n_fixed)
        return self._fixed[index] if word < 0 else self._state[word]

    def __setitem__(self, index: tuple[int, int], value: float) -> None:
        self._state[state_word(index[0], index[1], self._n_fixed)] = value


def state_word(obstacle: int, column: int, n_fixed: int) -> int:
    """Return the index of a number in the state of the obstacles; below 0 for a constant."""
    if obstacle >= n_fixed:
        return n_fixed * N_STATE_COLUMNS + (obstacle - n_fixed) * N_COLUMNS + column
    if planar.DISTANCE <= column <= planar.TANGENT_IMPULSE:
        return obstacle * N_STATE_COLUMNS + column - planar.DISTANCE
    return -1
