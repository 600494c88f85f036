"""State of a simulation: named tuples in plain code, NumPy records with the same fields in compiled code."""

from collections import namedtuple
from collections.abc import Sequence
from inspect import get_annotations
from typing import Any, NamedTuple, Protocol, TypeVar, cast, dataclass_transform

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", int, float)
Numbers = TypeVar("Numbers", bound=NamedTuple)
State = TypeVar("State")

RobotState = Any
"""State of a robot: a named tuple of a class in `robots.core.CORES`, or its record in compiled code."""

_RECORD_TYPES: dict[np.dtype[np.void], np.dtype[np.void]] = {}
"""Record types, one object for each: numba compares different objects field by field at every call."""


class Vector(Protocol[Value]):
    """One-dimensional sequence of numbers (n,): an array, its memoryview, or a list."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Value: ...

    def __setitem__(self, index: int, value: Value, /) -> None: ...


class Matrix(Protocol):
    """Two-dimensional table of numbers (n, m): an array, or its memoryview."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: tuple[int, int], /) -> float: ...

    def __setitem__(self, index: tuple[int, int], value: float, /) -> None: ...


@dataclass_transform(kw_only_default=True)
def state_class(template: type[State]) -> type[State]:
    """Return a class of named tuples with the fields that a class and its bases annotate."""
    fields = [name for base in reversed(template.__mro__) for name in get_annotations(base)]
    make: Any = namedtuple
    tuple_class = make(template.__name__, fields, module=template.__module__)
    tuple_class.__doc__ = template.__doc__
    return tuple_class


def view(array: NDArray[np.float64]) -> "memoryview[float]":
    """Return a memoryview of an array, which plain Python indexes faster."""
    return cast("memoryview[float]", array.data)


def as_records(values: Sequence[NamedTuple], template: NamedTuple, marker: str = "") -> NDArray[np.void]:
    """Return named tuples as records with the same fields (n,), which compiled code passes by address.

    Args:
        values: Named tuples of numbers, lists, arrays and named tuples, all of the same shapes.
        template: A named tuple of these shapes.
        marker: Name of a further field, which makes the type of the records unique.
    """
    records = np.zeros(len(values), _record_type(template, marker))
    for record, value in zip(records, values, strict=True):
        fill_record(record, value)
    return records


def as_plain(values: Numbers, record: Any) -> Numbers:
    """Return the named tuple of a record for plain code.

    Numbers and lists remain, as they are fastest in Python and do not change. Arrays become memoryviews of
    the record's memory, so that plain and compiled code share the same state.
    """
    plain_values: list[Any] = []
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, np.ndarray):
            value = record[name].data
        elif isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            value = as_plain(cast(Any, value), record[name])
        plain_values.append(value)
    return values._make(plain_values)


def _record_type(values: NamedTuple, marker: str = "") -> np.dtype[np.void]:
    """Return the type of a named tuple's record."""
    fields: list[Any] = []
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            fields.append((name, _record_type(cast(Any, value))))
        else:
            array = np.asarray(cast(Any, value))
            fields.append((name, np.int64 if array.dtype.kind == "i" else array.dtype, array.shape))
    if marker:
        fields.append((marker, np.int64))
    dtype = np.dtype(fields, align=True)
    return _RECORD_TYPES.setdefault(dtype, dtype)


def fill_record(record: Any, values: NamedTuple) -> None:
    """Set a record's fields to those of a named tuple."""
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, tuple) and hasattr(cast(Any, value), "_fields"):
            fill_record(record[name], cast(Any, value))
        else:
            record[name] = value
