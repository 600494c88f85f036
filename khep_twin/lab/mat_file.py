"""Variables of MAT files, Matlab 4 to 7.2: matrices of real numbers and of characters.

scipy reads them too, but a damaged file can end the whole process there. Here it is an error that says where.

    Matlab 4        one header of five int32 a matrix: kind, rows, columns, imaginary, length of the name
    Matlab 5 to 7.2 128 bytes, then elements of type and size, each matrix packed by zlib or not
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import SensorTestError

SIZE_LIMIT = 2**26
"""Most bytes that a packed matrix may have [bytes]."""

Variable = NDArray[np.float64] | tuple[str, ...]
"""A matrix of numbers (rows, columns), or the rows of one of characters."""

_MATRIX, _PACKED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CHARACTERS, _NUMBERS, _COMPLEX = 4, range(6, 16), 0x0800
_TYPES_OF_4 = ("f8", "f4", "i4", "i2", "u2", "u1")


def read_variables(data: bytes) -> dict[str, Variable]:
    """The matrices of real numbers and of characters in a MAT file, by name; other variables are left out.

    Raises:
        SensorTestError: it is no whole MAT file.
    """
    if len(data) < 20:
        raise SensorTestError(f"no MAT file: only {len(data)} bytes; right is one of Matlab 4 to 7.2")
    # A name of text begins the newer files; the older ones have a small number there.
    return dict(_of_4(data) if 0 in data[:4] else _of_5(data))


@dataclass(slots=True)
class _Bytes:
    """What is left to read."""

    data: memoryview
    order: str
    place: int = 0

    def take(self, size: int) -> memoryview:
        if size < 0 or self.place + size > len(self.data):
            raise SensorTestError(
                f"no whole MAT file: {size} bytes are missing at byte {self.place}; right is all of it"
            )
        self.place += size
        return self.data[self.place - size : self.place]

    def words(self, count: int) -> tuple[int, ...]:
        return struct.unpack(f"{self.order}{count}I", self.take(4 * count))

    def element(self) -> tuple[int, memoryview]:
        """Type and bytes of the next element; small ones have both in four bytes."""
        (kind,) = self.words(1)
        if kind >> 16:
            content = self.take(4)[: min(kind >> 16, 4)]
            return kind & 0xFFFF, content
        (size,) = self.words(1)
        content = self.take(size)
        if kind != _PACKED:
            self.place += min(-size % 8, len(self.data) - self.place)
        return kind, content

    @property
    def empty(self) -> bool:
        return self.place >= len(self.data)


def _of_5(data: bytes) -> Iterator[tuple[str, Variable]]:
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        raise SensorTestError(f"no MAT file: begins {data[:20]!r}; right is one of Matlab 4 to 7.2")
    rest = _Bytes(memoryview(data), order, 128)
    while not rest.empty:
        kind, content = rest.element()
        if kind == _PACKED:
            kind, content = _Bytes(_unpacked(content), order).element()
        if kind == _MATRIX and len(content):
            found = _matrix(_Bytes(content, order))
            if found is not None:
                yield found


def _unpacked(content: memoryview) -> memoryview:
    try:
        return memoryview(zlib.decompressobj().decompress(content, SIZE_LIMIT))
    except zlib.error as error:
        raise SensorTestError(f"no whole MAT file: {error}; right is the file as saved") from None


def _matrix(rest: _Bytes) -> tuple[str, Variable] | None:
    flags = rest.element()[1]
    if len(flags) != 8:
        raise SensorTestError("no whole MAT file: a matrix without its kind; right is the file as saved")
    (kind,) = struct.unpack(f"{rest.order}I", flags[:4])
    shape = _numbers(*rest.element(), rest.order).astype(np.int64).tolist()
    name = bytes(rest.element()[1]).decode("latin-1")
    if kind & _COMPLEX or (kind & 0xFF != _CHARACTERS and kind & 0xFF not in _NUMBERS):
        return None
    stored, content = rest.element() if not rest.empty else (1, memoryview(b""))
    if kind & 0xFF == _CHARACTERS:
        return name, _rows(_text(stored, content, rest.order), shape)
    return name, _shaped(_numbers(stored, content, rest.order), shape, name)


def _numbers(kind: int, content: memoryview, order: str) -> NDArray[np.float64]:
    if kind not in _TYPES:
        raise SensorTestError(f"no whole MAT file: numbers of type {kind}; right is the file as saved")
    dtype = np.dtype(order + _TYPES[kind])
    return np.frombuffer(content, dtype, len(content) // dtype.itemsize).astype(np.float64)


def _shaped(values: NDArray[np.float64], shape: list[int], name: str) -> NDArray[np.float64]:
    if min(shape, default=-1) < 0 or math.prod(shape) != len(values):
        size = " x ".join(map(str, shape))
        raise SensorTestError(f"{name[:40]!r}: {len(values)} values; right are {size}")
    return values.reshape(shape, order="F")


def _text(kind: int, content: memoryview, order: str) -> str:
    if kind in _ENCODINGS:
        byte_order = "" if kind == 16 else "-le" if order == "<" else "-be"
        return bytes(content).decode(_ENCODINGS[kind] + byte_order, "replace")
    return _from_codes(_numbers(kind, content, order))


def _from_codes(codes: NDArray[np.float64]) -> str:
    return "".join(chr(int(code)) if 0 <= code < 0x110000 else "�" for code in codes)


def _rows(text: str, shape: list[int]) -> tuple[str, ...]:
    """The rows of a char matrix, which is stored by columns."""
    if len(shape) != 2 or shape[0] < 2 or math.prod(shape) != len(text):
        return (text,) if text else ()
    return tuple(text[row :: shape[0]] for row in range(shape[0]))


def _of_4(data: bytes) -> Iterator[tuple[str, Variable]]:
    order = "<" if struct.unpack("<I", data[:4])[0] < 5000 else ">"
    rest = _Bytes(memoryview(data), order)
    while not rest.empty:
        kind, rows, columns, imaginary, length = rest.words(5)
        number, text = kind // 10 % 10, kind % 10
        if kind >= 5000 or number >= len(_TYPES_OF_4) or text > 2 or length > 1000:
            raise SensorTestError(
                f"no MAT file: a matrix of kind {kind} at byte {rest.place - 20}; "
                "right is one of Matlab 4 to 7.2"
            )
        name = bytes(rest.take(length)).split(b"\0")[0].decode("latin-1")
        dtype = np.dtype(order + _TYPES_OF_4[number])
        content = rest.take(rows * columns * dtype.itemsize)
        if imaginary:
            rest.take(len(content))
        values = np.frombuffer(content, dtype).astype(np.float64)
        if text == 1:
            yield name, _rows(_from_codes(values), [rows, columns])
        elif text == 0 and not imaginary:
            yield name, values.reshape((rows, columns), order="F")
