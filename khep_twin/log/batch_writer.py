"""Batched writing of MCAP files: numpy encodes many messages of one size in one operation.

In MCAP, compressed chunks contain schemas, channels and messages; a summary at the end indexes them. The mcap
package encodes the rare records, numpy the messages, several times faster than one by one.
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
from khep_twin.log.message_types import SCHEMAS, type_hash
from khep_twin.log.qos import qos_of
from khep_twin.log.record_bytes import HEAD, LARGEST_CHUNK

_MESSAGE_FIELDS = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""Fields before a message's data."""

_HEAD_SIZE = np.dtype(_MESSAGE_FIELDS).itemsize
_LENGTH_WITHOUT_DATA = _HEAD_SIZE - HEAD.size

_INDEX_HEAD = struct.Struct("<BQHI")  # opcode, length, channel ID, size of the entries [bytes]


class Sink(Protocol):
    """Destination of the bytes."""

    def write(self, data: bytes, /) -> int:
        """Append bytes, all or none."""
        ...

    def tell(self) -> int:
        """Return the number of bytes written."""
        ...


class BatchWriter:
    """Writer of an MCAP file; `profile` names the message conventions ("ros2"), `library` the program."""

    def __init__(self, sink: Sink, profile: str, library: str) -> None:
        self._sink = sink
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._records: list[bytes | memoryview] = []
        self._chunk_size = 0
        # Times of each channel's messages and their offsets in the chunk (n, 2).
        self._message_index: dict[int, list[NDArray[np.uint64]]] = {}
        self._message_counts: Counter[int] = Counter()
        self._time_range: tuple[int, int] | None = None
        self._chunk_index = ChunkIndex()
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        sink.write(MCAP0_MAGIC + _encode(Header(profile, library)))

    def attach(self, name: str, text: str) -> None:
        """Add a text file as an attachment."""
        data = text.encode("utf-8")
        offset = self._sink.tell()
        record = Attachment(create_time=0, log_time=0, name=name, media_type="text/plain", data=data)
        length = self._sink.write(_encode(record))
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, record.media_type))

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add a metadata record about the run."""
        offset = self._sink.tell()
        length = self._sink.write(_encode(Metadata(name=name, metadata=dict(facts))))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def channel(self, topic: str, schema: str, definition: str) -> int:
        """Return the ID of a topic's channel, which is created at its first use, as rosbag2 writes it."""
        if topic not in self._channels:
            if schema not in self._schemas:
                number, data = len(self._schemas) + 1, definition.encode("ascii")
                schema_record = Schema(id=number, name=schema, encoding="ros2msg", data=data)
                self._schemas[schema] = schema_record
                self._append(_encode(schema_record))
            channel = Channel(
                id=len(self._channels) + 1,
                topic=topic,
                message_encoding="cdr",
                metadata=_ros_metadata(topic, schema),
                schema_id=self._schemas[schema].id,
            )
            self._channels[topic] = channel
            self._append(_encode(channel))
        return self._channels[topic].id

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Add messages of different sizes at non-decreasing times."""
        self._flush_if_full()
        if messages:
            heads = np.zeros(len(messages), _MESSAGE_FIELDS)
            self._fill_heads(heads, channel, np.array(times_ns), np.array(list(map(len, messages))))
            pairs = zip(heads.view(f"V{heads.itemsize}").tolist(), messages, strict=True)
            self._append(b"".join(chain.from_iterable(pairs)))

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Add messages of one size, one per row, at non-decreasing times (n,) [ns]."""
        self._flush_if_full()
        if len(messages):
            size = messages.itemsize
            rows = np.zeros(len(messages), _row_type(size))
            self._fill_heads(rows, channel, times_ns, np.full(len(rows), size))
            rows["data"] = messages.view(f"V{size}")
            self._append(rows.view(np.uint8).data)

    def flush(self) -> None:
        """Write the added messages as one chunk."""
        if not self._message_index:
            return
        data = b"".join(self._records)
        compressed = self._compressor.compress(data)
        times = np.concatenate([index[:, 0] for indexes in self._message_index.values() for index in indexes])
        start_ns, end_ns = int(times.min()), int(times.max())
        first_ns, last_ns = self._time_range or (start_ns, end_ns)
        self._time_range = min(first_ns, start_ns), max(last_ns, end_ns)
        chunk = Chunk(
            compression=COMPRESSION.decode("ascii"),
            data=compressed,
            message_start_time=start_ns,
            message_end_time=end_ns,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        offset = self._sink.tell()
        records = _encode(chunk)
        length = len(records)
        counts: dict[int, int] = {}
        for channel, index_parts in sorted(self._message_index.items()):
            entries = np.concatenate(index_parts).astype("<u8").tobytes()
            records += (
                _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries
            )
            counts[channel] = len(entries) // ENTRY_BYTES
        self._sink.write(records)
        self._message_counts.update(counts)
        self._chunk_index.add(offset, length, len(data), (start_ns, end_ns), counts)
        self._records.clear()
        self._message_index.clear()
        self._chunk_size = 0

    def finish(self) -> None:
        """Complete the file by writing the summary."""
        self.flush()
        self._sink.write(_encode(DataEnd(data_section_crc=0)))
        start_ns, end_ns = self._time_range or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._message_counts.items())),
            chunk_count=len(self._chunk_index),
            message_count=self._message_counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=start_ns,
            message_end_time=end_ns,
            schema_count=len(self._schemas),
        )
        summary_groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_encode, self._schemas.values())),
            (Opcode.CHANNEL, map(_encode, self._channels.values())),
            (Opcode.STATISTICS, [_encode(statistics)]),
            (Opcode.CHUNK_INDEX, self._chunk_index.records()),
            (Opcode.ATTACHMENT_INDEX, map(_encode, self._attachments)),
            (Opcode.METADATA_INDEX, map(_encode, self._metadata)),
        ]
        summary_start = self._sink.tell()
        crc, offsets = 0, b""
        # Written in parts: for a day it is 30 MB.
        for opcode, records in summary_groups:
            start = self._sink.tell()
            for record in records:
                crc = zlib.crc32(record, crc)
                self._sink.write(record)
            length = self._sink.tell() - start
            offsets += _encode(SummaryOffset(group_opcode=opcode, group_start=start, group_length=length))
        offset_start = self._sink.tell()
        crc = zlib.crc32(offsets + struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start), crc)
        footer = Footer(summary_start=summary_start, summary_offset_start=offset_start, summary_crc=crc)
        self._sink.write(offsets + _encode(footer) + MCAP0_MAGIC)

    def _flush_if_full(self) -> None:
        """Write a chunk if the next message might make it too large to read."""
        if self._chunk_size > LARGEST_CHUNK // 4:
            self.flush()

    def _fill_heads(
        self, rows: NDArray[np.void], channel: int, times_ns: NDArray[np.int64], sizes: NDArray[np.int64]
    ) -> None:
        """Fill in the heads of a channel's next messages of `sizes` (n,) [bytes], and the index."""
        rows["opcode"] = Opcode.MESSAGE
        rows["length"] = _LENGTH_WITHOUT_DATA + sizes
        rows["channel"] = channel
        rows["log_time"] = rows["publish_time"] = times_ns
        index = np.empty((len(rows), 2), np.uint64)
        index[:, 0] = times_ns
        index[0, 1] = self._chunk_size
        index[1:, 1] = self._chunk_size + np.cumsum(_HEAD_SIZE + sizes[:-1])
        self._message_index.setdefault(channel, []).append(index)

    def _append(self, data: bytes | memoryview) -> None:
        self._records.append(data)
        self._chunk_size += len(data)


def _ros_metadata(topic: str, schema: str) -> dict[str, str]:
    """Return a channel's metadata: the offered quality of service, and the hash of a known type."""
    hashes = {"topic_type_hash": type_hash(schema)} if schema in SCHEMAS else {}
    return {"offered_qos_profiles": qos_of(topic).rosbag2_text(), **hashes}


@cache
def _row_type(size: int) -> np.dtype[np.void]:
    """Return the type of a message record with `size` bytes of data."""
    return np.dtype([*_MESSAGE_FIELDS, ("data", f"V{size}")])


def _encode(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    write: Callable[[RecordBuilder], None] = record.write
    write(builder)
    return builder.end()
