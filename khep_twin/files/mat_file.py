"""Variables of MAT files, Matlab 4 to 7.2: matrices of real numbers and of characters.

scipy also reads them, but a damaged file can crash the process: 124 of 20,000 inputs of
`checks/fuzz/files.py` did (scipy 1.17.1), and a process for each file takes 0.4 s of CPU time. This reader
raises an error for damage, and limits memory and time for a file in advance.

    Matlab 4        one header of five int32 per matrix: kind, rows, columns, imaginary, length of the name
    Matlab 5 to 7.2 128 bytes, then elements of type and size, each matrix compressed by zlib or not

Written files contain no machine name and no time: the same variables give the same bytes.
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
"""Largest file, and largest decompressed content [bytes]."""

VARIABLE_LIMIT = 10_000
"""Most variables in a file."""

TEXT_LIMIT = 2**20
"""Most characters in all character matrices together."""

_DIMENSION_LIMIT = 32

_TITLE_BYTES = 116


@dataclass(frozen=True, slots=True)
class UnsupportedVariable:
    """A variable that is neither real numbers nor characters.

    Attributes:
        kind: Kind for messages, e.g. "a struct".
    """

    kind: str


Numbers = NDArray[np.number[Any]]
Variable = Numbers | tuple[str, ...] | UnsupportedVariable
"""A matrix of numbers (rows, columns) in their stored type, the rows of a character matrix, or a variable of
another kind."""

_MATRIX, _COMPRESSED, _INT32 = 14, 15, 5
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CHARACTERS, _NUMBERS, _OPAQUE, _COMPLEX = 4, range(6, 16), 17, 0x0800
_UNSUPPORTED = {1: "a cell array", 2: "a struct", 3: "an object", 5: "a sparse matrix", 16: "a function"}
_MATLAB_4_TYPES = ("f8", "f4", "i4", "i2", "u2", "u1")


def read_variables(data: bytes) -> dict[str, Variable]:
    """Return the variables of a MAT file, by name.

    Raises:
        MatError: It is no complete MAT file of Matlab 4 to 7.2, or exceeds the limits.
    """
    if len(data) < 20:
        raise MatError(f"no MAT file: only {len(data)} bytes; expected one of Matlab 4 to 7.2")
    if len(data) > SIZE_LIMIT:
        raise MatError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    variables: dict[str, Variable] = {}
    characters = 0
    # Files of Matlab 5 and later start with text, older ones with a small number.
    stored_variables = _read_matlab_4(data) if 0 in data[:4] else _read_matlab_5(data)
    for number, (name, value) in enumerate(stored_variables):
        if number >= VARIABLE_LIMIT:
            raise MatError(f"more than {VARIABLE_LIMIT} variables; expected a file with fewer")
        if isinstance(value, tuple):
            characters += sum(map(len, value))
        if characters > TEXT_LIMIT:
            raise _too_long_error(characters)
        # A variable without a name is internal to Matlab.
        if name:
            variables[name] = value
    return variables


@dataclass(slots=True)
class _Reader:
    """A file's bytes, and the offset of the next one to read."""

    data: memoryview
    byte_order: str
    offset: int = 0

    def read(self, size: int) -> memoryview:
        missing = self.offset + size - len(self.data)
        if missing > 0:
            raise _damage_error(f"{missing} bytes are missing at its end")
        self.offset += size
        return self.data[self.offset - size : self.offset]

    def read_integers(self, count: int) -> tuple[int, ...]:
        return struct.unpack(f"{self.byte_order}{count}I", self.read(4 * count))

    def read_element(self) -> tuple[int, memoryview]:
        """Return type and content of the next element; a small element has its size beside its type."""
        (element_type,) = self.read_integers(1)
        if element_type >> 16:
            content = self.read(4)[: min(element_type >> 16, 4)]
            return element_type & 0xFFFF, content
        (size,) = self.read_integers(1)
        content = self.read(size)
        if element_type != _COMPRESSED:
            self.offset += min(-size % 8, len(self.data) - self.offset)
        return element_type, content

    @property
    def is_at_end(self) -> bool:
        return self.offset >= len(self.data)


def _damage_error(reason: str) -> MatError:
    return MatError(f"no whole MAT file: {reason}; expected the file as saved")


def _read_matlab_5(data: bytes) -> Iterator[tuple[str, Variable]]:
    if data[:4] == b"\x89HDF" or data[:10] == b"MATLAB 7.3":
        raise MatError("a MAT file of Matlab 7.3; expected one of Matlab 4 to 7.2, as save -v7 writes it")
    byte_order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if byte_order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        raise MatError(f"no MAT file: begins {data[:20]!r}; expected one of Matlab 4 to 7.2")
    reader = _Reader(memoryview(data), byte_order, 128)
    bytes_left = SIZE_LIMIT
    n_elements = 0
    while not reader.is_at_end:
        n_elements += 1
        if n_elements > VARIABLE_LIMIT:
            raise MatError(f"more than {VARIABLE_LIMIT} variables; expected a file with fewer")
        element_type, content = reader.read_element()
        if element_type == _COMPRESSED:
            matrix_bytes = _decompress(content, bytes_left)
            bytes_left -= len(matrix_bytes)
            element_type, content = _Reader(matrix_bytes, byte_order).read_element()
        if element_type == _MATRIX and len(content):
            yield _read_matrix(_Reader(content, byte_order))


def _decompress(content: memoryview, limit: int) -> memoryview:
    try:
        data = zlib.decompressobj().decompress(content, limit + 1)
    except zlib.error as error:
        raise _damage_error(str(error)) from None
    if len(data) > limit:
        raise MatError(f"unpacked larger than {SIZE_LIMIT} bytes, the most that is read")
    return memoryview(data)


def _read_matrix(reader: _Reader) -> tuple[str, Variable]:
    flags = reader.read_element()[1]
    if len(flags) != 8:
        raise _damage_error("a matrix without its kind")
    (flag_bits,) = struct.unpack(f"{reader.byte_order}I", flags[:4])
    matrix_class = flag_bits & 0xFF
    # Only opaque objects have no size before their name.
    shape = [] if matrix_class == _OPAQUE else _decode_shape(*reader.read_element(), reader.byte_order)
    name = bytes(reader.read_element()[1][:1000]).decode("latin-1")
    if matrix_class != _CHARACTERS and matrix_class not in _NUMBERS:
        return name, UnsupportedVariable(_UNSUPPORTED.get(matrix_class, "an object"))
    if flag_bits & _COMPLEX:
        return name, UnsupportedVariable("complex")
    data_type, content = reader.read_element() if not reader.is_at_end else (1, memoryview(b""))
    if matrix_class == _CHARACTERS:
        return name, _text_rows(_decode_text(data_type, content, reader.byte_order), shape)
    return name, _reshape(_decode_numbers(data_type, content, reader.byte_order), shape, name)


def _decode_shape(element_type: int, content: memoryview, byte_order: str) -> list[int]:
    if element_type != _INT32 or not 2 <= len(content) // 4 <= _DIMENSION_LIMIT:
        raise _damage_error(f"a matrix of {len(content) // 4} dimensions")
    shape = list(struct.unpack(f"{byte_order}{len(content) // 4}i", content[: len(content) // 4 * 4]))
    if min(shape) < 0:
        raise _damage_error(f"a matrix of {' x '.join(map(str, shape))}")
    return shape


def _decode_numbers(element_type: int, content: memoryview, byte_order: str) -> Numbers:
    if element_type not in _TYPES:
        raise _damage_error(f"numbers of type {element_type}")
    dtype = np.dtype(byte_order + _TYPES[element_type])
    return np.frombuffer(content, dtype, len(content) // dtype.itemsize)


def _reshape(values: Numbers, shape: list[int], name: str) -> Numbers:
    shape_text = " x ".join(map(str, shape))
    if math.prod(shape) != len(values):
        raise MatError(f"{name[:40]!r}: {len(values)} values; expected {shape_text}")
    try:
        return values.reshape(shape, order="F")
    except ValueError:
        # Size 0 in one dimension, and a product beyond the limit of numpy in the others.
        raise _damage_error(f"a matrix of {shape_text}") from None


def _decode_text(element_type: int, content: memoryview, byte_order: str) -> str:
    if element_type not in _ENCODINGS:
        return _decode_codes(_decode_numbers(element_type, content, byte_order))
    if len(content) > 4 * TEXT_LIMIT:
        raise _too_long_error(len(content))
    encoding_suffix = "" if element_type == 16 else "-le" if byte_order == "<" else "-be"
    return bytes(content).decode(_ENCODINGS[element_type] + encoding_suffix, "replace")


def _decode_codes(codes: Numbers) -> str:
    if len(codes) > TEXT_LIMIT:
        raise _too_long_error(len(codes))
    code_points = np.full(len(codes), 0xFFFD, dtype="<u4")
    is_valid = (codes >= 0) & (codes < 0x110000)
    code_points[is_valid] = codes[is_valid]
    return code_points.tobytes().decode("utf-32-le", "replace")


def _too_long_error(characters: int) -> MatError:
    return MatError(f"text of {characters} characters; expected up to {TEXT_LIMIT}")


def _text_rows(text: str, shape: list[int]) -> tuple[str, ...]:
    """Return the rows of a char matrix, which is stored by columns."""
    if len(shape) != 2 or shape[0] < 2 or not text or math.prod(shape) != len(text):
        return (text,) if text else ()
    return tuple(text[row :: shape[0]] for row in range(shape[0]))


def _read_matlab_4(data: bytes) -> Iterator[tuple[str, Variable]]:
    byte_order = "<" if struct.unpack("<I", data[:4])[0] < 5000 else ">"
    reader = _Reader(memoryview(data), byte_order)
    while not reader.is_at_end:
        kind, rows, columns, imaginary, name_length = reader.read_integers(5)
        type_index, matrix_type = kind // 10 % 10, kind % 10
        if kind >= 5000 or type_index >= len(_MATLAB_4_TYPES) or matrix_type > 2 or name_length > 1000:
            raise MatError(
                f"no MAT file: a matrix of kind {kind} at byte {reader.offset - 20}; "
                "expected one of Matlab 4 to 7.2"
            )
        name = bytes(reader.read(name_length)).split(b"\0")[0].decode("latin-1")
        dtype = np.dtype(byte_order + _MATLAB_4_TYPES[type_index])
        content = reader.read(rows * columns * dtype.itemsize)
        if imaginary:
            reader.read(len(content))
        values = np.frombuffer(content, dtype)
        if matrix_type == 1:
            yield name, _text_rows(_decode_codes(values), [rows, columns])
        elif matrix_type == 2 or imaginary:
            yield name, UnsupportedVariable("a sparse matrix" if matrix_type == 2 else "complex")
        else:
            yield name, _reshape(values, [rows, columns], name)


def mat_bytes(values: Mapping[str, object], description: str, *, compressed: bool = True) -> bytes:
    """Return variables as a MAT file of Matlab 5.

    Args:
        values: Variables by names that Matlab accepts.
        description: Description of the content, for the title of the file.
        compressed: True to compress by zlib.
    """
    # Imported here, as scipy takes a fifth of a short run's start.
    from scipy.io import savemat

    file = BytesIO()
    savemat(file, dict(values), do_compression=compressed)
    # scipy writes the machine and the time here.
    title = f"MATLAB 5.0 MAT-file, {description} by khep_twin {__version__}".encode("ascii")
    return title.ljust(_TITLE_BYTES) + file.getvalue()[_TITLE_BYTES:]
