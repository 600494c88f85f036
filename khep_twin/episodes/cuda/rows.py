"""Constants of episodes on a card: one row for all where they are the same, else one for each.

Imported only where numba-cuda is installed.
"""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

Row = NDArray[Any]


class ConstantRows:
    """Rows of the constants of n episodes. Those that differ in length end with zeros.

    Args:
        count: Number of episodes.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._common: dict[str, Row] = {}
        self._others = defaultdict[str, dict[int, Row]](dict)
        self._on_card: dict[str, Any] = {}

    def take(self, index: int, constants: Mapping[str, Row]) -> None:
        """Take the constants of an episode; those left out are the same as the first one's."""
        if not self._common:
            self._common = {name: row.copy() for name, row in constants.items()}
        for name, common in self._common.items():
            others, row = self._others[name], constants.get(name, common)
            before = others.pop(index, None)
            if not _equal(row, common):
                others[index] = row.copy()
            if before is not None or index in others:
                self._on_card.pop(name, None)

    def on_card(self) -> dict[str, Any]:
        """Return the rows on the card by name (1 or n, ...)."""
        for name in self._common.keys() - self._on_card.keys():
            self._on_card[name] = cuda.to_device(self._rows(name))
        return self._on_card

    def _rows(self, name: str) -> Row:
        common, others = self._common[name], self._others[name]
        if not others:
            return common[None].copy()
        shapes = [common.shape, *(row.shape for row in others.values())]
        rows = np.zeros((self._count, *np.max(shapes, axis=0)), common.dtype)
        for index in range(self._count):
            row = others.get(index, common)
            rows[(index, *map(slice, row.shape))] = row
        return rows


def _equal(one: Row, other: Row) -> bool:
    return one is other or (one.shape == other.shape and one.tobytes() == other.tobytes())
