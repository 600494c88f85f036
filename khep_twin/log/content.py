"""Records of a finished log's file, each within bounds: nothing that a file declares is used unchecked.

A size is compared with the bytes that are there before reading, and with a constant before unpacking.
The parts named by the index lie in the file and do not overlap, so that no byte is read twice.
"""

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata, Statistics
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.decoding import LATEST_NS, DecodeError
from khep_twin.log.entries import Entry, EntryReader
from khep_twin.log.record_bytes import (
    HEAD,
    LARGEST_CHUNK,
    LARGEST_RATIO,
    MESSAGE,
    SLACK,
    RecordBytes,
    parsed,
    unpacked,
)

LARGEST_RECORD = LARGEST_CHUNK
"""Largest record that is read, except a chunk's content, such as an attachment [bytes]."""

_FOOTER = struct.Struct("<QQI")
_CHUNK_PLACE = struct.Struct("<QQQQI")
_CHANNEL_PLACE = struct.Struct("<H8x")
_PLACE = struct.Struct("<QQ")


class Content:
    """Content of a finished log's file.

    Args:
        file: Open file.

    Raises:
        DecodeError: Here and in each method: it is no whole MCAP file, or exceeds a limit.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._unpacked = 0
        self._reader = EntryReader()
        self._end_ns: int | None = None
        self._count: int | None = None
        self._chunks: list[tuple[int, int, int]] = []
        self._first: dict[int, tuple[int, int, int]] = {}
        self._named: dict[int, list[tuple[int, int]]] = {Opcode.ATTACHMENT: [], Opcode.METADATA: []}
        self._end = self._size - len(MCAP0_MAGIC) - HEAD.size - _FOOTER.size
        self._indexed = self._read_summary()

    def messages(self) -> Iterator[Entry]:
        """Yield the messages in the order of the file."""
        return chain.from_iterable(entries for _, entries in self.chunks())

    def since(self, topic: str, time_ns: int) -> Iterator[list[Entry]]:
        """Yield the last message of a topic up to a time [ns], then those after it, chunk by chunk.

        Without such a message, yield none, and then all messages.
        """
        pieces = self._chunks if self._indexed else [(0, 0, 0)]
        early = (number for number, (start_ns, _, _) in enumerate(pieces) if start_ns <= time_ns)
        for number in reversed([*early] if self._reader.knows(topic) else []):
            held = [each for _, piece in self.chunks(pieces[number : number + 1]) for each in piece]
            if (place := _last(held, topic, time_ns)) is not None:
                yield [held[place]]
                yield held[place + 1 :]
                break
        else:
            yield []
            number = -1
        for _, entries in self.chunks(pieces[number + 1 :]):
            yield list(entries)

    def first_messages(self) -> Iterator[Entry]:
        """Yield the first message of each channel, from the chunks that have them by the index."""
        seen: set[str] = set()
        chunks = sorted(set(self._first.values())) or self._chunks
        for _, entries in self.chunks(chunks):
            for entry in sorted(entries, key=lambda each: each.time_ns):
                if entry.topic not in seen:
                    seen.add(entry.topic)
                    yield entry

    def pieces(self, length: int) -> Iterator[tuple[float, list[Entry]]]:
        """Yield the messages in parts of about `length` bytes and a chunk, none earlier than those before it.

        Each comes with the share of the log that has been read so far, 0 to 1.
        """
        held: list[Entry] = []
        size, count, split_ns = 0, 0, 0
        # A late reply alone may be a chunk, before one that begins earlier.
        for number, (start_ns, entries) in enumerate(self.chunks(sorted(self._chunks) or None)):
            if size > length and start_ns > split_ns:
                split_ns, size = start_ns, 0
                yield number / len(self._chunks), [each for each in held if each.time_ns < split_ns]
                held = [each for each in held if each.time_ns >= split_ns]
            for entry in entries:
                size += MESSAGE.size + len(entry.data)
                count += 1
                held.append(entry)
        if self._count is not None and count != self._count:
            raise DecodeError(f"{count} messages", f"{self._count}, as its statistics say")
        yield 1.0, held

    def attachments(self) -> Iterator[Attachment]:
        """Yield the attachments."""
        for offset, content in self._records(Opcode.ATTACHMENT):
            found = parsed(Opcode.ATTACHMENT, content)
            crc = int.from_bytes(content[-4:], "little")
            if not isinstance(found, Attachment) or (crc and zlib.crc32(content[:-4]) != crc):
                raise DecodeError(f"attachment at byte {offset}", "one that holds what its checksum says")
            yield found

    def metadata(self) -> Iterator[Metadata]:
        """Yield the metadata records."""
        for offset, content in self._records(Opcode.METADATA):
            found = parsed(Opcode.METADATA, content)
            if not isinstance(found, Metadata):
                raise DecodeError(f"metadata at byte {offset}", "texts of the lengths that they say")
            yield found

    def end_ns(self) -> int:
        """Return the time of the last message by the index [ns]."""
        if self._end_ns is None:
            raise DecodeError("no statistics", "them in the index")
        if self._end_ns > LATEST_NS:
            raise DecodeError(f"message_end_time = {self._end_ns} in the statistics", f"at most {LATEST_NS}")
        return self._end_ns

    def _read_summary(self) -> bool:
        """Read the index; return whether it lists chunks."""
        magic = len(MCAP0_MAGIC)
        if self._end < magic or self._bytes(0, magic) != MCAP0_MAGIC:
            raise DecodeError("no MCAP file", "one that begins and ends as such")
        if self._bytes(self._size - magic, magic) != MCAP0_MAGIC:
            raise DecodeError("no end", "a finished .mcap file")
        opcode, length = HEAD.unpack(self._bytes(self._end, HEAD.size))
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size):
            raise DecodeError(f"record {opcode} of {length} bytes at the end", "a footer")
        start, _, _ = _FOOTER.unpack(self._bytes(self._end + HEAD.size, _FOOTER.size))
        if start == 0:
            return False
        if not magic <= start <= self._end:
            raise DecodeError(f"index at byte {start}", f"it between {magic} and {self._end}")
        lengths: dict[int, int] = {}
        for opcode, offset, size in self._walk(start, self._end):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._reader.define(opcode, self._content(offset, size), offset)
                continue
            if opcode == Opcode.STATISTICS:
                statistics = parsed(opcode, self._content(offset, size))
                if not isinstance(statistics, Statistics):
                    raise DecodeError(f"definition at byte {offset}", "texts of the lengths that they say")
                self._end_ns, self._count = statistics.message_end_time, statistics.message_count
                continue
            if opcode == Opcode.CHUNK_INDEX:
                content = self._content(offset, size)
                start_ns, _, *named, channels = _numbers(_CHUNK_PLACE, content, offset)
                self._chunks.append(chunk := (start_ns, named[0], named[1]))
                if channels % _CHANNEL_PLACE.size or channels > len(content) - _CHUNK_PLACE.size:
                    raise DecodeError(
                        f"{channels} bytes of channels at byte {offset}", "those that are there"
                    )
                ids = _CHANNEL_PLACE.iter_unpack(content[_CHUNK_PLACE.size :][:channels])
                for (number,) in ids:
                    self._first[number] = min(chunk, self._first.get(number, chunk))
            elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
                named = _numbers(_PLACE, self._content(offset, size), offset)
                kind = Opcode.ATTACHMENT if opcode == Opcode.ATTACHMENT_INDEX else Opcode.METADATA
                self._named[kind].append((named[0], named[1]))
            else:
                continue
            if named[0] in lengths:
                raise DecodeError(f"record at byte {named[0]} named twice in the index", "each once")
            lengths[named[0]] = named[1]
        free = magic
        for offset, length in sorted(lengths.items()):
            if offset < free or offset + length > start:
                found = f"record at byte {offset} of {length} bytes in the index"
                raise DecodeError(found, f"it between {free} and {start}")
            free = offset + length
        self._chunks.sort(key=lambda chunk: chunk[1])
        return bool(self._chunks)

    def chunks(
        self, chunks: Sequence[tuple[int, int, int]] | None = None
    ) -> Iterator[tuple[int, Iterator[Entry]]]:
        """Yield the start [ns] and the messages of each chunk; by default of all, as the file has them."""
        if not self._indexed:
            if chunks is None or chunks:
                yield 0, self._unindexed()
            return
        for start_ns, offset, length in self._chunks if chunks is None else chunks:
            yield start_ns, self._reader.entries(self._chunk(offset, length), offset, start_ns)

    def _unindexed(self) -> Iterator[Entry]:
        for opcode, offset, size in self._walk(len(MCAP0_MAGIC), self._end):
            if opcode == Opcode.DATA_END:
                return
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._reader.define(opcode, self._content(offset, size), offset)
            elif opcode == Opcode.MESSAGE:
                yield self._reader.entry(self._content(offset, size), 0, size, offset)
            elif opcode == Opcode.CHUNK:
                yield from self._reader.entries(self._chunk(offset, HEAD.size + size), offset)

    def _chunk(self, offset: int, length: int) -> bytes:
        """Return the records of a chunk."""
        self._check_head(offset, length, Opcode.CHUNK, "a chunk")
        packed = self._bytes(offset, length)
        found = RecordBytes(packed).chunk_head(0)
        if found is None:
            raise DecodeError(f"chunk at byte {offset}", "one that is packed with zstd or lz4, or not at all")
        size, crc, compression, start, end = found
        if size > LARGEST_CHUNK:
            raise DecodeError(f"chunk at byte {offset} unpacks to {size} bytes", f"at most {LARGEST_CHUNK}")
        self._unpacked += size
        if self._unpacked > (limit := SLACK + LARGEST_RATIO * self._size):
            raise DecodeError(f"chunks unpack to {self._unpacked} bytes and more", f"at most {limit}")
        records = unpacked(compression, packed[start:end], size)
        if end != len(packed) or len(records) != size or (crc and zlib.crc32(records) != crc):
            raise DecodeError(f"chunk at byte {offset}", "one that holds what its size and checksum say")
        return records

    def _records(self, wanted: Opcode) -> Iterator[tuple[int, bytes]]:
        """Yield offsets and records of a kind, heads included."""
        if not self._indexed:
            for opcode, offset, size in self._walk(len(MCAP0_MAGIC), self._end):
                if opcode == wanted:
                    yield offset, self._content(offset, size)
                elif opcode == Opcode.DATA_END:
                    return
        for offset, length in self._named[wanted]:
            self._check_head(offset, length, wanted, f"record {wanted:d}")
            yield offset, self._content(offset, length - HEAD.size)

    def _check_head(self, offset: int, length: int, wanted: Opcode, name: str) -> None:
        """Check that the record at a place is the one that the index names."""
        opcode, size = HEAD.unpack(self._bytes(offset, HEAD.size))
        if opcode != wanted or HEAD.size + size != length:
            found = f"record {opcode} of {HEAD.size + size} bytes at byte {offset}"
            raise DecodeError(found, f"{name} of {length}, as the index says")

    def _walk(self, offset: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, offset and length of the content of consecutive records."""
        while offset < end:
            opcode, size = HEAD.unpack(self._bytes(offset, HEAD.size))
            if size > end - offset - HEAD.size:
                found = f"record {opcode} of {size} bytes at byte {offset}"
                raise DecodeError(
                    found, f"at most the {max(end - offset - HEAD.size, 0)} bytes that are there"
                )
            yield opcode, offset, size
            offset += HEAD.size + size

    def _content(self, offset: int, size: int) -> bytes:
        return self._bytes(offset + HEAD.size, size)

    def _bytes(self, offset: int, size: int) -> bytes:
        """Return `size` bytes of the file."""
        if size > LARGEST_RECORD:
            raise DecodeError(f"record of {size} bytes at byte {offset}", f"at most {LARGEST_RECORD}")
        self._file.seek(offset)
        data = self._file.read(size)
        if len(data) < size:
            raise DecodeError(f"end of the file at byte {offset + len(data)}", f"{size} bytes at {offset}")
        return data


def _last(entries: Sequence[Entry], topic: str, time_ns: int) -> int | None:
    """Return the place of the last message of a topic up to a time [ns]; None without one."""
    places = [place for place, each in enumerate(entries) if each.topic == topic and each.time_ns <= time_ns]
    return places[-1] if places else None


def _numbers(layout: struct.Struct, content: bytes, offset: int) -> tuple[int, ...]:
    if len(content) < layout.size:
        raise DecodeError(f"record of {len(content)} bytes at byte {offset}", f"at least {layout.size}")
    return layout.unpack_from(content)
