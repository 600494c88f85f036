"""Compact chunk index of a log, kept in memory and written at the end of the file.

`serve` writes a chunk each half second. As mcap's record objects, each with the offsets of all message
indexes after the chunk, the index of a day takes 190 MB. Its content follows from a few numbers that differ
little between chunks: as columns of differences, compressed in blocks, they take less than 2 MB.
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

_CHUNK_EXTRA = struct.calcsize("<BQQQQII4sQ")
"""Size of a chunk's record without its compressed content [bytes]."""

INDEX_OVERHEAD = struct.calcsize("<BQHI")
"""Size of a message index without its entries [bytes]."""

_BLOCK_ROWS = 512


class ChunkIndex:
    """Chunk index records for the end of the file; blocks of rows of numbers are compressed in memory."""

    def __init__(self) -> None:
        self._rows: list[list[int]] = []
        self._blocks: list[tuple[int, bytes]] = []

    def __len__(self) -> int:
        return len(self._rows) + _BLOCK_ROWS * len(self._blocks)

    def add(
        self, offset: int, length: int, size: int, times_ns: tuple[int, int], counts: Mapping[int, int]
    ) -> None:
        """Add a chunk.

        Args:
            offset: Offset of its record in the file [bytes].
            length: Length of its record [bytes].
            size: Size of its content, uncompressed [bytes].
            times_ns: Times of its first and its last message [ns].
            counts: Number of messages by channel; the message indexes follow in this order.
        """
        row = [*times_ns, offset, length, size, *(number for pair in counts.items() for number in pair)]
        self._rows.append(row)
        if len(self._rows) == _BLOCK_ROWS:
            width = max(map(len, self._rows))
            table = np.array([row + [0] * (width - len(row)) for row in self._rows], np.int64)
            columns = np.diff(table, axis=0, prepend=0).T
            self._blocks.append((width, zlib.compress(columns.tobytes())))
            self._rows.clear()

    def records(self) -> Iterator[bytes]:
        """Yield the chunk index records, many at a time, in the order of the chunks."""
        for width, compressed in self._blocks:
            columns = np.frombuffer(zlib.decompress(compressed), np.int64).reshape(width, _BLOCK_ROWS)
            yield b"".join(map(_encode, np.cumsum(columns, axis=1).T.tolist()))
        yield b"".join(map(_encode, self._rows))


def _encode(row: list[int]) -> bytes:
    """Encode a chunk index record from its row of numbers."""
    start_ns, end_ns, offset, length, size, *pairs = row
    index_offsets: list[int] = []
    index_offset = offset + length
    for channel, count in zip(pairs[::2], pairs[1::2], strict=True):
        if count:  # Channels of other rows of the block have 0 here.
            index_offsets += channel, index_offset
            index_offset += INDEX_OVERHEAD + ENTRY_BYTES * count
    packed_offsets = struct.pack(f"<{len(index_offsets) // 2 * 'HQ'}", *index_offsets)
    head = struct.pack("<QQQQI", start_ns, end_ns, offset, length, len(packed_offsets))
    tail = struct.pack(
        "<QI4sQQ", index_offset - offset - length, len(COMPRESSION), COMPRESSION, length - _CHUNK_EXTRA, size
    )
    body = head + packed_offsets + tail
    return struct.pack("<BQ", Opcode.CHUNK_INDEX, len(body)) + body
