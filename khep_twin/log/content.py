"""Bounds-checked records of a finished log file: nothing that a file declares is used unchecked.

A size is compared with the available bytes before reading, and with a constant before decompression. The
records named by the index are in the file and do not overlap, so that no byte is read twice.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Header, Metadata, Statistics
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.chunk_index import ENTRY_BYTES, INDEX_OVERHEAD
from khep_twin.log.decoding import LATEST_NS, DecodeError
from khep_twin.log.entries import Entry, EntryReader
from khep_twin.log.record_bytes import (
    HEAD,
    LARGEST_CHUNK,
    LARGEST_RATIO,
    MESSAGE,
    SLACK,
    RecordBytes,
    decompress,
    iterate_records,
    parse_record,
)

LARGEST_RECORD = LARGEST_CHUNK
"""Largest record that is read, such as an attachment; not the content of a chunk [bytes]."""

_FOOTER = struct.Struct("<QQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_CHANNEL_OFFSET = struct.Struct("<H8x")
_LOCATION = struct.Struct("<QQ")

_LOOSE_LIMIT = 4 << 20
"""Maximum size of messages outside chunks that are read together, if they are more than one [bytes]."""


class Content:
    """Content of a finished log file.

    Args:
        file: Open file.
        topic_filter: Function that returns whether to yield the messages of a topic; None for all.

    Raises:
        DecodeError: Here and in each method: the file is no complete MCAP file, or exceeds a limit.
    """

    def __init__(self, file: BinaryIO, topic_filter: Callable[[str], bool] | None = None) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._unpacked_size = 0
        self._reader = EntryReader(topic_filter)
        self._end_ns = 0
        self._n_messages: int | None = None
        self._chunks: list[tuple[int, int, int]] = []  # start [ns], offset and length in the file [bytes]
        self._loose_offsets: set[int] = set()
        self._first_chunks: dict[int, tuple[int, tuple[int, int, int]]] = {}
        self._locations: dict[int, list[tuple[int, int]]] = {Opcode.ATTACHMENT: [], Opcode.METADATA: []}
        self._footer_offset = self._size - len(MCAP0_MAGIC) - HEAD.size - _FOOTER.size
        self._has_all_chunks = self._has_all_locations = False
        self._last_times_ns: dict[int, int] = {}
        self._in_order = True
        self._read_summary()

    def messages(self) -> Iterator[Entry]:
        """Yield the messages in the order of the file."""
        return chain.from_iterable(entries for _, entries in self.chunks())

    def messages_since(self, topic: str, time_ns: int) -> Iterator[list[Entry]]:
        """Yield the last message of a topic up to a time [ns], then later messages by chunk.

        If the topic has no message up to that time, yield an empty list, then all messages.
        """
        self._find_chunks()
        chunks = self._chunks if self._in_order else self._chunks[:1]
        candidates = (number for number, (start_ns, _, _) in enumerate(chunks) if start_ns <= time_ns)
        for number in reversed([*candidates] if self._reader.has_channel(topic) else []):
            parts = self.chunks(chunks[number : number + 1])
            chunk_entries = [entry for _, messages in parts for entry in messages]
            if (index := _find_last(chunk_entries, topic, time_ns)) is not None:
                yield [chunk_entries[index]]
                yield chunk_entries[index + 1 :]
                break
        else:
            yield []
            number = -1
        for _, entries in self.chunks(chunks[number + 1 :]):
            yield list(entries)

    def first_messages(self) -> Iterator[Entry]:
        """Yield the first message of each channel; the index names the chunks."""
        self._find_chunks()
        topics: set[str] = set()
        chunks = sorted({chunk for _, chunk in self._first_chunks.values()})
        for _, entries in self.chunks(chunks):
            for entry in sorted(entries, key=lambda message: message.time_ns):
                if entry.topic not in topics:
                    topics.add(entry.topic)
                    yield entry

    def batches(self, batch_bytes: int) -> Iterator[tuple[float, list[Entry]]]:
        """Yield the fraction read, 0 to 1, and a batch of messages: about `batch_bytes`, plus a chunk.

        No message of a batch is earlier than those of the previous batch.
        """
        batch: list[Entry] = []
        n_bytes, n_messages, split_ns = 0, 0, 0
        self._find_chunks()
        # A chunk with only a late reply may precede a chunk that starts earlier.
        for number, (start_ns, entries) in enumerate(self.chunks(sorted(self._chunks))):
            if n_bytes > batch_bytes and start_ns > split_ns:
                split_ns, n_bytes = start_ns, 0
                yield number / len(self._chunks), [message for message in batch if message.time_ns < split_ns]
                batch = [message for message in batch if message.time_ns >= split_ns]
            messages = [*entries]
            n_bytes += MESSAGE.size * len(messages) + sum(len(message.data) for message in messages)
            n_messages += len(messages)
            batch += messages
        n_messages += self._reader.n_skipped
        if self._n_messages is not None and n_messages != self._n_messages:
            raise DecodeError(f"{n_messages} messages", f"{self._n_messages}, as its statistics say")
        yield 1.0, batch

    def attachments(self) -> Iterator[Attachment]:
        """Yield the attachments."""
        for offset, content in self._read_records(Opcode.ATTACHMENT):
            attachment = parse_record(Opcode.ATTACHMENT, content)
            crc = int.from_bytes(content[-4:], "little")
            if not isinstance(attachment, Attachment) or (crc and zlib.crc32(content[:-4]) != crc):
                raise DecodeError(f"attachment at byte {offset}", "one that holds what its checksum says")
            yield attachment

    def metadata(self) -> Iterator[Metadata]:
        """Yield the metadata records."""
        for offset, content in self._read_records(Opcode.METADATA):
            record = parse_record(Opcode.METADATA, content)
            if not isinstance(record, Metadata):
                raise DecodeError(f"metadata at byte {offset}", "texts of the lengths that they say")
            yield record

    def end_ns(self) -> int:
        """Return the time of the last message [ns]."""
        self._find_chunks()
        if self._end_ns > LATEST_NS:
            raise DecodeError(f"message_end_time = {self._end_ns} in the statistics", f"at most {LATEST_NS}")
        return self._end_ns

    def _read_summary(self) -> None:
        """Read the summary, and check by its statistics whether the index is complete."""
        magic = len(MCAP0_MAGIC)  # [bytes]
        if self._footer_offset < magic or self._read_bytes(0, magic) != MCAP0_MAGIC:
            raise DecodeError("no MCAP file", "one that begins and ends as such")
        if self._read_bytes(self._size - magic, magic) != MCAP0_MAGIC:
            raise DecodeError("no end", "a finished .mcap file")
        opcode, length = HEAD.unpack(self._read_bytes(self._footer_offset, HEAD.size))
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size):
            raise DecodeError(f"record {opcode} of {length} bytes at the end", "a footer")
        start, _, _ = _FOOTER.unpack(self._read_bytes(self._footer_offset + HEAD.size, _FOOTER.size))
        if start == 0:
            return
        if not magic <= start <= self._footer_offset:
            raise DecodeError(f"index at byte {start}", f"it between {magic} and {self._footer_offset}")
        lengths_by_offset: dict[int, int] = {}
        statistics, n_messages, has_definitions = None, 0, True
        for opcode, offset, size in self._iterate_heads(start, self._footer_offset):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._reader.define(opcode, self._read_content(offset, size), offset)
                except DecodeError:
                    has_definitions = False
                continue
            if opcode == Opcode.STATISTICS:
                statistics = parse_record(opcode, self._read_content(offset, size))
                if not isinstance(statistics, Statistics):
                    raise DecodeError(f"definition at byte {offset}", "texts of the lengths that they say")
                continue
            if opcode == Opcode.CHUNK_INDEX:
                content = self._read_content(offset, size)
                start_ns, _, *location, channels_size = _unpack(_CHUNK_INDEX, content, offset)
                self._chunks.append(chunk := (start_ns, location[0], location[1]))
                if channels_size % _CHANNEL_OFFSET.size or channels_size > len(content) - _CHUNK_INDEX.size:
                    actual = f"{channels_size} bytes of channels at byte {offset}"
                    raise DecodeError(actual, "those that are there")
                channel_ids = [*_CHANNEL_OFFSET.iter_unpack(content[_CHUNK_INDEX.size :][:channels_size])]
                for (channel,) in channel_ids:
                    self._add_first_chunk(channel, start_ns, chunk)
                n_messages += _count_messages(content, _CHUNK_INDEX.size + channels_size, len(channel_ids))
            elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
                location = _unpack(_LOCATION, self._read_content(offset, size), offset)
                record_opcode = Opcode.ATTACHMENT if opcode == Opcode.ATTACHMENT_INDEX else Opcode.METADATA
                self._locations[record_opcode].append((location[0], location[1]))
            else:
                continue
            if location[0] in lengths_by_offset:
                raise DecodeError(f"record at byte {location[0]} named twice in the index", "each once")
            lengths_by_offset[location[0]] = location[1]
        previous_end = magic
        for offset, length in sorted(lengths_by_offset.items()):
            if offset < previous_end or offset + length > start:
                actual = f"record at byte {offset} of {length} bytes in the index"
                raise DecodeError(actual, f"it between {previous_end} and {start}")
            previous_end = offset + length
        self._chunks.sort(key=lambda chunk: chunk[1])
        if statistics is None:
            return
        self._end_ns = statistics.message_end_time
        self._n_messages = statistics.message_count
        expected_counts = statistics.chunk_count, statistics.message_count, statistics.channel_count
        counts = len(self._chunks), n_messages, self._reader.n_channels
        # Files of other tools may also be out of order; only the messages show that.
        self._has_all_chunks = self._is_khep_twin() and has_definitions and counts == expected_counts
        n_records = statistics.attachment_count, statistics.metadata_count
        self._has_all_locations = tuple(map(len, self._locations.values())) == n_records

    def chunks(
        self, chunks: Sequence[tuple[int, int, int]] | None = None
    ) -> Iterator[tuple[int, Iterator[Entry]]]:
        """Yield start [ns] and messages of each chunk; by default of all, in the order of the file."""
        self._find_chunks()
        if not self._in_order:
            if chunks is None or chunks:
                entries = chain.from_iterable(self._chunk_entries(chunk) for chunk in self._chunks)
                yield 0, iter(sorted(entries, key=lambda entry: (entry.time_ns, entry.topic)))
            return
        for chunk in self._chunks if chunks is None else chunks:
            yield chunk[0], self._chunk_entries(chunk)

    def _chunk_entries(self, chunk: tuple[int, int, int]) -> Iterator[Entry]:
        start_ns, offset, length = chunk
        read = self._read_bytes if offset in self._loose_offsets else self._read_chunk
        return self._reader.parse_entries(read(offset, length), offset, start_ns)

    def _find_chunks(self) -> None:
        """Find all chunks if the index, which MCAP does not require, may be incomplete.

        Runs of consecutive messages outside chunks are read like chunks. A file of another tool in which the
        time of a channel decreases is read in order of time, as one chunk.
        """
        if self._has_all_chunks:
            return
        indexed_chunks, self._chunks, self._first_chunks, self._end_ns = self._chunks, [], {}, 0
        start = end = 0
        for opcode, offset, size in self._data_records():
            record_end = offset + HEAD.size + size
            is_loose = opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
            if end > start and not (is_loose and record_end - start <= _LOOSE_LIMIT):
                self._loose_offsets.add(start)
                self._add_chunk(start, end - start, self._read_bytes(start, end - start))
                start = end
            if is_loose:
                start, end = (start if end == offset and start < end else offset), record_end
            elif opcode == Opcode.CHUNK:
                self._add_chunk(offset, record_end - offset, self._read_chunk(offset, record_end - offset))
        _check_indexed([chunk[1:] for chunk in indexed_chunks], [chunk[1:] for chunk in self._chunks])
        self._has_all_chunks = True
        self._in_order = self._in_order or self._is_khep_twin()
        # Reading decompresses the chunks again.
        self._unpacked_size = 0

    def _find_locations(self) -> None:
        """Find all attachments and metadata if the index may be incomplete."""
        if self._has_all_locations:
            return
        indexed = self._locations
        self._locations = {opcode: list[tuple[int, int]]() for opcode in indexed}
        for opcode, offset, size in self._data_records():
            if opcode in indexed:
                self._locations[opcode].append((offset, HEAD.size + size))
        for opcode, locations in indexed.items():
            _check_indexed(locations, self._locations[opcode])
        self._has_all_locations = True

    def _data_records(self) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, offset and content length of all records up to the end of the data section."""
        for opcode, offset, size in self._iterate_heads(len(MCAP0_MAGIC), self._footer_offset):
            yield opcode, offset, size
            if opcode == Opcode.DATA_END:
                return
        yield Opcode.DATA_END, self._footer_offset, 0

    def _add_chunk(self, offset: int, length: int, records: bytes) -> None:
        """Store the time range, channels and definitions of a chunk."""
        first_ns: dict[int, int] = {}
        for opcode, start, end in iterate_records(records):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._reader.define(opcode, records[start:end], offset)
            elif opcode == Opcode.MESSAGE and end - start >= MESSAGE.size:
                channel, _, time_ns, _ = MESSAGE.unpack_from(records, start)
                first_ns[channel] = min(time_ns, first_ns.get(channel, time_ns))
                self._end_ns = max(self._end_ns, time_ns)
                self._in_order &= time_ns >= self._last_times_ns.get(channel, 0)
                self._last_times_ns[channel] = time_ns
        chunk = min(first_ns.values(), default=0), offset, length
        self._chunks.append(chunk)
        for channel, time_ns in first_ns.items():
            self._add_first_chunk(channel, time_ns, chunk)

    def _add_first_chunk(self, channel: int, time_ns: int, chunk: tuple[int, int, int]) -> None:
        self._first_chunks[channel] = min((time_ns, chunk), self._first_chunks.get(channel, (time_ns, chunk)))

    def _is_khep_twin(self) -> bool:
        """Return whether khep_twin wrote the file, by its header."""
        offset = len(MCAP0_MAGIC)
        opcode, size = HEAD.unpack(self._read_bytes(offset, HEAD.size))
        header = parse_record(opcode, self._read_content(offset, size)) if opcode == Opcode.HEADER else None
        return isinstance(header, Header) and header.library.startswith("khep_twin ")

    def _read_chunk(self, offset: int, length: int) -> bytes:
        """Return the decompressed records of a chunk."""
        self._check_head(offset, length, Opcode.CHUNK, "a chunk")
        record = self._read_bytes(offset, length)
        head = RecordBytes(record).read_chunk_head(0)
        if head is None:
            raise DecodeError(f"chunk at byte {offset}", "one that is packed with zstd or lz4, or not at all")
        size, crc, compression, start, end = head
        if size > LARGEST_CHUNK:
            raise DecodeError(f"chunk at byte {offset} unpacks to {size} bytes", f"at most {LARGEST_CHUNK}")
        self._unpacked_size += size
        if self._unpacked_size > (limit := SLACK + LARGEST_RATIO * self._size):
            raise DecodeError(f"chunks unpack to {self._unpacked_size} bytes and more", f"at most {limit}")
        records = decompress(compression, record[start:end], size)
        if end != len(record) or len(records) != size or (crc and zlib.crc32(records) != crc):
            raise DecodeError(f"chunk at byte {offset}", "one that holds what its size and checksum say")
        return records

    def _read_records(self, opcode: Opcode) -> Iterator[tuple[int, bytes]]:
        """Yield offsets and contents of the records with an opcode."""
        self._find_locations()
        for offset, length in self._locations[opcode]:
            self._check_head(offset, length, opcode, f"record {opcode:d}")
            yield offset, self._read_content(offset, length - HEAD.size)

    def _check_head(self, offset: int, length: int, opcode: Opcode, record_name: str) -> None:
        """Check that the record at an offset is the one named by the index."""
        actual_opcode, size = HEAD.unpack(self._read_bytes(offset, HEAD.size))
        if actual_opcode != opcode or HEAD.size + size != length:
            actual = f"record {actual_opcode} of {HEAD.size + size} bytes at byte {offset}"
            raise DecodeError(actual, f"{record_name} of {length}, as the index says")

    def _iterate_heads(self, offset: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, offset and content length of the records from `offset` to `end`."""
        while offset < end:
            opcode, size = HEAD.unpack(self._read_bytes(offset, HEAD.size))
            if size > end - offset - HEAD.size:
                actual = f"record {opcode} of {size} bytes at byte {offset}"
                available = max(end - offset - HEAD.size, 0)
                raise DecodeError(actual, f"at most the {available} bytes that are there")
            yield opcode, offset, size
            offset += HEAD.size + size

    def _read_content(self, offset: int, size: int) -> bytes:
        return self._read_bytes(offset + HEAD.size, size)

    def _read_bytes(self, offset: int, size: int) -> bytes:
        """Read `size` bytes of the file."""
        if size > LARGEST_RECORD:
            raise DecodeError(f"record of {size} bytes at byte {offset}", f"at most {LARGEST_RECORD}")
        self._file.seek(offset)
        data = self._file.read(size)
        if len(data) < size:
            raise DecodeError(f"end of the file at byte {offset + len(data)}", f"{size} bytes at {offset}")
        return data


def _find_last(entries: Sequence[Entry], topic: str, time_ns: int) -> int | None:
    """Return the row of the last of `entries` with a topic up to a time [ns]; None if there is none."""
    for index in reversed(range(len(entries))):
        if entries[index].topic == topic and entries[index].time_ns <= time_ns:
            return index
    return None


def _count_messages(content: bytes, offset: int, n_channels: int) -> int:
    """Return the number of messages of a chunk, from the size of the message indexes in its chunk index."""
    size = int.from_bytes(content[offset : offset + 8], "little")
    return max(size - n_channels * INDEX_OVERHEAD, 0) // ENTRY_BYTES


def _check_indexed(indexed: Sequence[tuple[int, ...]], actual: Sequence[tuple[int, ...]]) -> None:
    """Check that each indexed record (offset, length) is among the actual ones."""
    for offset, length in sorted({*indexed}.difference(actual)):
        raise DecodeError(f"record at byte {offset} of {length} bytes in the index", "one that is there")


def _unpack(layout: struct.Struct, content: bytes, offset: int) -> tuple[int, ...]:
    if len(content) < layout.size:
        raise DecodeError(f"record of {len(content)} bytes at byte {offset}", f"at least {layout.size}")
    return layout.unpack_from(content)
