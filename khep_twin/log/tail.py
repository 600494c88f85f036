"""Reading of a log while its run still writes it, NAME.mcap.part.

Only the file is read, which costs the run nothing.
"""

import os
import time
from collections.abc import Generator
from pathlib import Path
from typing import Self

from mcap.opcode import Opcode
from mcap.records import Metadata
from mcap.writer import MCAP0_MAGIC

from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular, resolved
from khep_twin.invocation import command
from khep_twin.log.decoding import DecodeError, readable
from khep_twin.log.entries import Entry, EntryReader, Label, label_of, run_facts
from khep_twin.log.reader import read_label
from khep_twin.log.record_bytes import HEAD, RecordBytes, parsed
from khep_twin.machine import lock, unlock

_BLOCK = 1 << 22
"""Bytes read at once."""

_SILENCE = 2.0
"""Wall time without new data after which the run is checked to be still there [s]."""


class GrowingLog:
    """A log that a run is writing.

    Args:
        path: Path NAME.mcap or NAME.mcap.part.

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.
        finished: True if the run has ended and the whole log is read.
        behind: True if much more is there than was read so far.

    Raises:
        FileNotFoundError: No run is writing it, and it is not finished either.
        LogError: It is finished already, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix("") if path.suffix == ".part" else path
        target = resolved(self.path)
        self.part = target.with_name(f"{target.name}.part")
        try:
            self._file = open_regular(self.part, buffering=0)
        except FileNotFoundError:
            if not self.path.exists():
                raise
            read_label(self.path)
            raise LogError(f"{self.path}: this log is finished; to view it, leave out --live") from None
        except OSError as error:
            raise LogError(f"{self.part}: cannot be read: {error.strerror}") from error
        self.finished = self.behind = False
        self._rest = b""
        self._begun = False
        self._grown = time.monotonic()
        self._reader = EntryReader()
        self._facts: dict[str, str] = {}
        self._attachments: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def label(self) -> Label | None:
        """Return metadata and attachments of the log; None as long as they are not written."""
        if "robots" not in self._facts:
            return None
        return label_of(self.part, self._facts, self._attachments)

    def new(self) -> list[Entry]:
        """Return the messages written since the last call, of a long log a part of them.

        They are in the order of the file, in which each channel is in order of time.

        Raises:
            LogError: This is no log of khep_twin, or its run has ended without finishing it.
        """
        with readable(self.part):
            block = self._file.read(_BLOCK)
        self.behind = len(block) == _BLOCK
        if not block:
            self._check_alive()
            return []
        self._grown = time.monotonic()
        self._rest += block
        try:
            return list(self._take())
        except DecodeError as error:
            raise LogError(f"{self.part}: {error}") from None

    def _take(self) -> Generator[Entry, None, None]:
        """Read the whole records; a partial one stays for the next time."""
        size = len(MCAP0_MAGIC)
        offset = 0
        if not self._begun:
            if not MCAP0_MAGIC.startswith(self._rest[:size]):
                raise LogError(f"{self.part}: this is no MCAP file; expected the log of a run")
            if len(self._rest) < size:
                return
            self._begun, offset = True, size
        records = RecordBytes(self._rest)
        while not self.finished:
            opcode, end = records.head(offset)
            if end is None:
                break
            if opcode == Opcode.CHUNK:
                yield from self._unpack(records, offset)
            elif opcode == Opcode.ATTACHMENT:
                if (found := records.attachment(offset, end)) is not None:
                    self._attachments[found.name] = found.data.decode("utf-8", "replace")
            elif opcode == Opcode.METADATA:
                record = parsed(opcode, self._rest[offset + HEAD.size : end])
                if isinstance(record, Metadata):
                    self._facts |= run_facts([record])
            elif opcode == Opcode.DATA_END:
                self.finished = True
            offset = end
        self._rest = self._rest[offset:]

    def _unpack(self, records: RecordBytes, offset: int) -> Generator[Entry, None, None]:
        content = records.chunk(offset)
        if content is None:
            recovery = command("recover", self.part)
            raise LogError(f"{self.part}: a part of it is damaged; to recover it: {recovery}")
        if self.label() is None:
            raise LogError(f"{self.part}: an MCAP file, but no log of khep_twin")
        yield from self._reader.entries(content, offset)

    def _check_alive(self) -> None:
        """Check, now and then, that a process still has the file open to write."""
        if time.monotonic() - self._grown < _SILENCE:
            return
        self._grown = time.monotonic()
        # A run has its file locked. If the file system has no locks, this never finds an end.
        try:
            lock(self._file, shared=True)
        except OSError:
            return
        unlock(self._file)
        if os.fstat(self._file.fileno()).st_size > self._file.tell():
            return
        raise LogError(
            f"{self.part}: its run has ended without finishing it; "
            f"to recover it: {command('recover', self.part)}"
        )
