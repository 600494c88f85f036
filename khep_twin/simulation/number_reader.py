"""Arrays of a snapshot, read in order, each number within its range."""

from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

_Number = TypeVar("_Number", int, float)

LARGEST = 2**53
"""Limit of numbers without a limit of their own: arithmetic on them neither overflows nor rounds."""


class NumberReader(Generic[_Number]):
    """Reader of one array.

    Args:
        name: Name of the array, for messages.
        numbers: Its numbers.
    """

    def __init__(self, name: str, numbers: Sequence[_Number]) -> None:
        self._name, self._numbers, self._index = name, numbers, 0

    def take(self, part: str, count: int, low: float = -LARGEST, high: float = LARGEST) -> list[_Number]:
        """Return the next numbers.

        Args:
            part: Name of the numbers, for messages.
            count: Number of numbers.
            low: Smallest value.
            high: Largest value.

        Raises:
            ValueError: The array ends before, or a number is outside the range or not a number.
        """
        numbers = list(self._numbers[self._index : self._index + count])
        if len(numbers) < count:
            minimum = f"{self._index + count} or more, up to {part}"
            raise ValueError(f"{self._name} = {len(self._numbers)} numbers; expected {minimum}")
        for index, number in enumerate(numbers, self._index):
            if not low <= number <= high:
                expected = f"{low}" if low == high else f"{low} to {high}"
                raise ValueError(f"{self._name}[{index}], {part} = {number}; expected {expected}")
        self._index += count
        return numbers

    def end(self) -> None:
        """Check the end of the array.

        Raises:
            ValueError: Numbers remain.
        """
        if self._index != len(self._numbers):
            raise ValueError(f"{self._name} = {len(self._numbers)} numbers; expected {self._index}")


def read_integers(name: str, data: bytes) -> NumberReader[int]:
    """Return a reader of 64-bit integers.

    Raises:
        ValueError: The bytes are not a multiple of 8.
    """
    _check_size(name, data)
    return NumberReader[int](name, np.frombuffer(data, np.int64).tolist())


def read_floats(name: str, data: bytes) -> NumberReader[float]:
    """Return a reader of 64-bit floats.

    Raises:
        ValueError: The bytes are not a multiple of 8.
    """
    _check_size(name, data)
    return NumberReader[float](name, np.frombuffer(data, np.float64).tolist())


def _check_size(name: str, data: bytes) -> None:
    if len(data) % 8:
        raise ValueError(f"{name} = {len(data)} bytes; expected a multiple of 8")
