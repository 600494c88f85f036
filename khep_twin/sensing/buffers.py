"""Numbers of a simulation: named tuples in plain code, records of the same fields in compiled code."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", int, float)
Numbers = TypeVar("Numbers", bound=NamedTuple)

_RECORD_TYPES: dict[np.dtype[np.void], np.dtype[np.void]] = {}
"""Types of records, one object for each: numba compares other objects field by field at every call."""


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


def as_records(values: Sequence[NamedTuple], like: NamedTuple) -> NDArray[np.void]:
    """Return named tuples as records of the same fields (n,): one address each to pass in compiled code.

    Args:
        values: Named tuples of numbers, lists, arrays and such tuples, all of the same shapes.
        like: A named tuple of these shapes.
    """
    records = np.zeros(len(values), _record_type(like))
    for record, value in zip(records, values, strict=True):
        fill_record(record, value)
    return records


def as_plain(values: Numbers, record: Any) -> Numbers:
    """Return the named tuple of a record for plain code.

    Its numbers and lists stay, as they are fastest in Python and do not change; its arrays become memoryviews
    of the record's own memory, so that plain and compiled code work on the same state.
    """
    parts: list[Any] = []
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, np.ndarray):
            value = record[name].data
        elif isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            value = as_plain(cast(Any, value), record[name])
        parts.append(value)
    return values._make(parts)


def _record_type(values: NamedTuple) -> np.dtype[np.void]:
    """Return the type of a named tuple's record."""
    fields: list[Any] = []
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            fields.append((name, _record_type(cast(Any, value))))
        else:
            array: NDArray[Any] = np.asarray(cast(Any, value))
            fields.append((name, np.int64 if array.dtype.kind == "i" else array.dtype, array.shape))
    made = np.dtype(fields, align=True)
    return _RECORD_TYPES.setdefault(made, made)


def fill_record(record: Any, values: NamedTuple) -> None:
    """Set a record's fields to those of a named tuple."""
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            fill_record(record[name], cast(Any, value))
        else:
            record[name] = value
