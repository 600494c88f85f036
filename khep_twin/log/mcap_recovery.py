"""Recovery of whole records from the bytes of a damaged MCAP file.

The file is read record by record. After an invalid one, the next offset is searched at which a record can be
verified: by its checksum, or by parsing to its last byte with another record after it.

A chunk that the end of the file cuts off is unpacked as far as possible. One damaged in the middle fails its
checksum and is left out as a whole, as its valid values cannot be distinguished from invalid ones.
"""

from collections.abc import Callable, Generator
from mmap import mmap

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.record_bytes import (
    HEAD,
    LARGEST_CHUNK,
    LARGEST_RATIO,
    MESSAGE,
    PLACES,
    READERS,
    SLACK,
    RecordBytes,
    parsed,
    records_in,
    unpacked,
)

_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


Progress = Callable[[float], None] | None
"""Function that takes the share that is done, 0 to 1."""


class WholeRecords:
    """Whole records of a file that may be damaged.

    Args:
        data: Content of the file.
        progress: Function that takes the share of the file that has been searched, 0 to 1.

    Attributes:
        header: Header of the file.
        schemas: Schemas by number.
        channels: Channels by number.
        attachments: Attachments; those that fail their checksum are named damaged/NAME.
        metadata: Metadata records of the run.
        damaged: Number of parts that could not be read.
        torn: True if the end of the file cuts off a record with content.
    """

    def __init__(self, data: bytes | mmap, progress: Progress = None) -> None:
        self._data, self._progress = data, progress
        self._bytes = RecordBytes(data)
        self.header = Header("", "")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: list[Attachment] = []
        self.metadata: list[Metadata] = []
        self.damaged = 0
        self.torn = False
        self._pieces: list[int | bytes] = []
        self._unpacked = 0
        # A few wrong bytes there are damage like any other.
        if sum(a == b for a, b in zip(data[: len(MCAP0_MAGIC)], MCAP0_MAGIC, strict=False)) >= 5:
            self._walk()

    def messages(self, progress: Progress = None) -> Generator[Message, None, None]:
        """Yield the messages of known channels, in the order of the file; `progress` as above."""
        for number, piece in enumerate(self._pieces):
            if progress is not None:
                progress(number / len(self._pieces))
            records = (piece if isinstance(piece, bytes) else self._bytes.chunk(piece)) or b""
            for opcode, start, end in records_in(records):
                if opcode not in _IN_CHUNKS:
                    break
                if opcode == Opcode.MESSAGE and end - start >= MESSAGE.size:
                    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(records, start)
                    if channel in self.channels:
                        data = records[start + MESSAGE.size : end]
                        yield Message(channel, log_time, data, publish_time, sequence)

    def _walk(self) -> None:
        offset = len(MCAP0_MAGIC)
        if self._data[:offset] != MCAP0_MAGIC:
            self.damaged += 1
        while offset < len(self._data):
            if self._data[offset : offset + len(MCAP0_MAGIC)] == MCAP0_MAGIC:
                return
            if self._progress is not None:
                self._progress(offset / len(self._data))
            end = self._take(offset)
            if end is None:
                if self._is_torn(offset):
                    return
                self.damaged += 1
                end = self._bytes.next_record(offset + 1)
                if end is None:
                    return
            offset = end

    def _take(self, offset: int) -> int | None:
        """Keep the content of the record at an offset; return where the next begins, None if it is none."""
        opcode, end = self._bytes.head(offset)
        if opcode == Opcode.CHUNK:
            records = self._bytes.chunk(offset)
            if records is None:
                return None
            self._unpacked += len(records)
            if self._unpacked > SLACK + LARGEST_RATIO * len(self._data):
                self.damaged += 1  # a decompression bomb, so the rest of it is not used either
                return len(self._data)
            self._define(records)
            self._pieces.append(offset)
            return end
        if end is None:
            return None
        if opcode == Opcode.MESSAGE:
            self._pieces.append(self._data[offset:end])
        elif opcode == Opcode.ATTACHMENT:
            attachment = self._bytes.attachment(offset, end)
            if attachment is None:
                return None
            self.attachments.append(attachment)
            self.damaged += attachment.name.startswith("damaged/")
        elif opcode in READERS:
            return self._keep(parsed(opcode, self._data[offset + HEAD.size : end]), end)
        elif opcode not in PLACES:
            return None
        return end

    def _keep(self, record: McapRecord | None, end: int) -> int | None:
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

    def _define(self, records: bytes) -> None:
        for opcode, start, end in records_in(records):
            if opcode not in _IN_CHUNKS:
                break
            if opcode != Opcode.MESSAGE and self._keep(parsed(opcode, records[start:end]), end) is None:
                break

    def _is_torn(self, offset: int) -> bool:
        """Return whether the file ends within the record at an offset; keep its readable part."""
        data = self._data
        opcode, end = self._bytes.head(offset)
        if end is not None:
            return False
        if opcode in PLACES and len(data) - offset < HEAD.size:
            return True
        if opcode in PLACES:
            # Losing a list of offsets loses nothing, if it is one and not a wrong length.
            return self._bytes.next_record(offset + 1) is None
        if opcode == Opcode.CHUNK and (found := self._bytes.chunk_head(offset)) is not None:
            size, _, compression, start, inner = found
            if inner != offset + HEAD.size + HEAD.unpack_from(data, offset)[1]:
                return False
            records = unpacked(compression, data[start : start + LARGEST_CHUNK], size)
            self._define(records)
            self._pieces.append(records)
        elif self._bytes.next_record(offset + 1) is not None:
            return False
        self.torn = True
        return True
