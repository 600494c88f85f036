"""Constants of episodes on a GPU by slot, shared where equal; imported only where numba-cuda is installed."""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

Constant = NDArray[Any]


class SlotConstants:
    """Constants of n slots by name. Those that differ in length are padded with zeros.

    Args:
        n_slots: Number of slots.
    """

    def __init__(self, n_slots: int) -> None:
        self._count = n_slots
        self._first_constants: dict[str, Constant] = {}
        self._overrides = defaultdict[str, dict[int, Constant]](dict)
        self._on_gpu: dict[str, Any] = {}

    def set_slot(self, slot: int, constants: Mapping[str, Constant]) -> None:
        """Set the constants of a slot; those left out equal the ones that were set first."""
        if not self._first_constants:
            self._first_constants = {name: constant.copy() for name, constant in constants.items()}
        for name, common in self._first_constants.items():
            overrides, constant = self._overrides[name], constants.get(name, common)
            previous = overrides.pop(slot, None)
            if not _are_identical(constant, common):
                overrides[slot] = constant.copy()
            if previous is not None or slot in overrides:
                self._on_gpu.pop(name, None)

    def on_gpu(self) -> dict[str, Any]:
        """Return the constants on the GPU by name (1 or n, ...)."""
        for name in self._first_constants.keys() - self._on_gpu.keys():
            self._on_gpu[name] = cuda.to_device(self._table(name))
        return self._on_gpu

    def _table(self, name: str) -> Constant:
        common, overrides = self._first_constants[name], self._overrides[name]
        if not overrides:
            return common[None].copy()
        shapes = [common.shape, *(constant.shape for constant in overrides.values())]
        table = np.zeros((self._count, *np.max(shapes, axis=0)), common.dtype)
        for slot in range(self._count):
            constant = overrides.get(slot, common)
            table[(slot, *map(slice, constant.shape))] = constant
        return table


def _are_identical(one: Constant, other: Constant) -> bool:
    return one is other or (one.shape == other.shape and one.tobytes() == other.tobytes())
