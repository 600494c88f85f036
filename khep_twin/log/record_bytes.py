"""The records of an MCAP file as bytes: where one ends, what is in it, and whether it is one at all.

No length is believed before the bytes are there.
"""

# lz4 is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

import re
import struct
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import replace
from heapq import merge
from io import BytesIO
from itertools import groupby
from mmap import mmap

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, McapRecord, MessageIndex, Metadata, Schema, Statistics

HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
MESSAGE = struct.Struct("<HIQQ")
_DAMAGE = (McapError, struct.error, ValueError, EOFError, LookupError, OverflowError, MemoryError)
LARGEST_RATIO = 200
"""Most that a log unpacks to, in sizes of its file, besides `SLACK`; of khep_twin's it is less than 40."""

SLACK = 4 << 20
"""So much a log of any size may unpack to [bytes]."""

_PIECE = 1 << 16
_LZ4 = b"\x04\x22\x4d\x18"
"""Beginning of an lz4 frame."""

_FRAME = 18
"""Most that the head of a zstandard frame takes [bytes]."""

_PATIENCE = 20
"""So many bytes are looked at for each byte of a file, at most, to prove where records are."""

LARGEST_CHUNK = 64 << 20
"""Most that a chunk unpacks to [bytes]; khep_twin begins another one at a quarter of it."""

_START = re.compile(rb"(?=[\x01\x03-\x0f].{5}\x00\x00\x00)", re.DOTALL)
"""Opcode and the upper bytes of a length, where a record may begin."""

_PACKED = re.compile(rb"(?=\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4)")
"""In the middle of a chunk's head."""

READERS: Mapping[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.METADATA: Metadata.read,
}
_READERS = {**READERS, Opcode.ATTACHMENT: Attachment.read, Opcode.STATISTICS: Statistics.read}

PLACES = {
    Opcode.MESSAGE_INDEX,
    Opcode.DATA_END,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}
"""Records that say only where others are."""


class RecordBytes:
    """A file, asked for the record at a place.

    Args:
        data: the file.
    """

    def __init__(self, data: bytes | mmap) -> None:
        self._data = data
        self._spent = 0

    def next_record(self, place: int) -> int | None:
        """The first place from here on at which a record can be proved, as long as there is patience left."""
        limit = LARGEST_CHUNK + _PATIENCE * len(self._data)
        for start in self._starts(place):
            if self._spent > limit:
                return None
            if self.is_record(start):
                return start
        return None

    def head(self, place: int) -> tuple[int, int | None]:
        """Opcode of a record and where it ends, None if that is not in the file."""
        if place < 0 or place + HEAD.size > len(self._data):
            return self._data[place] if 0 <= place < len(self._data) else 0, None
        opcode, length = HEAD.unpack_from(self._data, place)
        end = place + HEAD.size + length
        return opcode, end if end <= len(self._data) else None

    def chunk_head(self, place: int) -> tuple[int, int, str, int, int] | None:
        """Unpacked size and checksum, compression, where the packed bytes begin and where they end."""
        start = place + HEAD.size
        try:
            _, _, size, crc = _CHUNK_HEAD.unpack_from(self._data, start)
            (length,) = struct.unpack_from("<I", self._data, start + _CHUNK_HEAD.size)
            name = start + _CHUNK_HEAD.size + 4
            compression = self._data[name : name + min(length, 5)].decode("latin-1")
            (packed,) = struct.unpack_from("<Q", self._data, name + min(length, 5))
        except struct.error:
            return None
        if compression not in ("", "lz4", "zstd"):
            return None
        first = name + len(compression) + 8
        return size, crc, compression, first, first + packed

    def chunk(self, place: int) -> tuple[bytes | None, int | None]:
        """The records in a chunk and where it ends, by either of the two lengths that it has."""
        found = self.chunk_head(place)
        if found is None:
            return None, None
        size, crc, compression, start, inner = found
        if size > LARGEST_CHUNK:
            return None, None
        for end in dict.fromkeys((self.head(place)[1], inner)):
            if (
                end is not None
                and start <= end <= len(self._data)
                and self._may_be(compression, start, end, size)
            ):
                records = unpacked(compression, self._data[start:end], size)
                if len(records) == size and (not crc or zlib.crc32(records) == crc):
                    return records, end
                self._spent += end - start + len(records)
        return None, None

    def _may_be(self, compression: str, start: int, end: int, size: int) -> bool:
        """Whether packed bytes say of themselves that they unpack to so many; costs nothing."""
        if not compression:
            return end - start == size
        if compression == "lz4":
            return self._data[start : start + len(_LZ4)] == _LZ4
        try:
            says = zstandard.get_frame_parameters(self._data[start : min(start + _FRAME, end)]).content_size
        except zstandard.ZstdError:
            return False
        return says in (size, zstandard.CONTENTSIZE_UNKNOWN)

    def attachment(self, place: int, end: int) -> Attachment | None:
        """An attachment; one that fails its checksum is called damaged/NAME."""
        content = self._data[place + HEAD.size : end]
        self._spent += len(content)
        try:
            attachment = Attachment.read(ReadDataStream(BytesIO(content)))
        except _DAMAGE:
            return None
        if zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little"):
            return attachment
        return replace(attachment, name=f"damaged/{attachment.name}")

    def _starts(self, place: int) -> Iterator[int]:
        """Where a record may begin, from a place on; looked for one by one."""
        data = self._data
        before_name = HEAD.size + _CHUNK_HEAD.size
        starts = (match.start() for match in _START.finditer(data, place))
        chunks = (match.start() - before_name for match in _PACKED.finditer(data, place + before_name))
        return (start for start, _ in groupby(merge(starts, chunks)))

    def is_record(self, place: int) -> bool:
        """Whether a record at a place is proved by more than its opcode."""
        if self.chunk(place)[0] is not None:
            return True
        opcode, end = self.head(place)
        if end is None or opcode == Opcode.CHUNK:
            return False
        if opcode == Opcode.ATTACHMENT:
            found = self.attachment(place, end)
            return found is not None and not found.name.startswith("damaged/")
        self._spent += end - place
        if opcode in READERS and parsed(opcode, self._data[place + HEAD.size : end]) is None:
            return False
        if opcode not in READERS and opcode not in PLACES and opcode != Opcode.MESSAGE:
            return False
        following, after = self.head(end)
        known = following in READERS or following in PLACES or following in (Opcode.CHUNK, Opcode.MESSAGE)
        return end == len(self._data) or (known and after is not None)


def parsed(opcode: int, content: bytes) -> McapRecord | None:
    """A record of exactly these bytes; None if they are none."""
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _READERS[opcode](stream)
    except _DAMAGE:
        return None
    return record if stream.count == len(content) else None


def records_in(data: bytes) -> Generator[tuple[int, int, int], None, None]:
    """Opcode and content, from where to where, of the whole records that follow each other."""
    place = 0
    while place + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, place)
        start = place + HEAD.size
        place = start + length
        if place > len(data):
            return
        yield opcode, start, place


def unpacked(compression: str, packed: bytes, limit: int) -> bytes:
    """As much as can be unpacked, at most one byte more than `limit`, which itself is bounded."""
    limit = min(limit, LARGEST_CHUNK) + 1
    if not compression:
        return packed[:limit]
    if compression == "lz4":
        try:
            return LZ4FrameDecompressor().decompress(packed, max_length=limit)
        except (RuntimeError, MemoryError):
            return b""
    pieces: list[bytes] = []
    size = 0
    unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
    with unpacker.stream_reader(packed) as stream:
        while size < limit:
            try:
                piece = stream.read(min(_PIECE, limit - size))
            except (zstandard.ZstdError, MemoryError):
                break
            if not piece:
                break
            pieces.append(piece)
            size += len(piece)
    return b"".join(pieces)
