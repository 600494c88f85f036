"""Arrays of NPZ files, numpy's archives: read without pickle and within limits, written with the same bytes.

`numpy.load` runs pickled objects on request, unpacks whatever an archive says, and makes room for
whatever an array's header says. Here, all that is known before anything is unpacked.
"""

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SIZE_LIMIT = 2**26
"""Most bytes of a file, and of all its arrays [bytes]."""

_ARRAYS_LIMIT = 100
_HEADER = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|[\x02\x03]\x00....)"
    rb"\{'descr': '([<>|])([biufUO])(\d{0,6})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,12},? ?){0,9})\), \} *\n",
    re.DOTALL,
)
"""Beginning of an array, as numpy writes it; its own reader also takes what it would not write."""

_NAME = re.compile(r"\w{1,60}\.npy", re.ASCII)
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError)
"""Errors of zipfile and zlib at damaged or encrypted content."""


def read_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ file, by name.

    Raises:
        ValueError: It is no whole NPZ file of numbers and texts, or is larger than the limits.
    """
    if len(data) > SIZE_LIMIT:
        raise ValueError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            size = sum(each.file_size for each in members)
            fits = size <= SIZE_LIMIT and len(members) <= _ARRAYS_LIMIT
            contents: dict[str, bytes] = {}
            for each in members if fits else ():
                if each.compress_type not in _PACKED or not _NAME.fullmatch(each.filename):
                    raise ValueError(f"{each.filename!r} is not packed as numpy does")
                contents[each.filename] = archive.read(each)
    except _DAMAGE as error:
        reason = "".join(char if char.isprintable() else " " for char in str(error)[:80])
        raise ValueError(f"no whole NPZ file: {reason}") from None
    if not fits:
        found = f"{len(members)} arrays of {size} bytes"
        raise ValueError(f"{found}; expected at most {_ARRAYS_LIMIT} of {SIZE_LIMIT} bytes")
    return {name.removesuffix(".npy"): _array(name, content) for name, content in contents.items()}


def packed(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Return the bytes of an NPZ file; the same arrays give the same bytes."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, value in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue())  # of 1980, for all
    return data.getvalue()


def _array(name: str, content: bytes) -> NDArray[Any]:
    found = _HEADER.match(content)
    if not found:
        raise ValueError(f"{name}: no array of numpy, of numbers or texts")
    order, letter, size, in_columns, shape_text = (part.decode("ascii") for part in found.groups())
    if letter == "O":
        raise ValueError(f"{name}: pickled objects, which are not read; expected numbers or texts")
    try:
        kind = np.dtype(f"{order}{letter}{size}")
    except TypeError:
        raise ValueError(f"{name}: {letter}{size}: no type of numbers or texts") from None
    shape = tuple(int(number) for number in shape_text.split(",") if number.strip())
    values = content[found.end() :]
    if kind.itemsize * math.prod(shape) != len(values) or not kind.itemsize:
        raise ValueError(f"{name}: {len(values)} bytes for an array of {shape}; it is damaged")
    if letter == "U":
        codes = np.frombuffer(values, f"{order}u4")
        if (codes > 0x10FFFF).any() or ((codes >= 0xD800) & (codes < 0xE000)).any():
            raise ValueError(f"{name}: no text; it is damaged")
    array = np.frombuffer(values, kind).reshape(shape, order="F" if in_columns == "True" else "C")
    if letter == "U" and not all(text.isprintable() for text in array.ravel().tolist()):
        raise ValueError(f"{name}: characters that cannot be printed; expected those of a line")
    return array
