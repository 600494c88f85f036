"""MAT files: scipy's files are read, damaged files and zip bombs are refused."""

import io
import struct
import time
import zlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]
from scipy.sparse import csc_array  # pyright: ignore[reportMissingTypeStubs]

from khep_twin.errors import MatError
from khep_twin.files import mat_file
from khep_twin.files.mat_file import UnsupportedVariable, read_variables


def mat_data(values: dict[str, Any], **options: Any) -> bytes:
    file = io.BytesIO()
    savemat(file, values, **options)
    return file.getvalue()


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8 if kind != 15 else 0)


def matlab_5(*elements: bytes) -> bytes:
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def matrix(
    shape: list[int], kind: int = 9, content: bytes = b"", stored: int = 2, name: bytes = b"x"
) -> bytes:
    dimensions = struct.pack(f"<{len(shape)}i", *shape)
    flags = struct.pack("<II", kind, 0)
    return element(
        14, element(6, flags) + element(5, dimensions) + element(1, name) + element(stored, content)
    )


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "i4", "f4", "f8", "u4", "i8", "u8", "bool"])
@pytest.mark.parametrize("compressed", [False, True])
def test_a_matrix_of_any_numbers_is_read(dtype: str, compressed: bool) -> None:
    values = (np.arange(12) % 2 * 44).reshape(3, 4).astype(dtype)
    matrix_read = read_variables(mat_data({"a": values}, do_compression=compressed))["a"]
    assert isinstance(matrix_read, np.ndarray)
    np.testing.assert_array_equal(matrix_read, values)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "f4", "f8"])
def test_a_matrix_of_matlab_4_is_read(dtype: str) -> None:
    values = np.arange(12).reshape(3, 4).astype(dtype)
    matrix_read = read_variables(mat_data({"a": values}, format="4"))["a"]
    assert isinstance(matrix_read, np.ndarray)
    np.testing.assert_array_equal(matrix_read, values)


def test_what_is_no_matrix_of_real_numbers_is_told_by_kind() -> None:
    values = {
        "cells": np.array([1, "x"], dtype=object), "struct": {"a": 1}, "sparse": csc_array(np.eye(3)),
        "complex": np.array([1j]), "text": ["ab", "cd"],
    }  # fmt: skip
    assert read_variables(mat_data(values)) == {
        "cells": UnsupportedVariable("a cell array"), "struct": UnsupportedVariable("a struct"),
        "sparse": UnsupportedVariable("a sparse matrix"),
        "complex": UnsupportedVariable("complex"), "text": ("ab", "cd"),
    }  # fmt: skip
    del values["cells"], values["struct"]
    assert read_variables(mat_data(values, format="4")) == {
        "sparse": UnsupportedVariable("a sparse matrix"), "complex": UnsupportedVariable("complex"),
        "text": ("ab", "cd"),
    }  # fmt: skip


def test_an_object_of_a_class_is_passed_over() -> None:
    # Matlab's strings and tables are a name without a size, followed by a store without a name.
    opaque = element(14, element(6, struct.pack("<II", 17, 0)) + element(1, b"str") + element(1, b"MCOS"))
    store = matrix([1, 3], content=b"abc", name=b"")
    variables = read_variables(matlab_5(opaque, store, matrix([1, 2], content=b"\1\2")))
    assert variables["str"] == UnsupportedVariable("an object")
    assert list(variables) == ["str", "x"]


def bomb() -> bytes:
    compressed = element(15, zlib.compress(matrix([2**15, 2**10], content=bytes(2**25)), 9))
    return matlab_5(compressed, compressed, compressed)


NO_MAT_FILE = {
    b"short": "only 5 bytes",
    b"x" * 200: "begins b'xxxxxxxxxxxxxxxxxxxx'",
    struct.pack("<5I", 7, 1, 1, 0, 2) + b"a\0" + bytes(8): "a matrix of kind 7 at byte 0",
}
NEWER = [b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM", b"\x89HDF\r\n\x1a\n".ljust(200)]
BROKEN = {
    matlab_5(matrix([-1, 2])): "a matrix of -1 x 2",
    matlab_5(matrix([1] * 33, content=b"a")): "a matrix of 33 dimensions",
    matlab_5(matrix([2**31 - 1] * 4 + [0])): f"a matrix of {'2147483647 x ' * 4}0",
    matlab_5(matrix([1, 1], content=b"a", stored=8)): "numbers of type 8",
    matlab_5(matrix([2, 2], content=b"abcd"))[:-8]: "8 bytes are missing at its end",
    matlab_5(element(14, element(6, b"1234"))): "a matrix without its kind",
    matlab_5(element(15, b"no zlib")): "Error -3 while decompressing data: incorrect header check",
    struct.pack("<5I", 0, 2**31, 2**31, 0, 2) + b"a\0" + bytes(8): (
        "36893488147419103224 bytes are missing at its end"
    ),
}
MANY_VARIABLES = [
    matlab_5(matrix([0, 0]) * 10_001),
    matlab_5(element(1, b"") * 10_001),
    (struct.pack("<5I", 50, 0, 0, 0, 2) + b"a\0") * 10_001,
]
LONG_TEXTS = [
    matlab_5(matrix([1, 2**21], 4, bytes(2**21))),
    matlab_5(matrix([1, 2**21], 4, b"a" * 2**21, stored=16)),
]
CASES = [
    *((data, f"no MAT file: {line}; expected one of Matlab 4 to 7.2") for data, line in NO_MAT_FILE.items()),
    *(
        (data, "a MAT file of Matlab 7.3; expected one of Matlab 4 to 7.2, as save -v7 writes it")
        for data in NEWER
    ),
    *((data, f"no whole MAT file: {line}; expected the file as saved") for data, line in BROKEN.items()),
    (matlab_5(matrix([2, 2], content=b"abc")), "'x': 3 values; expected 2 x 2"),
    (bomb(), f"unpacked larger than {mat_file.SIZE_LIMIT} bytes, the most that is read"),
    (bytes(mat_file.SIZE_LIMIT + 1), f"larger than {mat_file.SIZE_LIMIT} bytes, the most that is read"),
    *((data, "more than 10000 variables; expected a file with fewer") for data in MANY_VARIABLES),
    *((data, "text of 2097152 characters; expected up to 1048576") for data in LONG_TEXTS),
]


@pytest.mark.parametrize(("data", "line"), CASES, ids=[line for _, line in CASES])
def test_a_broken_file_and_a_bomb_are_one_line(data: bytes, line: str) -> None:
    with pytest.raises(MatError) as caught:
        read_variables(data)
    assert str(caught.value) == line


def test_much_text_in_many_rows_and_matrices_is_refused_in_time() -> None:
    rows = matrix([2**20, 1], 4, "♞".encode("utf-16-le") * 2**20, stored=17)
    start = time.thread_time()
    with pytest.raises(MatError, match="text of 2097152 characters; expected up to 1048576"):
        read_variables(matlab_5(rows * 30))
    assert time.thread_time() - start < 2


@pytest.mark.parametrize(
    ("codes", "data_type"),
    [
        (np.array([97, -1, 1e300, np.nan, 0xD800, 98]), 9),
        (np.array([97, -1, -128, -2, -3, 98], dtype=np.int8), 1),
        (np.array([97, -1, 2**62, 0xDC00, 0x110000, 98], dtype=np.int64), 12),
    ],
)
def test_characters_that_there_are_none_of_become_marks(codes: NDArray[Any], data_type: int) -> None:
    data = matlab_5(matrix([1, 6], 4, codes.tobytes(), data_type))
    assert read_variables(data)["x"] == ("a\ufffd\ufffd\ufffd\ufffdb",)


def test_no_text_in_very_many_rows_is_no_text() -> None:
    assert read_variables(matlab_5(matrix([2**31 - 1, 0], 4)))["x"] == ()
