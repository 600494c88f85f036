"""Logs split into records, changed, and reassembled with valid lengths, checksums and index.

Readers thus reach the change: a byte changed in the plain file is caught by the checksum of its chunk.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Footer, McapRecord, MetadataIndex, Statistics
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.chunk_index import ENTRY_BYTES

HEAD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQI")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_COMPRESSOR = zstandard.ZstdCompressor(level=1)


@dataclass(frozen=True)
class Record:
    """One record of a log.

    Attributes:
        opcode: Opcode of its kind.
        content: Content without opcode and length; for a chunk its original head.
        inner: Records of a chunk.
        packed: Bytes in place of a chunk's packed records; None packs them.
        size: Unpacked size in a chunk's head [bytes]; None for the true size.
    """

    opcode: int
    content: bytes
    inner: tuple["Record", ...] = ()
    packed: bytes | None = None
    size: int | None = None

    def bytes(self) -> bytes:
        """Return the record as in a file."""
        content = self.chunk() if self.opcode == Opcode.CHUNK else self.content
        if self.opcode == Opcode.ATTACHMENT:
            content = content[:-4] + struct.pack("<I", zlib.crc32(content[:-4]))
        return HEAD.pack(self.opcode, len(content)) + content

    def chunk(self) -> bytes:
        """Return the content of a chunk with its records repacked."""
        data = b"".join(record.bytes() for record in self.inner)
        packed = _COMPRESSOR.compress(data) if self.packed is None else self.packed
        times_ns = self.times_ns()
        size = len(data) if self.size is None else self.size
        crc = zlib.crc32(data) if self.packed is None else 0
        head = CHUNK_HEAD.pack(min(times_ns), max(times_ns), size % 2**64, crc)
        return head + struct.pack("<I4sQ", 4, b"zstd", len(packed)) + packed

    def times_ns(self) -> list[int]:
        """Return the times of a chunk's messages [ns]."""
        message_times_ns = [
            MESSAGE_HEAD.unpack_from(record.content)[2]
            for record in self.inner
            if record.opcode == Opcode.MESSAGE and len(record.content) >= MESSAGE_HEAD.size
        ]
        return message_times_ns or [0]


def parse_records(data: bytes) -> list[Record]:
    """Return the records of a whole log, without its index."""
    records: list[Record] = []
    place = len(MCAP0_MAGIC)
    while place < len(data):
        opcode, size = HEAD.unpack_from(data, place)
        content = data[place + HEAD.size : place + HEAD.size + size]
        place += HEAD.size + size
        if opcode == Opcode.DATA_END:
            break
        if opcode == Opcode.CHUNK:
            packed = content[CHUNK_HEAD.size + 16 :]
            records.append(Record(opcode, b"", tuple(_inner(zstandard.decompress(packed)))))
        elif opcode != Opcode.MESSAGE_INDEX:
            records.append(Record(opcode, content))
    return records


def _inner(data: bytes) -> list[Record]:
    records: list[Record] = []
    place = 0
    while place < len(data):
        opcode, size = HEAD.unpack_from(data, place)
        records.append(Record(opcode, data[place + HEAD.size : place + HEAD.size + size]))
        place += HEAD.size + size
    return records


def assemble_log(records: Sequence[Record]) -> bytes:
    """Return a whole log of records, with an index of them."""
    data = bytearray(MCAP0_MAGIC)
    index: list[bytes] = []
    kinds = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA)
    counts = dict.fromkeys(kinds, 0)
    definitions: list[bytes] = []
    last_ns = 0
    for record in records:
        offset, written = len(data), record.bytes()
        data += written
        for entry in (record, *record.inner):
            if entry.opcode in counts:
                counts[Opcode(entry.opcode)] += 1
        if record.opcode == Opcode.CHUNK:
            index.append(_chunk_index(record, offset, len(written)))
            kinds = (Opcode.SCHEMA, Opcode.CHANNEL)
            definitions += [entry.bytes() for entry in record.inner if entry.opcode in kinds]
            last_ns = max(last_ns, *record.times_ns())
        elif record.opcode == Opcode.ATTACHMENT:
            index.append(bytes_of(AttachmentIndex(offset, len(written), 0, 0, 0, "", "")))
        elif record.opcode == Opcode.METADATA:
            index.append(bytes_of(MetadataIndex(offset, len(written), "run")))
    data += HEAD.pack(Opcode.DATA_END, 4) + bytes(4)
    start = len(data)
    statistics = Statistics(
        attachment_count=counts[Opcode.ATTACHMENT],
        channel_count=counts[Opcode.CHANNEL],
        channel_message_counts={},
        chunk_count=counts[Opcode.CHUNK],
        message_count=counts[Opcode.MESSAGE],
        metadata_count=counts[Opcode.METADATA],
        message_start_time=0,
        message_end_time=last_ns,
        schema_count=0,
    )
    data += b"".join([*definitions, bytes_of(statistics), *index])
    return bytes(data + bytes_of(Footer(start, 0, 0)) + MCAP0_MAGIC)


def _chunk_index(record: Record, offset: int, length: int) -> bytes:
    times_ns = record.times_ns()
    return bytes_of(
        ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression="zstd",
            compressed_size=0,
            message_end_time=max(times_ns),
            message_index_length=ENTRY_BYTES * len(times_ns),
            message_index_offsets={},
            message_start_time=min(times_ns),
            uncompressed_size=0,
        )
    )


def bytes_of(record: McapRecord) -> bytes:
    """Return a record of mcap's as in a file."""
    builder = RecordBuilder()
    write: Callable[[RecordBuilder], None] = record.write
    write(builder)
    return builder.end()


def with_chunk(records: Sequence[Record], change: Callable[[Record], Record]) -> list[Record]:
    """Return records with the last chunk changed."""
    last = max(index for index, record in enumerate(records) if record.opcode == Opcode.CHUNK)
    return [change(record) if index == last else record for index, record in enumerate(records)]


def with_packed(records: Sequence[Record], packed: bytes, size: int) -> list[Record]:
    """Return records with other content of the last chunk, and this size in its head."""
    return with_chunk(records, lambda chunk: replace(chunk, packed=packed, size=size))
