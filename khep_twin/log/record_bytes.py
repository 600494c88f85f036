"""Records of an MCAP file as bytes: their extent, their content, and whether they are valid.

No length is used before the bytes are known to be there.
"""

# lz4 is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

import re
import struct
import zlib
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from io import BytesIO
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
"""Largest ratio of a log's unpacked content to its file's size, besides `SLACK`; khep_twin's are below 40."""

SLACK = 4 << 20
"""Unpacked content that is accepted for a log of any size [bytes]."""

_PIECE = 1 << 16
_LZ4 = b"\x04\x22\x4d\x18"
"""Magic number of an lz4 frame."""

_FRAME = 18
"""Largest header of a zstandard frame [bytes]."""

_EXAMINED_PER_BYTE = 20
"""Most bytes that are examined for each byte of a file to verify records."""

LARGEST_CHUNK = 64 << 20
"""Largest unpacked chunk [bytes]; khep_twin begins another one at a quarter of it."""

_START = re.compile(rb"(?=[\x01\x03-\x0f].{5}\x00\x00\x00)", re.DOTALL)
"""Opcode and the upper bytes of a length, where a record may begin."""

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
"""Records that only point to others."""


class RecordBytes:
    """Content of a file with access to the record at an offset."""

    def __init__(self, data: bytes | mmap) -> None:
        self._data = data
        self._spent = 0

    def next_record(self, offset: int) -> int | None:
        """Return the offset of the next verified record, None if the search limit is reached."""
        limit = LARGEST_CHUNK + _EXAMINED_PER_BYTE * len(self._data)
        for match in _START.finditer(self._data, offset):
            if self._spent > limit:
                return None
            if self.is_record(match.start()):
                return match.start()
        return None

    def head(self, offset: int) -> tuple[int, int | None]:
        """Return the opcode of a record and its end, None if that is not in the file."""
        if offset < 0 or offset + HEAD.size > len(self._data):
            return self._data[offset] if 0 <= offset < len(self._data) else 0, None
        opcode, length = HEAD.unpack_from(self._data, offset)
        end = offset + HEAD.size + length
        return opcode, end if end <= len(self._data) else None

    def chunk_head(self, offset: int) -> tuple[int, int, str, int, int] | None:
        """Return unpacked size, checksum and compression, and begin and end of the packed bytes."""
        start = offset + HEAD.size
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

    def chunk(self, offset: int) -> bytes | None:
        """Return the records in a chunk; None if its lengths differ or its checksum is another."""
        found = self.chunk_head(offset)
        if found is None:
            return None
        size, crc, compression, start, end = found
        if (
            size > LARGEST_CHUNK
            or end != self.head(offset)[1]
            or not self._may_be(compression, start, end, size)
        ):
            return None
        records = unpacked(compression, self._data[start:end], size)
        if len(records) == size and (not crc or zlib.crc32(records) == crc):
            return records
        self._spent += end - start + len(records)
        return None

    def _may_be(self, compression: str, start: int, end: int, size: int) -> bool:
        """Return whether the header of packed bytes states this unpacked size; a cheap test."""
        if not compression:
            return end - start == size
        if compression == "lz4":
            return self._data[start : start + len(_LZ4)] == _LZ4
        try:
            says = zstandard.get_frame_parameters(self._data[start : min(start + _FRAME, end)]).content_size
        except zstandard.ZstdError:
            return False
        return says in (size, zstandard.CONTENTSIZE_UNKNOWN)

    def attachment(self, offset: int, end: int) -> Attachment | None:
        """Return an attachment; one that fails its checksum is named damaged/NAME."""
        content = self._data[offset + HEAD.size : end]
        self._spent += len(content)
        try:
            attachment = Attachment.read(ReadDataStream(BytesIO(content)))
        except _DAMAGE:
            return None
        if zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little"):
            return attachment
        return replace(attachment, name=f"damaged/{attachment.name}")

    def is_record(self, offset: int) -> bool:
        """Return whether a record at an offset is verified by more than its opcode."""
        opcode, end = self.head(offset)
        if end is None:
            return False
        if opcode == Opcode.CHUNK:
            return self.chunk(offset) is not None
        if opcode == Opcode.ATTACHMENT:
            found = self.attachment(offset, end)
            return found is not None and not found.name.startswith("damaged/")
        self._spent += end - offset
        if opcode in READERS and parsed(opcode, self._data[offset + HEAD.size : end]) is None:
            return False
        if opcode not in READERS and opcode not in PLACES and opcode != Opcode.MESSAGE:
            return False
        following, after = self.head(end)
        known = following in READERS or following in PLACES or following in (Opcode.CHUNK, Opcode.MESSAGE)
        return end == len(self._data) or (known and after is not None)


def parsed(opcode: int, content: bytes) -> McapRecord | None:
    """Return the record of exactly these bytes, with printable names; None if they are none."""
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _READERS[opcode](stream)
    except _DAMAGE:
        return None
    if stream.count != len(content):
        return None
    # rerun ends the process at a name with a zero byte.
    name = record.name if isinstance(record, Schema) else record.topic if isinstance(record, Channel) else ""
    return record if name.isprintable() else None


def records_in(data: bytes) -> Generator[tuple[int, int, int], None, None]:
    """Yield opcode, begin and end of the content of consecutive whole records."""
    offset = 0
    while offset + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, offset)
        start = offset + HEAD.size
        offset = start + length
        if offset > len(data):
            return
        yield opcode, start, offset


def unpacked(compression: str, packed: bytes, limit: int) -> bytes:
    """Unpack as much as possible, at most one byte more than `limit`, which itself is bounded."""
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
