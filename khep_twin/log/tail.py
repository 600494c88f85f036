"""Follower of a log, NAME.mcap.part, while its run writes it.

Only the file is read, at no cost to the run. Each `read_new` parses the complete records of one block:

    magic expected -> label expected -> chunks expected -> finished, at the end of the data
          |                 |                 |
          +-----------------+-----------------+-> LogError: invalid record, or the writer's lock is gone
"""

import errno
import os
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Self

from mcap.opcode import Opcode
from mcap.records import Metadata
from mcap.writer import MCAP0_MAGIC

from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular, resolve
from khep_twin.log.decoding import DecodeError, read_errors
from khep_twin.log.entries import Entry, EntryReader, Label, make_label, run_metadata
from khep_twin.log.reader import read_label
from khep_twin.log.record_bytes import HEAD, RecordBytes, parse_record
from khep_twin.process.invocation import command
from khep_twin.process.machine import RENAMES_OPEN_FILES, lock, unlock

_BLOCK_BYTES = 1 << 22  # per read

_SILENCE_S = 2.0
"""Wall time without new data after which the lock of the run is checked [s]."""


class GrowingLog:
    """Follower of a log that a run is writing.

    Args:
        path: Path NAME.mcap or NAME.mcap.part.

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.
        is_finished: True if the run has ended and the log is read completely.
        is_behind: True if the last read filled its block, so that more data is available.

    Raises:
        FileNotFoundError: There is neither an unfinished nor a finished log.
        LogError: The log is finished, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix("") if path.suffix == ".part" else path
        self._target = resolve(self.path)
        self.part = self._target.with_name(f"{self._target.name}.part")
        self._kept_file: BinaryIO | None = None
        self._offset = 0
        try:
            with open_regular(self.part, buffering=0) as file:
                self._status = os.fstat(file.fileno())
            if RENAMES_OPEN_FILES:
                self._kept_file = self._open()
        except FileNotFoundError:
            if not self.path.exists():
                raise
            read_label(self.path)
            raise LogError(f"{self.path}: this log is finished; to view it, leave out --live") from None
        except OSError as error:
            raise LogError(f"{self.part}: cannot be read: {error.strerror}") from error
        self.is_finished = self.is_behind = False
        self._buffer = b""
        self._has_magic = False
        self._last_growth_s = time.monotonic()
        self._reader = EntryReader()
        self._metadata: dict[str, str] = {}
        self._attachments: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._kept_file is not None:
            self._kept_file.close()

    def label(self) -> Label | None:
        """Return metadata and attachments of the log; None until they are written."""
        if "robots" not in self._metadata:
            return None
        return make_label(self.part, self._metadata, self._attachments)

    def read_new(self) -> list[Entry]:
        """Return new messages in the order of the file, at most one block of data.

        Each channel is in order of time.

        Raises:
            LogError: The file is no log of khep_twin, or its run ended without finishing it.
        """
        with read_errors(self.part), self._opened() as file:
            file.seek(self._offset)
            block = file.read(_BLOCK_BYTES)
            self._offset = file.tell()
        self.is_behind = len(block) == _BLOCK_BYTES
        if not block:
            self._check_writer()
            return []
        self._last_growth_s = time.monotonic()
        self._buffer += block
        try:
            return list(self._parse_buffer())
        except DecodeError as error:
            raise LogError(f"{self.part}: {error}") from None

    @contextmanager
    def _opened(self) -> Generator[BinaryIO]:
        """Open the file for one read, unless its run can rename it while it is open."""
        if self._kept_file is not None:
            yield self._kept_file
            return
        with self._open() as file:
            yield file

    def _open(self) -> BinaryIO:
        """Open the file, also after its run has renamed it."""
        for path in (self.part, self._target):
            with suppress(FileNotFoundError):
                file = open_regular(path, buffering=0)
                if os.path.samestat(os.fstat(file.fileno()), self._status):
                    return file
                file.close()
        raise FileNotFoundError(errno.ENOENT, "its run has ended, and another one has its name")

    def _parse_buffer(self) -> Generator[Entry, None, None]:
        """Parse the complete records; a partial one remains in the buffer."""
        magic_size = len(MCAP0_MAGIC)
        offset = 0
        if not self._has_magic:
            if not MCAP0_MAGIC.startswith(self._buffer[:magic_size]):
                raise LogError(f"{self.part}: this is no MCAP file; expected the log of a run")
            if len(self._buffer) < magic_size:
                return
            self._has_magic = True
            offset = magic_size
        records = RecordBytes(self._buffer)
        while not self.is_finished:
            opcode, end = records.read_head(offset)
            if end is None:
                break
            if opcode == Opcode.CHUNK:
                yield from self._read_chunk(records, offset)
            elif opcode == Opcode.ATTACHMENT:
                if (attachment := records.read_attachment(offset, end)) is not None:
                    self._attachments[attachment.name] = attachment.data.decode("utf-8", "replace")
            elif opcode == Opcode.METADATA:
                record = parse_record(opcode, self._buffer[offset + HEAD.size : end])
                if isinstance(record, Metadata):
                    self._metadata |= run_metadata([record])
            elif opcode == Opcode.DATA_END:
                self.is_finished = True
            offset = end
        self._buffer = self._buffer[offset:]

    def _read_chunk(self, records: RecordBytes, offset: int) -> Generator[Entry, None, None]:
        content = records.read_chunk(offset)
        if content is None:
            recovery = command("recover", self.part)
            raise LogError(f"{self.part}: a part of it is damaged; to recover it: {recovery}")
        if self.label() is None:
            raise LogError(f"{self.part}: an MCAP file, but no log of khep_twin")
        yield from self._reader.parse_entries(content, offset)

    def _check_writer(self) -> None:
        """Check after a silence that a process still holds the lock of the file."""
        if time.monotonic() - self._last_growth_s < _SILENCE_S:
            return
        self._last_growth_s = time.monotonic()
        # A run locks its file. On a file system without locks, the end of a run is never detected.
        with read_errors(self.part), self._opened() as file:
            try:
                lock(file, shared=True)
            except OSError:
                return
            unlock(file)
            if os.fstat(file.fileno()).st_size > self._offset:
                return
        raise LogError(
            f"{self.part}: its run has ended without finishing it; "
            f"to recover it: {command('recover', self.part)}"
        )
