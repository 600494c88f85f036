"""Samples in packed form for a page: differences of integers, byte by byte, deflated.

A package has the length of its header (uint32, little-endian), the header as JSON, and the series in the
order of "series" there. A series has its times as unsigned differences of 4 bytes, then each column as
differences of 1, 2 or 4 bytes that wrap around. The first bytes of all numbers come first, then all second
bytes, which compresses better. `replay.js` unpacks it.
"""

import json
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TIME_UNIT_NS = 10_000
"""Unit of packed times [ns]."""

_LEVEL = 5
"""Level of compression by zlib."""

_LIMIT = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Series:
    """Samples of a channel.

    Attributes:
        times_ns: Increasing times (n,) [ns].
        values: Finite values (n, columns).
        scale: Number of packed units per unit of the values.
    """

    times_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    scale: int = 1


def pack(header: Mapping[str, object], series: Mapping[str, Series]) -> bytes:
    """Return a package of a header and of series by name."""
    parts: list[bytes] = []
    described: list[dict[str, object]] = []
    for name, item in series.items():
        units = np.diff(item.times_ns // TIME_UNIT_NS, prepend=0)
        parts.append(_planes(np.clip(units, 0, 2**32 - 1).astype("<u4")))
        columns = np.clip(np.rint(item.values * item.scale), -_LIMIT, _LIMIT).astype(np.int64).T
        widths = [_width(column) for column in columns]
        parts += [
            _planes(np.diff(column.astype(f"<i{width}"), prepend=np.array(0, f"<i{width}")))
            for column, width in zip(columns, widths, strict=True)
        ]
        described.append({"name": name, "n": len(units), "scale": item.scale, "widths": widths})
    content = json.dumps({**header, "series": described}, separators=(",", ":")).encode()
    return zlib.compress(b"".join([struct.pack("<I", len(content)), content, *parts]), _LEVEL)


def thin(times_ns: NDArray[np.int64], interval_ns: int, marks_ns: Iterable[int]) -> NDArray[np.intp]:
    """Return the rows of the first sample per interval, of the last ones up to each mark, and of the last."""
    if not interval_ns:
        return np.arange(len(times_ns))
    first = np.flatnonzero(np.diff(times_ns // interval_ns, prepend=-1))
    marked = np.searchsorted(times_ns, np.fromiter(marks_ns, np.int64), side="right") - 1
    return np.unique(np.concatenate([first, marked[marked >= 0], np.arange(len(times_ns))[-1:]]))


def _width(column: NDArray[np.int64]) -> int:
    """Return the bytes of the smallest integer that holds the values."""
    largest = int(np.abs(column).max(initial=0))
    return next(width for width in (1, 2, 4) if largest < 1 << (8 * width - 1))


def _planes(values: NDArray[np.integer]) -> bytes:
    """Return the first byte of each value, then the second bytes, and so on."""
    return values.view(np.uint8).reshape(len(values), -1).T.tobytes()
