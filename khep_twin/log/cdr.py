"""Messages of ROS 2 in CDR, encoded and decoded by the table of `message_types`.

CDR is the serialization format of ROS 2, here little-endian: a header of four bytes, then each value at a
multiple of its size, counted from the end of the header; a length precedes strings and sequences. Frequent
messages of one size are filled into copies of a `Frame`.

A message is a mapping of its fields; absent ones are 0 or empty. A time is an integer [ns].
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.message_types import TIMES, Field, Message, fields_of

CDR_HEADER = b"\x00\x01\x00\x00"

CODES = {
    "bool": "B", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
"""Formats of numbers in `struct`."""


class Encoder:
    """Encoder of consecutive values, aligned as required by CDR."""

    def __init__(self) -> None:
        self._data = bytearray()

    def append(self, kind: str, *values: float) -> "Encoder":
        """Append numbers, `kind` as in `struct`."""
        self.align(struct.calcsize(kind))
        self._data += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, value: str) -> "Encoder":
        """Append a string."""
        data = value.encode("utf-8") + b"\0"
        self.append("I", len(data))
        self._data += data
        return self

    def time(self, time_ns: int) -> "Encoder":
        """Append a time since the start of the run."""
        return self.append("i", time_ns // NS_PER_S).append("I", time_ns % NS_PER_S)

    def align(self, size: int) -> int:
        """Pad to a multiple of `size`; return the offset in the finished message."""
        self._data += bytes(-len(self._data) % size)
        return len(CDR_HEADER) + len(self._data)

    def message(self) -> bytes:
        """Return the finished message."""
        return CDR_HEADER + bytes(self._data)


def encode(type_name: str, message: Message) -> bytes:
    """Return a message of a type in CDR.

    Raises:
        ValueError: The type lacks a field, or an array of fixed length has another one.
    """
    return _FieldEncoder(type_name, message).encoder.message()


class _FieldEncoder:
    """Encoder of one message by its fields; `offsets` are those of its numbers, by path."""

    def __init__(self, type_name: str, message: Message) -> None:
        self.encoder = Encoder()
        self.offsets: dict[str, tuple[str, int, int]] = {}
        self._add_fields("", type_name, message)

    def _add_fields(self, prefix: str, type_name: str, message: Message) -> None:
        fields = fields_of(type_name)
        if unknown := message.keys() - {field.name for field in fields}:
            raise ValueError(f"{type_name} has no field {min(unknown)!r}")
        for field in fields:
            self._add_field(f"{prefix}{field.name}", field, message.get(field.name))

    def _add_field(self, path: str, field: Field, value: Any) -> None:
        if field.length is None:
            self._add_value(path, field.type_name, value)
            return
        values: Sequence[Any] = [] if value is None else value
        if field.length < 0:
            self.encoder.append("I", len(values))
        elif not len(values):
            values = [None] * field.length
        elif len(values) != field.length:
            raise ValueError(f"{path}: {len(values)} values; expected {field.length}")
        if (code := CODES.get(field.type_name)) and len(values):
            self._add_numbers(path, code, [0 if number is None else number for number in values])
        elif not code:
            for index, item in enumerate(values):
                self._add_value(f"{path}.{index}", field.type_name, item)

    def _add_value(self, path: str, type_name: str, value: Any) -> None:
        if type_name in TIMES:
            self.offsets[path] = "i", 2, self.encoder.align(4)
            self.encoder.time(value or 0)
        elif type_name == "string":
            self.encoder.text(value or "")
        elif code := CODES.get(type_name):
            self._add_numbers(path, code, [value or 0])
        else:
            self._add_fields(f"{path}.", type_name, value or {})

    def _add_numbers(self, path: str, code: str, numbers: Sequence[float]) -> None:
        self.offsets[path] = code, len(numbers), self.encoder.align(struct.calcsize(code))
        self.encoder.append(code, *numbers)


class Frame:
    """Frame of messages of one type and size, whose numbers are filled in for many messages together.

    Args:
        type_name: Type, e.g. "nav_msgs/msg/Odometry".
        message: Content that all messages share; its strings and sequences have their final length.
        variables: Paths of the numbers that vary, e.g. "header.stamp", "pose.pose.position" or "ranges". The
            numbers of a path are consecutive and of one kind; those of a time are seconds and nanoseconds.
    """

    def __init__(self, type_name: str, message: Message, variables: Sequence[str]) -> None:
        fields = _FieldEncoder(type_name, message)
        self._frame = fields.encoder.message()
        formats: list[tuple[str, tuple[int, ...]]] = []
        offsets: list[int] = []
        for path in variables:
            parts = [part for name, part in fields.offsets.items() if f"{name}.".startswith(f"{path}.")]
            code, _, offset = parts[0] if parts else ("B", 0, 0)  # an empty sequence
            formats.append((f"<{code}", (sum(length for _, length, _ in parts),)))
            offsets.append(offset)
        names = [*variables]
        size = len(self._frame)
        self._dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})

    def messages(self, values: Mapping[str, ArrayLike]) -> NDArray[np.void]:
        """Return one message for each row of the variables, as rows of bytes (n,).

        Args:
            values: Times (n,) [ns] of paths that end in a time, numbers (n, length) or (n,) of others.
        """
        arrays = {path: np.asarray(value) for path, value in values.items()}
        count = len(next(iter(arrays.values()), [0]))
        rows = np.frombuffer(bytearray(self._frame * count), self._dtype)
        for path, array in arrays.items():
            if path.endswith(("stamp", "clock")):
                array = np.column_stack(np.divmod(array, NS_PER_S))
            rows[path] = array.reshape(rows[path].shape)
        return rows

    def parse(self, messages: Sequence[bytes]) -> tuple[NDArray[np.bool_], NDArray[np.void]]:
        """Return which messages have this frame (n,), and those that do as rows with their variables."""
        size = len(self._frame)
        has_frame = np.array([len(message) == size for message in messages], bool)
        data = b"".join(message for message in messages if len(message) == size)
        # The frame and the messages without their variables; a copy by numpy would lack the bytes between.
        blank = np.frombuffer(bytearray(self._frame + data), self._dtype)
        for path in self._dtype.names or ():
            blank[path] = 0
        contents = blank.view(np.uint8).reshape(-1, size)
        is_equal = (contents[1:] == contents[0]).all(axis=1)
        has_frame[has_frame] = is_equal
        return has_frame, np.frombuffer(data, self._dtype)[is_equal]
