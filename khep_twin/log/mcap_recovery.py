"""Recovery of intact records from the bytes of a damaged MCAP file.

The file is read record by record. After an invalid record, the next verifiable one is searched: a record is
verified by its checksum, or by parsing to its last byte with another record after it.

A chunk truncated by the end of the file is decompressed as far as possible. A chunk with damage in the middle
fails its checksum and is skipped, as its valid values cannot be distinguished from invalid ones.
"""

from collections.abc import Callable, Generator
from mmap import mmap

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.record_bytes import (
    HEAD,
    INDEX_OPCODES,
    LARGEST_CHUNK,
    LARGEST_RATIO,
    MESSAGE,
    RECORD_PARSERS,
    SLACK,
    RecordBytes,
    decompress,
    iterate_records,
    parse_record,
)

_CHUNK_OPCODES = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)

Progress = Callable[[float], None] | None
"""Function that takes the completed fraction, 0 to 1."""


def partial_progress(progress: Progress, index: int, count: int) -> Progress:
    """Return a function that takes the progress of one of `count` parts."""
    return None if progress is None else lambda share: progress((index + share) / count)


class IntactRecords:
    """Intact records of a file that may be damaged.

    Args:
        data: Content of the file.
        progress: Function that takes the searched fraction of the file, 0 to 1.

    Attributes:
        header: Header of the file.
        schemas: Schemas by number.
        channels: Channels by number.
        attachments: Attachments; those that fail their checksum are named damaged/NAME.
        metadata: Metadata records of the run.
        n_damaged: Number of parts that could not be read.
        is_truncated: True if the end of the file cuts off a record with content.
    """

    def __init__(self, data: bytes | mmap, progress: Progress = None) -> None:
        self._data = data
        self._progress = progress
        self._bytes = RecordBytes(data)
        self.header = Header("", "")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: list[Attachment] = []
        self.metadata: list[Metadata] = []
        self.n_damaged = 0
        self.is_truncated = False
        self._message_sources: list[int | bytes] = []  # offset of a chunk, or records
        self._unpacked_size = 0
        # A few wrong bytes in the magic number are ordinary damage.
        if sum(a == b for a, b in zip(data[: len(MCAP0_MAGIC)], MCAP0_MAGIC, strict=False)) >= 5:
            self._scan()

    def messages(self, progress: Progress = None) -> Generator[Message, None, None]:
        """Yield the messages of known channels in the order of the file; `progress` as for the class."""
        for number, source in enumerate(self._message_sources):
            if progress is not None:
                progress(number / len(self._message_sources))
            records = (source if isinstance(source, bytes) else self._bytes.read_chunk(source)) or b""
            for opcode, start, end in iterate_records(records):
                if opcode not in _CHUNK_OPCODES:
                    break
                if opcode == Opcode.MESSAGE and end - start >= MESSAGE.size:
                    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(records, start)
                    if channel in self.channels:
                        data = records[start + MESSAGE.size : end]
                        yield Message(channel, log_time, data, publish_time, sequence)

    def _scan(self) -> None:
        """Store all intact records of the file."""
        offset = len(MCAP0_MAGIC)
        if self._data[:offset] != MCAP0_MAGIC:
            self.n_damaged += 1
        while offset < len(self._data):
            if self._data[offset : offset + len(MCAP0_MAGIC)] == MCAP0_MAGIC:
                return
            if self._progress is not None:
                self._progress(offset / len(self._data))
            end = self._add_record(offset)
            if end is None:
                if self._recover_truncated(offset):
                    return
                self.n_damaged += 1
                end = self._bytes.next_record(offset + 1)
                if end is None:
                    return
            offset = end

    def _add_record(self, offset: int) -> int | None:
        """Store the content of the record at an offset; return its end, None if it is no valid record."""
        opcode, end = self._bytes.read_head(offset)
        if opcode == Opcode.CHUNK:
            records = self._bytes.read_chunk(offset)
            if records is None:
                return None
            self._unpacked_size += len(records)
            if self._unpacked_size > SLACK + LARGEST_RATIO * len(self._data):
                self.n_damaged += 1  # a decompression bomb, so the rest of the file is not used
                return len(self._data)
            self._add_definitions(records)
            self._message_sources.append(offset)
            return end
        if end is None:
            return None
        if opcode == Opcode.MESSAGE:
            self._message_sources.append(self._data[offset:end])
        elif opcode == Opcode.ATTACHMENT:
            attachment = self._bytes.read_attachment(offset, end)
            if attachment is None:
                return None
            self.attachments.append(attachment)
            self.n_damaged += attachment.name.startswith("damaged/")
        elif opcode in RECORD_PARSERS:
            return self._store(parse_record(opcode, self._data[offset + HEAD.size : end]), end)
        elif opcode not in INDEX_OPCODES:
            return None
        return end

    def _store(self, record: McapRecord | None, end: int) -> int | None:
        """Store a record that ends at `end`, and return `end`; None for an invalid record."""
        match record:
            case Header():
                self.header = record
            case Schema():
                self.schemas.setdefault(record.id, record)
            case Channel():
                self.channels.setdefault(record.id, record)
            case Metadata():
                self.metadata.append(record)
            case None:
                return None
            case _:
                pass
        return end

    def _add_definitions(self, records: bytes) -> None:
        for opcode, start, end in iterate_records(records):
            if opcode not in _CHUNK_OPCODES:
                break
            record = None if opcode == Opcode.MESSAGE else parse_record(opcode, records[start:end])
            if opcode != Opcode.MESSAGE and self._store(record, end) is None:
                break

    def _recover_truncated(self, offset: int) -> bool:
        """Return whether the file ends within the record at an offset; store the readable part."""
        data = self._data
        opcode, end = self._bytes.read_head(offset)
        if end is not None:
            return False
        if opcode in INDEX_OPCODES and len(data) - offset < HEAD.size:
            return True
        if opcode in INDEX_OPCODES:
            # An index can be lost without loss of data, if it is one and not a wrong length.
            return self._bytes.next_record(offset + 1) is None
        if opcode == Opcode.CHUNK and (head := self._bytes.read_chunk_head(offset)) is not None:
            size, _, compression, start, chunk_end = head
            if chunk_end != offset + HEAD.size + HEAD.unpack_from(data, offset)[1]:
                return False
            records = decompress(compression, data[start : start + LARGEST_CHUNK], size)
            self._add_definitions(records)
            self._message_sources.append(records)
        elif self._bytes.next_record(offset + 1) is not None:
            return False
        self.is_truncated = True
        return True
