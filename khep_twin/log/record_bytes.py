"""Records of an MCAP file as bytes: their extent, their content, and whether they are valid.

A length is used only after a check that its bytes exist.
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

HEAD = struct.Struct("<BQ")  # of a record: opcode, length of the content [bytes]
_CHUNK_HEAD = struct.Struct("<QQQI")  # start [ns], end [ns], decompressed size [bytes], checksum
MESSAGE = struct.Struct("<HIQQ")  # channel ID, sequence number, log time [ns], publish time [ns]
_PARSE_ERRORS = (McapError, struct.error, ValueError, EOFError, LookupError, OverflowError, MemoryError)
LARGEST_RATIO = 200
"""Maximum ratio of decompressed content to file size, besides `SLACK`; in khep_twin's logs it is below 40."""

SLACK = 4 << 20
"""Decompressed content that is accepted for a log of any size [bytes]."""

_BLOCK_BYTES = 1 << 16
_LZ4 = b"\x04\x22\x4d\x18"  # magic number of an lz4 frame

_ZSTD_HEADER = 18
"""Largest header of a zstandard frame [bytes]."""

_EXAMINED_PER_BYTE = 20
"""Maximum number of bytes examined per byte of a file to verify records."""

LARGEST_CHUNK = 64 << 20
"""Largest decompressed chunk [bytes]; khep_twin starts a new one at a quarter of it."""

_RECORD_START = re.compile(rb"(?=[\x01\x03-\x0f].{5}\x00\x00\x00)", re.DOTALL)
"""Opcode and upper bytes of a length, at the possible start of a record."""

RECORD_PARSERS: Mapping[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.METADATA: Metadata.read,
}
_ALL_PARSERS = {**RECORD_PARSERS, Opcode.ATTACHMENT: Attachment.read, Opcode.STATISTICS: Statistics.read}

INDEX_OPCODES = {
    Opcode.MESSAGE_INDEX,
    Opcode.DATA_END,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}
"""Opcodes of records that only index others, or end a section."""


class RecordBytes:
    """Bytes of a file with access to the record at an offset."""

    def __init__(self, data: bytes | mmap) -> None:
        self._data = data
        self._n_examined = 0

    def next_record(self, offset: int) -> int | None:
        """Return the offset of the next verified record, None if the search limit is reached."""
        limit = LARGEST_CHUNK + _EXAMINED_PER_BYTE * len(self._data)
        for match in _RECORD_START.finditer(self._data, offset):
            if self._n_examined > limit:
                return None
            if self.is_record(match.start()):
                return match.start()
        return None

    def read_head(self, offset: int) -> tuple[int, int | None]:
        """Return the opcode and the end of a record; None if the end is not in the file."""
        if offset < 0 or offset + HEAD.size > len(self._data):
            return self._data[offset] if 0 <= offset < len(self._data) else 0, None
        opcode, length = HEAD.unpack_from(self._data, offset)
        end = offset + HEAD.size + length
        return opcode, end if end <= len(self._data) else None

    def read_chunk_head(self, offset: int) -> tuple[int, int, str, int, int] | None:
        """Return decompressed size, checksum and compression, and start and end of the compressed bytes."""
        start = offset + HEAD.size
        try:
            _, _, size, crc = _CHUNK_HEAD.unpack_from(self._data, start)
            (length,) = struct.unpack_from("<I", self._data, start + _CHUNK_HEAD.size)
            name_start = start + _CHUNK_HEAD.size + 4
            compression = self._data[name_start : name_start + min(length, 5)].decode("latin-1")
            (compressed_size,) = struct.unpack_from("<Q", self._data, name_start + min(length, 5))
        except struct.error:
            return None
        if compression not in ("", "lz4", "zstd"):
            return None
        data_start = name_start + len(compression) + 8
        return size, crc, compression, data_start, data_start + compressed_size

    def read_chunk(self, offset: int) -> bytes | None:
        """Return the records in a chunk; None if a length or the checksum does not match."""
        head = self.read_chunk_head(offset)
        if head is None:
            return None
        size, crc, compression, start, end = head
        if (
            size > LARGEST_CHUNK
            or end != self.read_head(offset)[1]
            or not self._matches_header(compression, start, end, size)
        ):
            return None
        records = decompress(compression, self._data[start:end], size)
        if len(records) == size and (not crc or zlib.crc32(records) == crc):
            return records
        self._n_examined += end - start + len(records)
        return None

    def _matches_header(self, compression: str, start: int, end: int, size: int) -> bool:
        """Return whether the header of compressed bytes matches a decompressed size; a cheap test."""
        if not compression:
            return end - start == size
        if compression == "lz4":
            return self._data[start : start + len(_LZ4)] == _LZ4
        try:
            header = self._data[start : min(start + _ZSTD_HEADER, end)]
            content_size = zstandard.get_frame_parameters(header).content_size
        except zstandard.ZstdError:
            return False
        return content_size in (size, zstandard.CONTENTSIZE_UNKNOWN)

    def read_attachment(self, offset: int, end: int) -> Attachment | None:
        """Return an attachment; one that fails its checksum is named damaged/NAME."""
        content = self._data[offset + HEAD.size : end]
        self._n_examined += len(content)
        try:
            attachment = Attachment.read(ReadDataStream(BytesIO(content)))
        except _PARSE_ERRORS:
            return None
        if zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little"):
            return attachment
        return replace(attachment, name=f"damaged/{attachment.name}")

    def is_record(self, offset: int) -> bool:
        """Return whether the record at an offset can be verified by more than its opcode."""
        opcode, end = self.read_head(offset)
        if end is None:
            return False
        if opcode == Opcode.CHUNK:
            return self.read_chunk(offset) is not None
        if opcode == Opcode.ATTACHMENT:
            attachment = self.read_attachment(offset, end)
            return attachment is not None and not attachment.name.startswith("damaged/")
        self._n_examined += end - offset
        if opcode in RECORD_PARSERS and parse_record(opcode, self._data[offset + HEAD.size : end]) is None:
            return False
        if opcode not in RECORD_PARSERS and opcode not in INDEX_OPCODES and opcode != Opcode.MESSAGE:
            return False
        next_opcode, next_end = self.read_head(end)
        is_known = next_opcode in {*RECORD_PARSERS, *INDEX_OPCODES, Opcode.CHUNK, Opcode.MESSAGE}
        return end == len(self._data) or (is_known and next_end is not None)


def parse_record(opcode: int, content: bytes) -> McapRecord | None:
    """Parse a record of exactly these bytes, with printable names; return None if they are invalid."""
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _ALL_PARSERS[opcode](stream)
    except _PARSE_ERRORS:
        return None
    if stream.count != len(content):
        return None
    # rerun terminates the process at a name with a zero byte.
    name = record.name if isinstance(record, Schema) else record.topic if isinstance(record, Channel) else ""
    return record if name.isprintable() else None


def iterate_records(data: bytes) -> Generator[tuple[int, int, int], None, None]:
    """Yield opcode, start and end of the content of consecutive complete records."""
    offset, size, unpack, head_size = 0, len(data), HEAD.unpack_from, HEAD.size
    while offset + head_size <= size:
        opcode, length = unpack(data, offset)
        start = offset + head_size
        offset = start + length
        if offset > size:
            return
        yield opcode, start, offset


def decompress(compression: str, compressed: bytes, limit: int) -> bytes:
    """Return at most `limit` + 1 bytes of the decompressed data; damage ends them early."""
    limit = min(limit, LARGEST_CHUNK) + 1
    if not compression:
        return compressed[:limit]
    if compression == "lz4":
        try:
            return LZ4FrameDecompressor().decompress(compressed, max_length=limit)
        except (RuntimeError, MemoryError):
            return b""
    blocks: list[bytes] = []
    size = 0
    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
    with decompressor.stream_reader(compressed) as stream:
        while size < limit:
            try:
                block = stream.read(min(_BLOCK_BYTES, limit - size))
            except (zstandard.ZstdError, MemoryError):
                break
            if not block:
                break
            blocks.append(block)
            size += len(block)
    return b"".join(blocks)
