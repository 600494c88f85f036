"""Decoding of a log's messages to typed values, with all checks of untrusted bytes.

A log may come from anyone. A decoded value is in the message, in range and finite, or else a `DecodeError` is
raised with what was found and what was expected; of several messages, `row` is that of the invalid one. The
caller that reads a file adds the file and the position.
"""

import struct
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.invocation import command
from khep_twin.log.channels import CDR_HEADER, TextLine

LATEST_NS = 2**63 - 1
"""Latest time that is accepted [ns]: the range of int64, 292 years."""

SHOWN = 60
"""Most characters of a value from a file that a message shows."""

_T = TypeVar("_T")


class DecodeError(ValueError):
    """Invalid content of a log.

    Attributes:
        found: Value that was found, and its name.
        expected: Expected value.
        row: Row of the invalid message, if several were read at once.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(f"{found}; expected {expected}")
        self.found, self.expected, self.row = found, expected, 0

    def in_row(self, row: int) -> Self:
        """Note the row of the invalid message, and return itself."""
        self.row = row
        return self

    def at(self, path: Path, place: str, time_ns: int | None = None) -> LogError:
        """Return the error that names the file and the position in it."""
        when = "" if time_ns is None else f" at {time_ns / NS_PER_S:.4f} s"
        found = f"{shown(place)}{when}: {self.found}"
        return LogError(found, file=path, key=place, value=self.found, expected=self.expected)


def decoded(
    path: Path, topic: str, found: Mapping[str, Sequence[tuple[int, bytes]]], decode: Callable[[bytes], _T]
) -> Iterator[tuple[int, _T]]:
    """Yield times [ns] and contents of a channel's messages, of those found in a log by topic."""
    for time_ns, data in found.get(topic, ()):
        try:
            yield time_ns, decode(data)
        except DecodeError as error:
            raise error.at(path, topic, time_ns) from None


def shown(text: object) -> str:
    """Return a text from a file as shown in a line: short, and without control characters."""
    words = str(text)
    short = words if len(words) <= SHOWN else f"{words[:SHOWN]}..."
    return short if short.isprintable() else repr(short)


@contextmanager
def readable(path: Path) -> Generator[None]:
    """Turn an error of the system's about a file into one line."""
    try:
        yield
    except OSError as error:
        make = f"; to make one: {command('run', '--log', path)}"
        is_missing = isinstance(error, FileNotFoundError) and path.suffix == ".mcap"
        needs = is_missing and "did you mean" not in str(error)
        raise LogError(f"{path}: cannot be read: {error.strerror}", make if needs else "") from error


def first_line(error: KhepTwinError) -> str:
    """Return the first of an error's lines: one problem of an attachment is enough."""
    lines = str(error).splitlines()
    return lines[0] if len(lines) < 2 else f"{lines[0]} (and {len(lines) - 1} more)"


class Decoder:
    """Decoder of consecutive values of a message in CDR, as written by `channels.Encoder`.

    Raises:
        DecodeError: Here and in each method: it is no such message, or ends before the value.
    """

    def __init__(self, message: bytes) -> None:
        if message[: len(CDR_HEADER)] != CDR_HEADER:
            found = message[: len(CDR_HEADER)].hex() or "nothing"
            raise DecodeError(f"header {found}", f"{CDR_HEADER.hex()}, CDR in little-endian")
        self._data = message[len(CDR_HEADER) :]
        self._place = 0

    def get(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        """Return consecutive numbers, `kind` as in `struct`."""
        size = struct.calcsize(kind)
        self._place += -self._place % size
        self._check(count, size)
        values = struct.unpack_from(f"<{count}{kind}", self._data, self._place)
        self._place += count * size
        return values

    def number(self) -> int:
        """Return a uint32."""
        return self.get("I")[0]

    def text(self) -> str:
        """Return a string."""
        length = self.number()
        self._check(length, 1)
        data = self._data[self._place : self._place + max(length - 1, 0)]
        self._place += length
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DecodeError(f"text with byte {data[error.start]:#04x}", "UTF-8") from None

    def time(self) -> int:
        """Return a time [ns]."""
        seconds, rest_ns = self.get("i")[0], self.number()
        if seconds < 0 or rest_ns >= NS_PER_S:
            found = f"time of {seconds} s and {rest_ns} ns"
            raise DecodeError(found, f"0 s and later, with less than {NS_PER_S} ns")
        return seconds * NS_PER_S + rest_ns

    def end(self) -> None:
        """Refuse bytes after the decoded values."""
        if self._place != len(self._data):
            raise DecodeError(f"{len(self._data)} bytes", f"{self._place}, as its lengths say")

    def _check(self, count: int, size: int) -> None:
        # Check before allocating memory of this size.
        if count * size > len(self._data) - self._place:
            there = max(len(self._data) - self._place, 0)
            raise DecodeError(f"{count} values of {size} bytes", f"at most the {there} bytes that are there")


def read_array(message: bytes, kind: str) -> tuple[Any, ...]:
    """Return the values of a Float64MultiArray ("d"), Int64MultiArray ("q") or UInt8MultiArray ("B")."""
    decoder = Decoder(message)
    for _ in range(decoder.number()):
        decoder.text()
        decoder.get("I", 2)
    decoder.number()
    values = decoder.get(kind, decoder.number())
    decoder.end()
    return values


def read_each(read: Callable[[bytes], _T], messages: Iterable[bytes]) -> list[_T]:
    """Return the content of several messages."""
    found: list[_T] = []
    for message in messages:
        try:
            found.append(read(message))
        except DecodeError as error:
            raise error.in_row(len(found)) from None
    return found


def read_arrays_of(
    messages: Sequence[bytes], kind: str, width: int = 0, wanted: str = ", as in the channel's first message"
) -> NDArray[np.int64] | NDArray[np.float64]:
    """Return the values of one or more messages of a channel (n, width), `kind` as for `read_array`.

    The width is that of the first message if it is 0; `wanted` gives its reason in messages of errors.
    """
    width = width or len(read_array(messages[0], kind))

    def of_width(message: bytes) -> tuple[Any, ...]:
        values = read_array(message, kind)
        if len(values) != width:
            raise DecodeError(f"{len(values)} values", f"{width}{wanted}")
        return values

    of_width(messages[0])
    # If all begin alike, as a log's writer makes them, the values are at the same offset in each.
    size, number = len(messages[0]), "<i8" if kind == "q" else "<f8"
    head = messages[0][: size - 8 * width]
    if width and all(len(each) == size and each.startswith(head) for each in messages):
        whole = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
        return np.ascontiguousarray(whole[:, len(head) :]).view(number)
    return np.array(read_each(of_width, messages), number)


def read_images_of(messages: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the greys of a channel's line images, all of one row and one width, left to right (n, width)."""
    found = read_each(_read_image, messages)
    width = len(found[0]) if found else 0
    for row, image in enumerate(found):
        if len(image) != width:
            expected = f"{width}, as in the channel's first message"
            raise DecodeError(f"{len(image)} pixels", expected).in_row(row)
    return np.frombuffer(b"".join(found), np.uint8).reshape(len(found), width).astype(np.int64)


def _read_image(message: bytes) -> bytes:
    """Return the pixels of a grey image of one row."""
    decoder = Decoder(message)
    decoder.time()
    decoder.text()
    height, width = decoder.get("I", 2)
    encoding = decoder.text()
    decoder.get("B")
    step, size = decoder.get("I", 2)
    if (height, encoding) != (1, "mono8") or not width == step == size:
        found = f"an image of {width} x {height} pixels {shown(encoding)} in {size} bytes"
        raise DecodeError(found, "one row of mono8, with a byte for each pixel")
    pixels = bytes(decoder.get("B", size))
    decoder.end()
    return pixels


def read_transforms(message: bytes) -> dict[str, tuple[float, ...]]:
    """Return the poses of a TFMessage by frame: x, y, z [m] and quaternion x, y, z, w."""
    decoder = Decoder(message)
    poses: dict[str, tuple[float, ...]] = {}
    for _ in range(decoder.number()):
        decoder.time()
        decoder.text()
        name = decoder.text()
        poses[name] = decoder.get("d", 7)
    decoder.end()
    return poses


def read_line(message: bytes) -> TextLine:
    """Return a line of the transcript or of the events."""
    decoder = Decoder(message)
    time_ns = decoder.time()
    (level,) = decoder.get("B")
    return TextLine(time_ns, level, decoder.text(), decoder.text())
