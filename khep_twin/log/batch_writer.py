"""Batched writing of MCAP: many messages of one size become a chunk's bytes in one operation.

The mcap package defines the records and writes the rare ones; messages, which are many, are laid out by
numpy, several times faster than one by one.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import Protocol

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from khep_twin.log.chunk_index import COMPRESSION, ENTRY_BYTES, ChunkIndex
from khep_twin.log.record_bytes import LARGEST_CHUNK

_ROW = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""Fields before a message's data."""

_HEAD_SIZE = np.dtype(_ROW).itemsize
_LENGTH_WITHOUT_DATA = _HEAD_SIZE - 9

_INDEX_HEAD = struct.Struct("<BQHI")


class Sink(Protocol):
    """Destination of the bytes."""

    def write(self, data: bytes, /) -> int:
        """Append bytes, all or none."""
        ...

    def tell(self) -> int:
        """Return the number of bytes written."""
        ...


class BatchWriter:
    """Writer of an MCAP file.

    The profile is that of its messages, such as "ros2", the library the name and version of the program.
    """

    def __init__(self, sink: Sink, profile: str, library: str) -> None:
        self._sink = sink
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._pieces: list[bytes | memoryview] = []
        self._size = 0
        # Times of each channel's messages and their places in the chunk (n, 2).
        self._index: dict[int, list[NDArray[np.uint64]]] = {}
        self._counts: Counter[int] = Counter()
        self._span: tuple[int, int] | None = None
        self._chunks = ChunkIndex()
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        sink.write(MCAP0_MAGIC + _record(Header(profile, library)))

    def attach(self, name: str, text: str) -> None:
        """Add a text file as an attachment."""
        data = text.encode("utf-8")
        offset = self._sink.tell()
        record = Attachment(create_time=0, log_time=0, name=name, media_type="text/plain", data=data)
        length = self._sink.write(_record(record))
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                create_time=0,
                log_time=0,
                data_size=len(data),
                name=name,
                media_type="text/plain",
            )
        )

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add a metadata record about the run."""
        offset = self._sink.tell()
        length = self._sink.write(_record(Metadata(name=name, metadata=dict(facts))))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def channel(self, topic: str, schema: str, definition: str | bytes) -> int:
        """Return the number of a topic's channel, made at its first use.

        A message type is defined by text for ROS 2, by a google.protobuf.FileDescriptorSet for protobuf.
        """
        ros = isinstance(definition, str)
        if topic not in self._channels:
            if schema not in self._schemas:
                data = definition.encode("ascii") if isinstance(definition, str) else definition
                encoding = "ros2msg" if ros else "protobuf"
                known = Schema(id=len(self._schemas) + 1, name=schema, encoding=encoding, data=data)
                self._schemas[schema] = known
                self._append(_record(known))
            channel = Channel(
                id=len(self._channels) + 1,
                topic=topic,
                message_encoding="cdr" if ros else "protobuf",
                metadata={},
                schema_id=self._schemas[schema].id,
            )
            self._channels[topic] = channel
            self._append(_record(channel))
        return self._channels[topic].id

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Add messages of different sizes, at these times in their order."""
        self._begin_anew()
        if messages:
            heads = np.zeros(len(messages), _ROW)
            self._fill(heads, channel, np.array(times_ns), np.array(list(map(len, messages))))
            pieces = zip(heads.view(f"V{heads.itemsize}").tolist(), messages, strict=True)
            self._append(b"".join(chain.from_iterable(pieces)))

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Add messages of one size, a row each, at these times (n,), rising."""
        self._begin_anew()
        if len(messages):
            size = messages.itemsize
            rows = np.zeros(len(messages), _row_type(size))
            self._fill(rows, channel, times_ns, np.full(len(rows), size))
            rows["data"] = messages.view(f"V{size}")
            self._append(rows.view(np.uint8).data)

    def flush(self) -> None:
        """Write the added messages as one chunk."""
        if not self._index:
            return
        data = b"".join(self._pieces)
        packed = self._compressor.compress(data)
        times = np.concatenate([place[:, 0] for places in self._index.values() for place in places])
        start_ns, end_ns = int(times.min()), int(times.max())
        first, last = self._span or (start_ns, end_ns)
        self._span = min(first, start_ns), max(last, end_ns)
        chunk = Chunk(
            compression=COMPRESSION.decode("ascii"),
            data=packed,
            message_start_time=start_ns,
            message_end_time=end_ns,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        place = self._sink.tell()
        records = _record(chunk)
        length = len(records)
        counts: dict[int, int] = {}
        for channel, places in sorted(self._index.items()):
            entries = np.concatenate(places).astype("<u8").tobytes()
            records += (
                _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries
            )
            counts[channel] = len(entries) // ENTRY_BYTES
        self._sink.write(records)
        self._counts.update(counts)
        self._chunks.add(place, length, len(data), (start_ns, end_ns), counts)
        self._pieces.clear()
        self._index.clear()
        self._size = 0

    def finish(self) -> None:
        """Write the summary, which completes the file."""
        self.flush()
        self._sink.write(_record(DataEnd(data_section_crc=0)))
        start_ns, end_ns = self._span or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=start_ns,
            message_end_time=end_ns,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_record, self._schemas.values())),
            (Opcode.CHANNEL, map(_record, self._channels.values())),
            (Opcode.STATISTICS, [_record(statistics)]),
            (Opcode.CHUNK_INDEX, self._chunks.records()),
            (Opcode.ATTACHMENT_INDEX, map(_record, self._attachments)),
            (Opcode.METADATA_INDEX, map(_record, self._metadata)),
        ]
        summary_start = self._sink.tell()
        crc, offsets = 0, b""
        # Written in parts: for a day it is 30 MB.
        for opcode, pieces in groups:
            start = self._sink.tell()
            for piece in pieces:
                crc = zlib.crc32(piece, crc)
                self._sink.write(piece)
            length = self._sink.tell() - start
            offsets += _record(SummaryOffset(group_opcode=opcode, group_start=start, group_length=length))
        offset_start = self._sink.tell()
        crc = zlib.crc32(offsets + struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start), crc)
        footer = Footer(summary_start=summary_start, summary_offset_start=offset_start, summary_crc=crc)
        self._sink.write(offsets + _record(footer) + MCAP0_MAGIC)

    def _begin_anew(self) -> None:
        """Write the added messages if the next one would make the chunk too large to read."""
        if self._size > LARGEST_CHUNK // 4:
            self.flush()

    def _fill(
        self, rows: NDArray[np.void], channel: int, times_ns: NDArray[np.int64], sizes: NDArray[np.int64]
    ) -> None:
        """Fill in the heads (n,) of a channel's next messages, whose sizes are in [bytes], and the index."""
        rows["opcode"] = Opcode.MESSAGE
        rows["length"] = _LENGTH_WITHOUT_DATA + sizes
        rows["channel"] = channel
        rows["log_time"] = rows["publish_time"] = times_ns
        index = np.empty((len(rows), 2), np.uint64)
        index[:, 0] = times_ns
        index[0, 1] = self._size
        index[1:, 1] = self._size + np.cumsum(_HEAD_SIZE + sizes[:-1])
        self._index.setdefault(channel, []).append(index)

    def _append(self, data: bytes | memoryview) -> None:
        self._pieces.append(data)
        self._size += len(data)


@cache
def _row_type(size: int) -> np.dtype[np.void]:
    """Return the type of a message of so many bytes with its head."""
    return np.dtype([*_ROW, ("data", f"V{size}")])


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    write: Callable[[RecordBuilder], None] = record.write
    write(builder)
    return builder.end()
