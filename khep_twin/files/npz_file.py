"""Arrays of NPZ files, numpy's archives: read without pickle and within limits, written with the same bytes.

`numpy.load` runs pickled objects if it is told to, unpacks whatever an archive says, and makes room for
whatever an array's header says. Here, all that is known before anything is unpacked.
"""

import io
import math
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
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError)
"""Errors of zipfile, zlib and numpy at damaged or encrypted content."""


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
                if each.compress_type not in _PACKED:
                    raise ValueError(f"{each.filename} is packed in a way that numpy does not use")
                contents[each.filename] = archive.read(each)
    except _DAMAGE as error:
        raise ValueError(f"no whole NPZ file: {error}") from None
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
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        shape, in_columns, kind = _HEADERS[version](file)
    except (KeyError, *_DAMAGE):
        raise ValueError(f"{name}: no array of numpy") from None
    if kind.hasobject:
        raise ValueError(f"{name}: pickled objects, which are not read; expected numbers or texts")
    values = content[file.tell() :]
    if kind.itemsize * math.prod(shape) != len(values):
        raise ValueError(f"{name}: {len(values)} bytes for an array of {shape}; it is damaged")
    if not values:
        return np.zeros(shape, kind)
    return np.frombuffer(values, kind).reshape(shape, order="F" if in_columns else "C")
