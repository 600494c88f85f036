"""Arrays of NPZ files, numpy's archives: read without pickle and within limits, written with the same bytes.

`numpy.load` runs pickled objects on request, and decompresses and allocates as much as an archive or an
array's header states. This reader checks all sizes before it decompresses.
"""

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

SIZE_LIMIT = 2**26
"""Largest file, and largest size of all its arrays [bytes]."""

_ARRAY_LIMIT = 100
_HEADER = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|[\x02\x03]\x00....)"
    rb"\{'descr': '([<>|])([biufUO])(\d{0,6})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,12},? ?){0,9})\), \} *\n",
    re.DOTALL,
)
"""Header of an array as numpy writes it; numpy's reader accepts more forms."""

_NAME = re.compile(r"\w{1,60}\.npy", re.ASCII)
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError)
"""Errors of zipfile and zlib at damaged or encrypted content."""


def read_arrays(data: bytes) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of an NPZ file, by name.

    Raises:
        ValueError: It is no complete NPZ file of numbers and texts, or exceeds the limits.
    """
    if len(data) > SIZE_LIMIT:
        raise ValueError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            fits = size <= SIZE_LIMIT and len(members) <= _ARRAY_LIMIT
            contents: dict[str, bytes] = {}
            for member in members if fits else ():
                if member.compress_type not in _COMPRESSIONS or not _NAME.fullmatch(member.filename):
                    raise ValueError(f"{member.filename!r} is not packed as numpy does")
                contents[member.filename] = archive.read(member)
    except _DAMAGE_ERRORS as error:
        reason = "".join(char if char.isprintable() else " " for char in str(error)[:80])
        raise ValueError(f"no whole NPZ file: {reason}") from None
    if not fits:
        contents_text = f"{len(members)} arrays of {size} bytes"
        raise ValueError(f"{contents_text}; expected at most {_ARRAY_LIMIT} of {SIZE_LIMIT} bytes")
    return {name.removesuffix(".npy"): _parse_array(name, content) for name, content in contents.items()}


def npz_bytes(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Return the bytes of an NPZ file; the same arrays give the same bytes."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, value in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue())  # dated 1980
    return data.getvalue()


def _parse_array(name: str, content: bytes) -> NDArray[np.generic]:
    header = _HEADER.match(content)
    if not header:
        raise ValueError(f"{name}: no array of numpy, of numbers or texts")
    byte_order, letter, size, fortran_order, shape_text = (part.decode("ascii") for part in header.groups())
    if letter == "O":
        raise ValueError(f"{name}: pickled objects, which are not read; expected numbers or texts")
    try:
        dtype = np.dtype(f"{byte_order}{letter}{size}")
    except TypeError:
        raise ValueError(f"{name}: {letter}{size}: no type of numbers or texts") from None
    shape = tuple(int(number) for number in shape_text.split(",") if number.strip())
    values_data = content[header.end() :]
    if dtype.itemsize * math.prod(shape) != len(values_data) or not dtype.itemsize:
        raise ValueError(f"{name}: {len(values_data)} bytes for an array of {shape}; it is damaged")
    if letter == "U":
        codes = np.frombuffer(values_data, f"{byte_order}u4")
        if (codes > 0x10FFFF).any() or ((codes >= 0xD800) & (codes < 0xE000)).any():
            raise ValueError(f"{name}: no text; it is damaged")
    array = np.frombuffer(values_data, dtype).reshape(shape, order="F" if fortran_order == "True" else "C")
    if letter == "U" and not all(text.isprintable() for text in array.ravel().tolist()):
        raise ValueError(f"{name}: characters that cannot be printed; expected those of a line")
    return array
