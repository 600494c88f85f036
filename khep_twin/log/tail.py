"""Reading a log while its run still writes it, NAME.mcap.part: what is new since the last look.

Only the file is read, so that the run does nothing more than it does anyway.
"""

import fcntl
import os
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular
from khep_twin.invocation import command
from khep_twin.log.decoding import Misfit
from khep_twin.log.reader import Label, read_label, robot_names
from khep_twin.log.record_bytes import HEAD, MESSAGE, RecordBytes, parsed, records_in

_BLOCK = 1 << 22
"""Read at once [bytes]."""

_SILENCE = 2.0
"""After so much wall time without anything new it is asked whether the run is still there [s]."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a log.

    Attributes:
        topic: of its channel.
        schema: name of its type.
        definition: of its type: text for ROS 2, bytes for protobuf.
        time_ns: simulated [ns].
        data: as it was written.
    """

    topic: str
    schema: str
    definition: str | bytes
    time_ns: int
    data: bytes


class GrowingLog:
    """A log that a run is writing.

    Args:
        path: NAME.mcap or NAME.mcap.part.

    Attributes:
        path: of the finished log.
        part: of the file while it grows.
        finished: whether the run has come to its end and all of it is read.
        behind: whether much more is there than was read so far.

    Raises:
        FileNotFoundError: no run is writing it, and it is not finished either.
        LogError: it is finished already, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix("") if path.suffix == ".part" else path
        target = self.path.resolve()
        self.part = target.with_name(f"{target.name}.part")
        try:
            self._file = open_regular(self.part, buffering=0)
        except FileNotFoundError:
            if not self.path.exists():
                raise
            read_label(self.path)
            raise LogError(f"{self.path}: this log is finished; right is to view it without --live") from None
        except OSError as error:
            raise LogError(f"{self.part}: cannot be read: {error.strerror}") from error
        self.finished = self.behind = False
        self._rest = b""
        self._begun = False
        self._grown = time.monotonic()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._facts: dict[str, str] = {}
        self._attachments: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def label(self) -> Label | None:
        """What the log says of itself; None as long as it has not said it.

        Raises:
            LogError: it cannot be.
        """
        if "robots" not in self._facts:
            return None
        try:
            return Label(self._facts, self._attachments, robot_names(self._facts["robots"]))
        except Misfit as misfit:
            raise misfit.at(self.part, "metadata") from None

    def new(self) -> list[Message]:
        """The messages of what was written since the last look, of a long log a part of them.

        In the order of the file, in which each channel is in order of time.

        Raises:
            LogError: this is no log of khep_twin, or its run has ended without finishing it.
        """
        try:
            block = self._file.read(_BLOCK)
        except OSError as error:
            raise LogError(f"{self.part}: cannot be read: {error.strerror}") from error
        self.behind = len(block) == _BLOCK
        if not block:
            self._check_alive()
            return []
        self._grown = time.monotonic()
        self._rest += block
        return list(self._take())

    def _take(self) -> Generator[Message, None, None]:
        """Reads the whole records; what is there in part stays for the next time."""
        size = len(MCAP0_MAGIC)
        place = 0
        if not self._begun:
            if not MCAP0_MAGIC.startswith(self._rest[:size]):
                raise LogError(f"{self.part}: this is no MCAP file; right is the log of a run")
            if len(self._rest) < size:
                return
            self._begun, place = True, size
        records = RecordBytes(self._rest)
        while not self.finished:
            opcode, end = records.head(place)
            if end is None:
                break
            if opcode == Opcode.CHUNK:
                yield from self._unpack(records, place)
            elif opcode == Opcode.ATTACHMENT:
                self._attach(records.attachment(place, end))
            elif opcode == Opcode.METADATA:
                record = parsed(opcode, self._rest[place + HEAD.size : end])
                if isinstance(record, Metadata) and record.name == "run":
                    self._facts |= record.metadata
            elif opcode == Opcode.DATA_END:
                self.finished = True
            place = end
        self._rest = self._rest[place:]

    def _attach(self, attachment: Attachment | None) -> None:
        if attachment is not None:
            self._attachments[attachment.name] = attachment.data.decode("utf-8", "replace")

    def _unpack(self, records: RecordBytes, place: int) -> Generator[Message, None, None]:
        content, _ = records.chunk(place)
        if content is None:
            raise LogError(f"{self.part}: a part of it is damaged; right is: {command('recover', self.part)}")
        if self.label() is None:
            raise LogError(f"{self.part}: an MCAP file, but no log of khep_twin")
        for opcode, start, end in records_in(content):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                match parsed(opcode, content[start:end]):
                    case Schema() as schema:
                        self._schemas[schema.id] = schema
                    case Channel() as channel:
                        self._channels[channel.id] = channel
                    case _:
                        pass
            elif opcode == Opcode.MESSAGE:
                number, _, time_ns, _ = MESSAGE.unpack_from(content, start)
                channel = self._channels[number]
                schema = self._schemas[channel.schema_id]
                data = content[start + MESSAGE.size : end]
                definition = schema.data.decode("ascii") if schema.encoding == "ros2msg" else schema.data
                yield Message(channel.topic, schema.name, definition, time_ns, data)

    def _check_alive(self) -> None:
        """Asks, now and then, whether somebody still has the file open to write."""
        if time.monotonic() - self._grown < _SILENCE:
            return
        self._grown = time.monotonic()
        # A run has its file locked. Where the file system knows no locks, this never finds an end.
        try:
            fcntl.flock(self._file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return
        fcntl.flock(self._file, fcntl.LOCK_UN)
        if os.fstat(self._file.fileno()).st_size > self._file.tell():
            return
        raise LogError(
            f"{self.part}: its run has ended without finishing it; right is: {command('recover', self.part)}"
        )
