"""Records of named tuples."""

from typing import NamedTuple

import numpy as np

from khep_twin.sensing.buffers import as_records


class Inner(NamedTuple):
    """Part of a named tuple."""

    number: int


class Outer(NamedTuple):
    """Named tuple with an array and a part."""

    values: np.ndarray[tuple[int], np.dtype[np.float64]]
    inner: Inner


def test_records_of_the_same_fields_have_one_type_object() -> None:
    """A call of compiled code by numba takes twice as long with another object, however equal."""
    records = [as_records([(template := Outer(np.zeros(3), Inner(number)))], template) for number in range(2)]
    assert records[0].dtype is records[1].dtype
    other = Outer(np.zeros(4), Inner(1))
    assert as_records([other], other).dtype is not records[0].dtype
