"""Index of a log's chunks, kept compact in memory until the end of the file, where it is written.

`serve` writes a chunk each half second. As mcap's records, each with the offsets of all message indexes after
the chunk, a day of them takes 190 MB of memory. All their content follows from a few numbers that differ
little from chunk to chunk: as columns of differences, compressed in blocks, they take less than 2 MB.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping

import numpy as np
from mcap.opcode import Opcode

ENTRY_BYTES = 16
"""Size of a message's entry in a message index: its time and its offset in the chunk [bytes]."""

COMPRESSION = b"zstd"
"""Compression of all chunks."""

_CHUNK_FRAME = struct.calcsize("<BQQQQII4sQ")
"""Size of a chunk's record without its compressed content [bytes]."""

INDEX_FRAME = struct.calcsize("<BQHI")
"""Size of a message index without its entries [bytes]."""

_BLOCK = 512


class ChunkIndex:
    """Chunk index records for the end of the file."""

    def __init__(self) -> None:
        self._rows: list[list[int]] = []
        self._blocks: list[tuple[int, bytes]] = []

    def __len__(self) -> int:
        return len(self._rows) + _BLOCK * len(self._blocks)

    def add(
        self, place: int, length: int, size: int, times_ns: tuple[int, int], counts: Mapping[int, int]
    ) -> None:
        """Add a chunk.

        Args:
            place: Offset of its record in the file [bytes].
            length: Length of its record [bytes].
            size: Size of its content, uncompressed [bytes].
            times_ns: Times of its first and its last message [ns].
            counts: Number of messages by channel; their indexes follow in this order.
        """
        row = [*times_ns, place, length, size, *(number for pair in counts.items() for number in pair)]
        self._rows.append(row)
        if len(self._rows) == _BLOCK:
            width = max(map(len, self._rows))
            table = np.array([row + [0] * (width - len(row)) for row in self._rows], np.int64)
            columns = np.diff(table, axis=0, prepend=0).T
            self._blocks.append((width, zlib.compress(columns.tobytes())))
            self._rows.clear()

    def records(self) -> Iterator[bytes]:
        """Yield the chunk index records, many at a time, in the order of the chunks."""
        for width, packed in self._blocks:
            columns = np.frombuffer(zlib.decompress(packed), np.int64).reshape(width, _BLOCK)
            yield b"".join(map(_record, np.cumsum(columns, axis=1).T.tolist()))
        yield b"".join(map(_record, self._rows))


def _record(row: list[int]) -> bytes:
    """Return a chunk index record of the stored numbers."""
    start_ns, end_ns, place, length, size, *pairs = row
    offsets: list[int] = []
    at = place + length
    for channel, count in zip(pairs[::2], pairs[1::2], strict=True):
        if count:  # Channels of other rows of the block have 0 here.
            offsets += channel, at
            at += INDEX_FRAME + ENTRY_BYTES * count
    places = struct.pack(f"<{len(offsets) // 2 * 'HQ'}", *offsets)
    head = struct.pack("<QQQQI", start_ns, end_ns, place, length, len(places))
    tail = struct.pack(
        "<QI4sQQ", at - place - length, len(COMPRESSION), COMPRESSION, length - _CHUNK_FRAME, size
    )
    return struct.pack("<BQ", Opcode.CHUNK_INDEX, len(head) + len(places) + len(tail)) + head + places + tail
