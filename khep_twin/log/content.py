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
from mcap.records import Attachment, Header, Metadata, Statistics
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.chunk_index import ENTRY_BYTES, INDEX_FRAME
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
    records_in,
    unpacked,
)

LARGEST_RECORD = LARGEST_CHUNK
"""Largest record that is read, except a chunk's content, such as an attachment [bytes]."""

_FOOTER = struct.Struct("<QQI")
_CHUNK_PLACE = struct.Struct("<QQQQI")
_CHANNEL_PLACE = struct.Struct("<H8x")
_PLACE = struct.Struct("<QQ")

_LOOSE = 4 << 20
"""Most bytes of messages outside chunks that are read together, besides a single one."""


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
        self._end_ns = 0
        self._count: int | None = None
        self._chunks: list[tuple[int, int, int]] = []
        self._loose: set[int] = set()
        self._first: dict[int, tuple[int, tuple[int, int, int]]] = {}
        self._named: dict[int, list[tuple[int, int]]] = {Opcode.ATTACHMENT: [], Opcode.METADATA: []}
        self._end = self._size - len(MCAP0_MAGIC) - HEAD.size - _FOOTER.size
        self._knows_chunks = self._knows_named = False
        self._times_ns: dict[int, int] = {}
        self._in_order = True
        self._read_summary()

    def messages(self) -> Iterator[Entry]:
        """Yield the messages in the order of the file."""
        return chain.from_iterable(entries for _, entries in self.chunks())

    def since(self, topic: str, time_ns: int) -> Iterator[list[Entry]]:
        """Yield the last message of a topic up to a time [ns], then those after it, chunk by chunk.

        Without such a message, yield none, and then all messages.
        """
        self._find_chunks()
        pieces = self._chunks if self._in_order else self._chunks[:1]
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
        self._find_chunks()
        seen: set[str] = set()
        chunks = sorted({chunk for _, chunk in self._first.values()})
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
        self._find_chunks()
        # A late reply alone may be a chunk, before one that begins earlier.
        for number, (start_ns, entries) in enumerate(self.chunks(sorted(self._chunks))):
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
        """Return the time of the last message [ns]."""
        self._find_chunks()
        if self._end_ns > LATEST_NS:
            raise DecodeError(f"message_end_time = {self._end_ns} in the statistics", f"at most {LATEST_NS}")
        return self._end_ns

    def _read_summary(self) -> None:
        """Read the index, and find whether it names all that the file has, by its statistics."""
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
            return
        if not magic <= start <= self._end:
            raise DecodeError(f"index at byte {start}", f"it between {magic} and {self._end}")
        lengths: dict[int, int] = {}
        found, n_messages, has_definitions = None, 0, True
        for opcode, offset, size in self._walk(start, self._end):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._reader.define(opcode, self._content(offset, size), offset)
                except DecodeError:
                    has_definitions = False
                continue
            if opcode == Opcode.STATISTICS:
                statistics = parsed(opcode, self._content(offset, size))
                if not isinstance(statistics, Statistics):
                    raise DecodeError(f"definition at byte {offset}", "texts of the lengths that they say")
                found = statistics
                continue
            if opcode == Opcode.CHUNK_INDEX:
                content = self._content(offset, size)
                start_ns, _, *named, channels = _numbers(_CHUNK_PLACE, content, offset)
                self._chunks.append(chunk := (start_ns, named[0], named[1]))
                if channels % _CHANNEL_PLACE.size or channels > len(content) - _CHUNK_PLACE.size:
                    raise DecodeError(
                        f"{channels} bytes of channels at byte {offset}", "those that are there"
                    )
                ids = [*_CHANNEL_PLACE.iter_unpack(content[_CHUNK_PLACE.size :][:channels])]
                for (number,) in ids:
                    self._first[number] = min((start_ns, chunk), self._first.get(number, (start_ns, chunk)))
                n_messages += _indexed(content, _CHUNK_PLACE.size + channels, len(ids))
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
        if found is None:
            return
        self._end_ns, self._count = found.message_end_time, found.message_count
        counted = found.chunk_count, found.message_count, found.channel_count
        is_whole = has_definitions and (len(self._chunks), n_messages, self._reader.n_channels) == counted
        # What other tools wrote may also be in another order, which only its messages tell.
        self._knows_chunks = self._is_own() and is_whole
        n_named = found.attachment_count, found.metadata_count
        self._knows_named = tuple(map(len, self._named.values())) == n_named

    def chunks(
        self, chunks: Sequence[tuple[int, int, int]] | None = None
    ) -> Iterator[tuple[int, Iterator[Entry]]]:
        """Yield the start [ns] and the messages of each chunk; by default of all, as the file has them."""
        self._find_chunks()
        if not self._in_order:
            if chunks is None or chunks:
                parts = chain.from_iterable(self._entries(each) for each in self._chunks)
                yield 0, iter(sorted(parts, key=lambda each: (each.time_ns, each.topic)))
            return
        for chunk in self._chunks if chunks is None else chunks:
            yield chunk[0], self._entries(chunk)

    def _entries(self, chunk: tuple[int, int, int]) -> Iterator[Entry]:
        start_ns, offset, length = chunk
        read = self._bytes if offset in self._loose else self._chunk
        return self._reader.entries(read(offset, length), offset, start_ns)

    def _find_chunks(self) -> None:
        """Find all chunks, if the index may leave some out: MCAP requires none of it.

        Messages outside chunks are read in parts of consecutive records, as if each was a chunk. Those of a
        file of another tool in which a channel goes back in time are read in order of time, as one chunk.
        """
        if self._knows_chunks:
            return
        named, self._chunks, self._first, self._end_ns = self._chunks, [], {}, 0
        begin = end = 0
        for opcode, offset, size in self._data():
            after = offset + HEAD.size + size
            is_loose = opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
            if end > begin and not (is_loose and after - begin <= _LOOSE):
                self._loose.add(begin)
                self._note(begin, end - begin, self._bytes(begin, end - begin))
                begin = end
            if is_loose:
                begin, end = (begin if end == offset and begin < end else offset), after
            elif opcode == Opcode.CHUNK:
                self._note(offset, after - offset, self._chunk(offset, after - offset))
        _check_found([each[1:] for each in named], [each[1:] for each in self._chunks])
        self._knows_chunks = True
        self._in_order = self._in_order or self._is_own()
        # It is unpacked again when it is read.
        self._unpacked = 0

    def _find_named(self) -> None:
        """Find all attachments and metadata, if the index may leave some out."""
        if self._knows_named:
            return
        named = self._named
        self._named = {opcode: list[tuple[int, int]]() for opcode in named}
        for opcode, offset, size in self._data():
            if opcode in named:
                self._named[opcode].append((offset, HEAD.size + size))
        for opcode, places in named.items():
            _check_found(places, self._named[opcode])
        self._knows_named = True

    def _data(self) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, offset and length of the content of all records of the data, up to its end."""
        for record in self._walk(len(MCAP0_MAGIC), self._end):
            yield record
            if record[0] == Opcode.DATA_END:
                return
        yield Opcode.DATA_END, self._end, 0

    def _note(self, offset: int, length: int, records: bytes) -> None:
        """Note the times and channels of a chunk's messages, and its definitions."""
        first: dict[int, int] = {}
        for opcode, start, end in records_in(records):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._reader.define(opcode, records[start:end], offset)
            elif opcode == Opcode.MESSAGE and end - start >= MESSAGE.size:
                number, _, time_ns, _ = MESSAGE.unpack_from(records, start)
                first[number] = min(time_ns, first.get(number, time_ns))
                self._end_ns = max(self._end_ns, time_ns)
                self._in_order &= time_ns >= self._times_ns.get(number, 0)
                self._times_ns[number] = time_ns
        chunk = min(first.values(), default=0), offset, length
        self._chunks.append(chunk)
        for number, time_ns in first.items():
            self._first[number] = min((time_ns, chunk), self._first.get(number, (time_ns, chunk)))

    def _is_own(self) -> bool:
        """Return whether khep_twin has written the file, by its header."""
        place = len(MCAP0_MAGIC)
        opcode, size = HEAD.unpack(self._bytes(place, HEAD.size))
        header = parsed(opcode, self._content(place, size)) if opcode == Opcode.HEADER else None
        return isinstance(header, Header) and header.library.startswith("khep_twin ")

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
        self._find_named()
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


def _indexed(content: bytes, place: int, n_channels: int) -> int:
    """Return the number of messages of a chunk, of which its index has the size of their indexes."""
    size = int.from_bytes(content[place : place + 8], "little")
    return max(size - n_channels * INDEX_FRAME, 0) // ENTRY_BYTES


def _check_found(named: Sequence[tuple[int, ...]], found: Sequence[tuple[int, ...]]) -> None:
    """Refuse an index that names a record that is not there."""
    for offset, length in sorted({*named}.difference(found)):
        raise DecodeError(f"record at byte {offset} of {length} bytes in the index", "one that is there")


def _numbers(layout: struct.Struct, content: bytes, offset: int) -> tuple[int, ...]:
    if len(content) < layout.size:
        raise DecodeError(f"record of {len(content)} bytes at byte {offset}", f"at least {layout.size}")
    return layout.unpack_from(content)
