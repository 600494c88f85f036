"""Variables of MAT files, Matlab 4 to 7.2: matrices of real numbers and of characters.

scipy reads them too, but a damaged file can end the whole process there: 124 of 20,000 inputs of
`checks/fuzz/files.py` did (scipy 1.17.1), and a process for each file takes 0.4 s of CPU time. Here, damage
is an error with its place, and memory and time for a file are limited in advance.

    Matlab 4        one header of five int32 a matrix: kind, rows, columns, imaginary, length of the name
    Matlab 5 to 7.2 128 bytes, then elements of type and size, each matrix packed by zlib or not

What is written has no machine name and time: the same variables give the same bytes.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import __version__
from khep_twin.errors import MatError

SIZE_LIMIT = 2**26
"""Most bytes of a file, and of all its unpacked content [bytes]."""

VARIABLE_LIMIT = 10_000
"""Most variables in a file."""

TEXT_LIMIT = 2**20
"""Most characters in all character matrices together."""

_DIMENSION_LIMIT = 32

_TITLE_BYTES = 116


@dataclass(frozen=True, slots=True)
class Foreign:
    """A variable that is neither real numbers nor characters.

    Attributes:
        kind: Kind in words, such as "a struct".
    """

    kind: str


Numbers = NDArray[np.number[Any]]
Variable = Numbers | tuple[str, ...] | Foreign
"""A matrix of numbers (rows, columns) in the type that they are stored in, the rows of a character matrix, or
a variable of another kind."""

_MATRIX, _PACKED, _INT32 = 14, 15, 5
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CHARACTERS, _NUMBERS, _OPAQUE, _COMPLEX = 4, range(6, 16), 17, 0x0800
_FOREIGN = {1: "a cell array", 2: "a struct", 3: "an object", 5: "a sparse matrix", 16: "a function"}
_TYPES_OF_4 = ("f8", "f4", "i4", "i2", "u2", "u1")


def read_variables(data: bytes) -> dict[str, Variable]:
    """Return the variables of a MAT file, by name.

    Raises:
        MatError: It is no whole MAT file of Matlab 4 to 7.2, or larger than the limits.
    """
    if len(data) < 20:
        raise MatError(f"no MAT file: only {len(data)} bytes; expected one of Matlab 4 to 7.2")
    if len(data) > SIZE_LIMIT:
        raise MatError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    variables: dict[str, Variable] = {}
    characters = 0
    # The newer files begin with a text; the older ones with a small number.
    found = _of_4(data) if 0 in data[:4] else _of_5(data)
    for number, (name, value) in enumerate(found):
        if number >= VARIABLE_LIMIT:
            raise MatError(f"more than {VARIABLE_LIMIT} variables; expected a file with fewer")
        if isinstance(value, tuple):
            characters += sum(map(len, value))
        if characters > TEXT_LIMIT:
            raise _too_long(characters)
        # A variable without a name is internal to Matlab.
        if name:
            variables[name] = value
    return variables


@dataclass(slots=True)
class _Bytes:
    """The unread rest of a file."""

    data: memoryview
    order: str
    place: int = 0

    def take(self, size: int) -> memoryview:
        missing = self.place + size - len(self.data)
        if missing > 0:
            raise _broken(f"{missing} bytes are missing at its end")
        self.place += size
        return self.data[self.place - size : self.place]

    def words(self, count: int) -> tuple[int, ...]:
        return struct.unpack(f"{self.order}{count}I", self.take(4 * count))

    def element(self) -> tuple[int, memoryview]:
        """Return type and bytes of the next element; small ones have both in four bytes."""
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


def _broken(what: str) -> MatError:
    return MatError(f"no whole MAT file: {what}; expected the file as saved")


def _of_5(data: bytes) -> Iterator[tuple[str, Variable]]:
    if data[:4] == b"\x89HDF" or data[:10] == b"MATLAB 7.3":
        raise MatError("a MAT file of Matlab 7.3; expected one of Matlab 4 to 7.2, as save -v7 writes it")
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        raise MatError(f"no MAT file: begins {data[:20]!r}; expected one of Matlab 4 to 7.2")
    rest, room = _Bytes(memoryview(data), order, 128), SIZE_LIMIT
    elements = 0
    while not rest.empty:
        elements += 1
        if elements > VARIABLE_LIMIT:
            raise MatError(f"more than {VARIABLE_LIMIT} variables; expected a file with fewer")
        kind, content = rest.element()
        if kind == _PACKED:
            unpacked = _unpacked(content, room)
            room -= len(unpacked)
            kind, content = _Bytes(unpacked, order).element()
        if kind == _MATRIX and len(content):
            yield _matrix(_Bytes(content, order))


def _unpacked(content: memoryview, room: int) -> memoryview:
    try:
        unpacked = zlib.decompressobj().decompress(content, room + 1)
    except zlib.error as error:
        raise _broken(str(error)) from None
    if len(unpacked) > room:
        raise MatError(f"unpacked larger than {SIZE_LIMIT} bytes, the most that is read")
    return memoryview(unpacked)


def _matrix(rest: _Bytes) -> tuple[str, Variable]:
    flags = rest.element()[1]
    if len(flags) != 8:
        raise _broken("a matrix without its kind")
    (word,) = struct.unpack(f"{rest.order}I", flags[:4])
    kind = word & 0xFF
    # Only these have no size before their name.
    shape = [] if kind == _OPAQUE else _shape(*rest.element(), rest.order)
    name = bytes(rest.element()[1][:1000]).decode("latin-1")
    if kind != _CHARACTERS and kind not in _NUMBERS:
        return name, Foreign(_FOREIGN.get(kind, "an object"))
    if word & _COMPLEX:
        return name, Foreign("complex")
    stored, content = rest.element() if not rest.empty else (1, memoryview(b""))
    if kind == _CHARACTERS:
        return name, _rows(_text(stored, content, rest.order), shape)
    return name, _shaped(_numbers(stored, content, rest.order), shape, name)


def _shape(kind: int, content: memoryview, order: str) -> list[int]:
    if kind != _INT32 or not 2 <= len(content) // 4 <= _DIMENSION_LIMIT:
        raise _broken(f"a matrix of {len(content) // 4} dimensions")
    shape = list(struct.unpack(f"{order}{len(content) // 4}i", content[: len(content) // 4 * 4]))
    if min(shape) < 0:
        raise _broken(f"a matrix of {' x '.join(map(str, shape))}")
    return shape


def _numbers(kind: int, content: memoryview, order: str) -> Numbers:
    if kind not in _TYPES:
        raise _broken(f"numbers of type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    return np.frombuffer(content, dtype, len(content) // dtype.itemsize)


def _shaped(values: Numbers, shape: list[int], name: str) -> Numbers:
    size = " x ".join(map(str, shape))
    if math.prod(shape) != len(values):
        raise MatError(f"{name[:40]!r}: {len(values)} values; expected {size}")
    try:
        return values.reshape(shape, order="F")
    except ValueError:
        # Size 0 in one dimension, too large a product in the others.
        raise _broken(f"a matrix of {size}") from None


def _text(kind: int, content: memoryview, order: str) -> str:
    if kind not in _ENCODINGS:
        return _from_codes(_numbers(kind, content, order))
    if len(content) > 4 * TEXT_LIMIT:
        raise _too_long(len(content))
    byte_order = "" if kind == 16 else "-le" if order == "<" else "-be"
    return bytes(content).decode(_ENCODINGS[kind] + byte_order, "replace")


def _from_codes(codes: Numbers) -> str:
    if len(codes) > TEXT_LIMIT:
        raise _too_long(len(codes))
    known = np.full(len(codes), 0xFFFD, dtype="<u4")
    there = (codes >= 0) & (codes < 0x110000)
    known[there] = codes[there]
    return known.tobytes().decode("utf-32-le", "replace")


def _too_long(characters: int) -> MatError:
    return MatError(f"text of {characters} characters; expected up to {TEXT_LIMIT}")


def _rows(text: str, shape: list[int]) -> tuple[str, ...]:
    """Return the rows of a char matrix, which is stored by columns."""
    if len(shape) != 2 or shape[0] < 2 or not text or math.prod(shape) != len(text):
        return (text,) if text else ()
    return tuple(text[row :: shape[0]] for row in range(shape[0]))


def _of_4(data: bytes) -> Iterator[tuple[str, Variable]]:
    order = "<" if struct.unpack("<I", data[:4])[0] < 5000 else ">"
    rest = _Bytes(memoryview(data), order)
    while not rest.empty:
        kind, rows, columns, imaginary, length = rest.words(5)
        number, text = kind // 10 % 10, kind % 10
        if kind >= 5000 or number >= len(_TYPES_OF_4) or text > 2 or length > 1000:
            raise MatError(
                f"no MAT file: a matrix of kind {kind} at byte {rest.place - 20}; "
                "expected one of Matlab 4 to 7.2"
            )
        name = bytes(rest.take(length)).split(b"\0")[0].decode("latin-1")
        dtype = np.dtype(order + _TYPES_OF_4[number])
        content = rest.take(rows * columns * dtype.itemsize)
        if imaginary:
            rest.take(len(content))
        values = np.frombuffer(content, dtype)
        if text == 1:
            yield name, _rows(_from_codes(values), [rows, columns])
        elif text == 2 or imaginary:
            yield name, Foreign("a sparse matrix" if text == 2 else "complex")
        else:
            yield name, _shaped(values, [rows, columns], name)


def mat_bytes(values: Mapping[str, object], what: str, *, packed: bool = True) -> bytes:
    """Return variables as a MAT file of Matlab 5.

    Args:
        values: Variables by names that Matlab accepts.
        what: Description of the file for its title.
        packed: True to compress by zlib.
    """
    # Every run could save a series; to import scipy would take a fifth of a short run's start.
    from scipy.io import savemat

    file = BytesIO()
    savemat(file, dict(values), do_compression=packed)
    # scipy writes the machine and the time here.
    title = f"MATLAB 5.0 MAT-file, {what} by khep_twin {__version__}".encode("ascii")
    return title.ljust(_TITLE_BYTES) + file.getvalue()[_TITLE_BYTES:]
