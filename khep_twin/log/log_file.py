"""File of a log: checks of its path, writing, and handling of write errors.

It is written as NAME.mcap.part and renamed when it is whole. Written data is never lost: a full disk, another
run of the same name, the remains of a crash and a file that appears under the name meanwhile do no harm to
existing data.
"""

import errno
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from khep_twin import __version__
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import Identity, kept_both, open_regular, put, resolved, unusable
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.output import Output
from khep_twin.machine import flags, lock, n_forks
from khep_twin.signals import clear_at_end, undisturbed


class PartFile:
    """An unbuffered file in which each write is there as a whole or not at all.

    It is locked while it is open, so that a second run does not take it for the remains of a crash. A fork of
    the process, such as a controller may make, cannot write it: both would write at the same place.

    Raises:
        LogError: Another run that begins now did so, before it was locked.
        OSError: It cannot be made.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._descriptor = os.open(path, flags("O_WRONLY", "O_CREAT", "O_EXCL"), 0o666)
        except FileExistsError:
            raise _written(path) from None
        self._size, self._n_forks = 0, n_forks()
        try:
            lock(self._descriptor)
            is_ours = _names(path, self._descriptor)
        except BlockingIOError:
            is_ours = False
        except OSError:  # some network file systems have no locks
            is_ours = True
        if not is_ours:
            self.close()
            raise _written(path)

    def write(self, data: bytes) -> int:
        """Append `data`; on an error, remove what was written of it and raise."""
        if n_forks() != self._n_forks:
            raise OSError(errno.EBADF, "a fork of the process that writes it cannot do so")
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._size

    def synchronize(self) -> None:
        """Bring everything to the disk, so that a power failure takes nothing of it."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            # The number of the descriptor may be reused from now on.
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)


def set_aside(part: Path) -> Path | None:
    """Move an unfinished log out of the way, so that it can still be recovered; return its path, if any.

    Raises:
        LogError: Another run is writing it, or it is no log.
        OSError: It cannot be moved.
    """
    try:
        found = open_regular(part)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"{part}: this is no unfinished log: {error.strerror}") from error
    with found as file:
        try:
            lock(file)
        except BlockingIOError:
            raise _written(part) from None
        # The run that was writing it may have ended just now, and another one have begun.
        if not _names(part, file.fileno()):
            return set_aside(part)
        # It may be cut off early; anything else belongs to the user, such as the playpen of this very run.
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise LogError(f"{part}: this is no unfinished log; expected another name for the log")
        number = 1
        while os.path.lexists(kept := part.with_name(f"{part.name}.{number}")):
            number += 1
        # As long as it is locked, no other run moves it, and none begins under its name.
        os.rename(part, kept)
        return kept


def _names(path: Path, descriptor: int) -> bool:
    """Return whether a path names the file that is open."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _written(part: Path) -> LogError:
    return LogError(f"{part}: another run is writing it; expected another name for the log")


class LogFile(Output):
    """An MCAP file with channels of khep_twin.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        now: Function that returns the time of the run [ns].

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.
        kept: New path of an unfinished log of an earlier run, None if there was none.
        open: True while it can be written.
        failure: First error, None if there was none.
        on_failure: Function that takes the message of an error, after which the run continues without a
            log; None raises it.
        complete: Function called if the process is ended from outside; by default it removes the file.

    Raises:
        LogError: The file cannot be made.
    """

    def __init__(self, path: Path, now: Callable[[], int]) -> None:
        if reason := unusable(path) or _no_log(path):
            raise LogError(f"{path}: cannot write a log here: {reason}")
        self.path = path
        # Links are followed, so that they stay links; resolved now, as a controller may change the directory.
        self._target = resolved(path) if path.is_symlink() else path.absolute()
        self.part = self._target.with_name(self._target.name + ".part")
        self._before = Identity.of(self._target)
        self._now = now
        self.on_failure: Callable[[str], None] | None = None
        self.complete = self.discard
        try:
            with undisturbed():
                self.kept = set_aside(self.part)
                self._file = PartFile(self.part)
                self._forget = clear_at_end(lambda: self.complete())
        except OSError as error:
            raise LogError(f"{path}: cannot write a log here: {error.strerror}") from error
        with self.guarded():
            super().__init__(BatchWriter(self._file, "ros2", f"khep_twin {__version__}"))

    def finish(self) -> None:
        """Complete the file and rename it to its path, or beside it if another file has appeared there."""
        with self.guarded():
            self._writer.finish()
            # A log under its own name is whole, also after a power failure; that may take the name back.
            self._file.synchronize()
            placed = put(self.part, self._target, self._before)
            self._close()
            if placed != self._target:
                self._fail(LogError(kept_both(self.path, placed)))

    def discard(self) -> None:
        """Remove the file, for a run that has not begun; a disk that fails keeps it, as a killed run's."""
        with undisturbed():
            if self.open:
                # As long as it is locked, the name is that of no other run's file.
                with suppress(OSError):
                    self.part.unlink(missing_ok=True)
                with suppress(OSError):
                    self._close()

    @contextmanager
    def guarded(self) -> Generator[None, None, None]:
        """Turn the first error of the file into a `LogError` or a message; then the file is left alone."""
        try:
            with undisturbed():
                yield
        except OSError as error:
            if not self.open:  # another thread has completed it meanwhile
                return
            with suppress(OSError):
                self._close()
            reason = (
                f"{self.path}: the log cannot be written any more at {self._now() / NS_PER_S:.2f} s: "
                f"{error.strerror}; what came before is kept in {self.part}"
            )
            self._fail(LogError(reason), "; the run goes on without it")

    def _fail(self, failure: LogError, more: str = "") -> None:
        self.failure = failure
        if self.on_failure is None:
            raise failure
        self.on_failure(f"{failure}{more}")

    def _close(self) -> None:
        self.open = False
        self._forget()
        self._file.close()


class FileRecorder:
    """Recorder of one log, in a `LogFile`."""

    _file: LogFile

    @property
    def kept(self) -> Path | None:
        """New path of an unfinished log of an earlier run, None if there was none."""
        return self._file.kept

    @property
    def failure(self) -> LogError | None:
        """Error after which the log is no longer written, None if there was none."""
        return self._file.failure

    def discard(self) -> None:
        """Remove the unfinished file, of a run that has not begun."""
        self._file.discard()


def _no_log(path: Path) -> str:
    """Return the reason why an existing file must not be replaced by a log; empty if it may."""
    try:
        if not path.exists() or path.stat().st_size == 0:
            return ""
        with open_regular(path) as file:
            begins_so = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        return "" if begins_so else "this file is no log; expected another name"
    except OSError as error:
        return error.strerror or str(error)
