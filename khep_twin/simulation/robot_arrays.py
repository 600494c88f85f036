"""State of a robot's model in a snapshot: named arrays of 64-bit numbers, each number within its range."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from khep_twin.simulation.number_reader import LARGEST, NumberReader, read_floats, read_integers


class Part(NamedTuple):
    """Consecutive numbers of an array.

    Attributes:
        name: Name, for messages.
        size: Number of numbers.
        low: Smallest value.
        high: Largest value.
    """

    name: str
    size: int
    low: float = -LARGEST
    high: float = LARGEST


class Layout(NamedTuple):
    """Layout of a model's state.

    Attributes:
        version: Version, incremented when the arrays change.
        arrays: Parts of each array, by its path in the record of a robot's state, such as "dspic.memory".
    """

    version: int
    arrays: Mapping[str, Sequence[Part]]

    def pack(self, record: Any) -> dict[str, bytes]:
        """Return the arrays of a record."""
        return {path: _field(record, path).tobytes() for path in self.arrays}

    def unpack(self, record: Any, arrays: Mapping[str, bytes]) -> None:
        """Set a record to the arrays of a snapshot.

        Raises:
            ValueError: They are damaged.
        """
        if arrays.keys() != self.arrays.keys():
            names = ", ".join(sorted(arrays)) or "none"
            raise ValueError(f"arrays {names}; expected {', '.join(sorted(self.arrays))}")
        for path, parts in self.arrays.items():
            field = _field(record, path)
            field[:] = read(path, arrays[path], parts, is_float=field.dtype.kind == "f")


def read(name: str, data: bytes, parts: Sequence[Part], *, is_float: bool) -> list[float]:
    """Return the numbers of an array.

    Raises:
        ValueError: They are more or fewer than those of its parts, or one is outside its range.
    """
    reader: NumberReader[Any] = read_floats(name, data) if is_float else read_integers(name, data)
    numbers = [number for part in parts for number in reader.take(*part)]
    reader.end()
    return numbers


def _field(record: Any, path: str) -> np.ndarray[Any, Any]:
    """Return the array of a record at a path."""
    for name in path.split("."):
        record = record[name]
    return record
