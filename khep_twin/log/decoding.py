"""Decoding of a log's messages to typed values, with all checks of untrusted bytes.

A log may come from anyone. A missing, invalid or non-finite value raises a `DecodeError` with the actual and
the expected value. The caller that reads the file adds its path and the position.
"""

import struct
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.log.cdr import CDR_HEADER, CODES
from khep_twin.log.channels import TextLine
from khep_twin.log.message_types import TIMES, Field, MessageFields, fields_of
from khep_twin.process.invocation import command

LATEST_NS = 2**63 - 1
"""Latest accepted time [ns]: the range of int64, 292 years."""

SHOWN_LIMIT = 60
"""Maximum number of characters of a value from a file in an error message."""

_T = TypeVar("_T")


class DecodeError(ValueError):
    """Invalid content of a log.

    Attributes:
        actual: Actual value, with its name.
        expected: Expected value.
        row: Index of the invalid message, if several were decoded.
    """

    def __init__(self, actual: str, expected: str) -> None:
        super().__init__(f"{actual}; expected {expected}")
        self.actual = actual
        self.expected = expected
        self.row = 0

    def in_row(self, row: int) -> Self:
        """Set the index of the invalid message, and return the error."""
        self.row = row
        return self

    def to_log_error(self, path: Path, location: str, time_ns: int | None = None) -> LogError:
        """Return the error that names the file and the position in it."""
        time_text = "" if time_ns is None else f" at {time_ns / NS_PER_S:.4f} s"
        text = f"{printable(location)}{time_text}: {self.actual}"
        return LogError(text, file=path, key=location, value=self.actual, expected=self.expected)


def decode_messages(
    path: Path, topic: str, messages: Mapping[str, Sequence[tuple[int, bytes]]], decode: Callable[[bytes], _T]
) -> Iterator[tuple[int, _T]]:
    """Yield times [ns] and decoded contents of a topic's messages; `messages` is by topic."""
    for time_ns, data in messages.get(topic, ()):
        try:
            yield time_ns, decode(data)
        except DecodeError as error:
            raise error.to_log_error(path, topic, time_ns) from None


def printable(text: object) -> str:
    """Return a text from a file in short form, without control characters."""
    full_text = str(text)
    short = full_text if len(full_text) <= SHOWN_LIMIT else f"{full_text[:SHOWN_LIMIT]}..."
    return short if short.isprintable() else repr(short)


@contextmanager
def read_errors(path: Path) -> Generator[None]:
    """Convert an `OSError` for a log file to a `LogError` of one line."""
    try:
        yield
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError) and path.suffix == ".mcap"
        needs_hint = is_missing and "did you mean" not in str(error)
        hint = f"; to make one: {command('run', '--log', path)}" if needs_hint else ""
        raise LogError(f"cannot be read: {error.strerror}", hint, file=path) from error


def first_line(error: KhepTwinError) -> str:
    """Return the first line of an error, with the number of further lines."""
    lines = str(error).splitlines()
    return lines[0] if len(lines) < 2 else f"{lines[0]} (and {len(lines) - 1} more)"


class Decoder:
    """Decoder of consecutive values of a CDR message, as written by `cdr.Encoder`.

    Raises:
        DecodeError: Here and in each method: the bytes are no CDR message, or end before the value.
    """

    def __init__(self, message: bytes) -> None:
        if message[: len(CDR_HEADER)] != CDR_HEADER:
            header = message[: len(CDR_HEADER)].hex() or "nothing"
            raise DecodeError(f"header {header}", f"{CDR_HEADER.hex()}, CDR in little-endian")
        self._data = message[len(CDR_HEADER) :]
        self._offset = 0

    def numbers(self, type_code: str, count: int = 1) -> tuple[Any, ...]:
        """Return `count` consecutive numbers of a type, by its `struct` format character."""
        size = struct.calcsize(type_code)
        # Before an empty array, a message may end without padding.
        self._offset = min(self._offset + -self._offset % size, len(self._data) if not count else sys.maxsize)
        self._check_available(count, size)
        values = struct.unpack_from(f"<{count}{type_code}", self._data, self._offset)
        self._offset += count * size
        return values

    def uint32(self) -> int:
        """Return a uint32."""
        return self.numbers("I")[0]

    def text(self) -> str:
        """Return a string."""
        length = self.uint32()
        self._check_available(length, 1)
        data = self._data[self._offset : self._offset + max(length - 1, 0)]
        self._offset += length
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DecodeError(f"text with byte {data[error.start]:#04x}", "UTF-8") from None

    def time(self) -> int:
        """Return a time [ns]."""
        seconds, nanoseconds = self.numbers("i")[0], self.uint32()
        if seconds < 0 or nanoseconds >= NS_PER_S:
            actual = f"time of {seconds} s and {nanoseconds} ns"
            raise DecodeError(actual, f"0 s and later, with less than {NS_PER_S} ns")
        return seconds * NS_PER_S + nanoseconds

    def check_end(self) -> None:
        """Check that no bytes follow the decoded values."""
        if self._offset != len(self._data):
            raise DecodeError(f"{len(self._data)} bytes", f"{self._offset}, as its lengths say")

    def _check_available(self, count: int, size: int) -> None:
        # Check before allocating memory of this size.
        if count * size > len(self._data) - self._offset:
            n_left = max(len(self._data) - self._offset, 0)
            raise DecodeError(f"{count} values of {size} bytes", f"at most the {n_left} bytes that are there")


def decode(type_name: str, message: bytes) -> MessageFields:
    """Return the fields of a message of a type of `message_types` by name; a time is an integer [ns]."""
    decoder = Decoder(message)
    fields = _read_fields(decoder, type_name)
    decoder.check_end()
    return fields


def _read_fields(decoder: Decoder, type_name: str) -> MessageFields:
    return {field.name: _read_field(decoder, field) for field in fields_of(type_name)}


def _read_field(decoder: Decoder, field: Field) -> object:
    name = field.type_name
    if field.length is None and name in CODES:
        return decoder.numbers(CODES[name])[0]
    if field.length is None:
        if name == "string":
            return decoder.text()
        return decoder.time() if name in TIMES else _read_fields(decoder, name)
    count = decoder.uint32() if field.length < 0 else field.length
    if name in CODES:
        return list(decoder.numbers(CODES[name], count)) if count else []
    # Each item takes at least a byte, so a count beyond the end of the message fails soon.
    return [_read_field(decoder, field._replace(length=None)) for _ in range(count)]


def read_array(message: bytes, type_code: str) -> tuple[Any, ...]:
    """Return the values of a Float64MultiArray ("d"), Int64MultiArray ("q") or UInt8MultiArray ("B")."""
    decoder = Decoder(message)
    for _ in range(decoder.uint32()):
        decoder.text()
        decoder.numbers("I", 2)
    decoder.uint32()
    values = decoder.numbers(type_code, decoder.uint32())
    decoder.check_end()
    return values


def read_all(read: Callable[[bytes], _T], messages: Iterable[bytes]) -> list[_T]:
    """Return the decoded contents of several messages; an error has the `row` of its message."""
    values: list[_T] = []
    for message in messages:
        try:
            values.append(read(message))
        except DecodeError as error:
            raise error.in_row(len(values)) from None
    return values


def stack_arrays(
    messages: Sequence[bytes], code: str, width: int = 0, reason: str = ", as in the channel's first message"
) -> NDArray[np.int64] | NDArray[np.float64]:
    """Return the values of messages of a channel (n, width); `code` is "d" or "q", as for `read_array`.

    For width 0, the first message defines it; error messages give `reason` for the width.
    """
    width = width or len(read_array(messages[0], code))

    def read_row(message: bytes) -> tuple[Any, ...]:
        values = read_array(message, code)
        if len(values) != width:
            raise DecodeError(f"{len(values)} values", f"{width}{reason}")
        return values

    read_row(messages[0])
    # If all messages start with the same bytes, as khep_twin writes them, their values have one offset.
    size = len(messages[0])
    dtype = "<i8" if code == "q" else "<f8"
    head = messages[0][: size - 8 * width]
    if width and all(len(message) == size and message.startswith(head) for message in messages):
        raw = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
        return np.ascontiguousarray(raw[:, len(head) :]).view(dtype)
    return np.array(read_all(read_row, messages), dtype)


def stack_images(messages: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the greys of line images of one row and one width, from left to right (n, width)."""
    images = read_all(_read_image, messages)
    width = len(images[0]) if images else 0
    for row, image in enumerate(images):
        if len(image) != width:
            expected = f"{width}, as in the channel's first message"
            raise DecodeError(f"{len(image)} pixels", expected).in_row(row)
    return np.frombuffer(b"".join(images), np.uint8).reshape(len(images), width).astype(np.int64)


def _read_image(message: bytes) -> bytes:
    """Return the pixels of a grey image of one row."""
    decoder = Decoder(message)
    decoder.time()
    decoder.text()
    height, width = decoder.numbers("I", 2)
    encoding = decoder.text()
    decoder.numbers("B")
    step, size = decoder.numbers("I", 2)
    if (height, encoding) != (1, "mono8") or not width == step == size:
        actual = f"an image of {width} x {height} pixels {printable(encoding)} in {size} bytes"
        raise DecodeError(actual, "one row of mono8, with a byte for each pixel")
    pixels = bytes(decoder.numbers("B", size))
    decoder.check_end()
    return pixels


def read_transforms(message: bytes) -> dict[str, tuple[float, ...]]:
    """Return the poses of a TFMessage by body: x, y, z [m] and quaternion x, y, z, w."""
    decoder = Decoder(message)
    poses: dict[str, tuple[float, ...]] = {}
    for _ in range(decoder.uint32()):
        decoder.time()
        decoder.text()
        name = body_of(decoder.text())
        poses[name] = decoder.numbers("d", 7)
    decoder.check_end()
    return poses


def body_of(frame: str) -> str:
    """Return the name of the body of a frame, of which logs of version 1.0 have the name in /tf."""
    return frame.removesuffix("_link") if frame.endswith("/base_link") else frame


def read_line(message: bytes) -> TextLine:
    """Return a line of a transcript or of the events."""
    decoder = Decoder(message)
    time_ns = decoder.time()
    (level,) = decoder.numbers("B")
    return TextLine(time_ns, level, decoder.text(), decoder.text())
