"""Types of rows and tables of numbers: arrays in compiled code, in plain Python what is fastest there."""

from typing import Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", int, float)


class Vector(Protocol[Value]):
    """Numbers in a row (n,): an array, a memoryview of one, or a list."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Value: ...

    def __setitem__(self, index: int, value: Value, /) -> None: ...


class Matrix(Protocol):
    """Numbers in a table (n, m): an array, or a memoryview of one."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: tuple[int, int], /) -> float: ...

    def __setitem__(self, index: tuple[int, int], value: float, /) -> None: ...


def view(array: NDArray[np.float64]) -> "memoryview[float]":
    """Return an array's memory, which is faster to index in plain Python."""
    return cast("memoryview[float]", array.data)
