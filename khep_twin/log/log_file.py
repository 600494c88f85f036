"""File of a log: checks of its path, writing, and handling of write errors.

A log is written as NAME.mcap.part and renamed when it is complete. Written data is never lost: a full disk, a
concurrent run of the same name, the remains of a crash and a file created under the name during the run leave
existing data unchanged.
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
from khep_twin.files.atomic import (
    Identity,
    name_taken_message,
    open_regular,
    rename_into_place,
    resolve,
    unusable,
)
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.output import Output
from khep_twin.process.machine import RENAMES_OPEN_FILES, flags, lock, n_forks, remove, rename
from khep_twin.process.signals import block_signals, register_cleanup


class PartFile:
    """Unbuffered file with atomic writes: all bytes of a write or none.

    The file is locked while it is open, so that another run does not mistake it for the remains of a crash. A
    fork of the process, e.g. by a controller, cannot write it: both would write at the same offset.

    Raises:
        LogError: A concurrent run replaced or locked the file first.
        OSError: The file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._descriptor = os.open(path, flags("O_WRONLY", "O_CREAT", "O_EXCL"), 0o666)
        except FileExistsError:
            raise _busy_error(path) from None
        self._size = 0
        self._n_forks = n_forks()
        try:
            lock(self._descriptor)
            is_ours = _is_same_file(path, self._descriptor)
        except BlockingIOError:
            is_ours = False
        except OSError:  # some network file systems have no locks
            is_ours = True
        if not is_ours:
            self.close()
            raise _busy_error(path)

    def write(self, data: bytes) -> int:
        """Append `data`; on an error, remove the partial write and raise."""
        if n_forks() != self._n_forks:
            raise OSError(errno.EBADF, "a fork of the process that writes it cannot do so")
        remaining = memoryview(data)
        try:
            while remaining:
                remaining = remaining[os.write(self._descriptor, remaining) :]
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
        """Write all data to the disk, so that it survives a power failure."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            # The number of the descriptor may be reused from now on.
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)


def rename_unfinished(part: Path) -> Path | None:
    """Rename the unfinished log at `part` to NAME.mcap.part.1, .2 ...; return that path, None without a log.

    Raises:
        LogError: Another run is writing the file, or it is no log.
        OSError: The file cannot be renamed.
    """
    try:
        unfinished = open_regular(part)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"{part}: this is no unfinished log: {error.strerror}") from error
    with unfinished as file:
        try:
            lock(file)
        except BlockingIOError:
            raise _busy_error(part) from None
        # The run that wrote it may have just ended, and another one started.
        if not _is_same_file(part, file.fileno()):
            return rename_unfinished(part)
        # A log may be cut off early; a file of another format is the user's, e.g. the playpen of this run.
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise LogError(f"{part}: this is no unfinished log; expected another name for the log")
        number = 1
        while os.path.lexists(new_path := part.with_name(f"{part.name}.{number}")):
            number += 1
        # While it is locked, no other run renames it or starts under its name.
        if not RENAMES_OPEN_FILES:
            file.close()
        rename(part, new_path)
        return new_path


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether the file at a path is the one open with this descriptor."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _busy_error(part: Path) -> LogError:
    return LogError(f"{part}: another run is writing it; expected another name for the log")


class LogFile(Output):
    """An MCAP file with channels of khep_twin.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        clock: Function that returns the time of the run [ns].

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.
        previous_part: New path of an unfinished log of an earlier run, None if there was none.
        open: True while it can be written.
        failure: First error, None if there was none.
        on_failure: Function that takes the message of an error, after which the run continues without a
            log; None raises the error.
        on_exit: Function called if the process is terminated; by default it removes the file.

    Raises:
        LogError: The file cannot be created.
    """

    def __init__(self, path: Path, clock: Callable[[], int]) -> None:
        if reason := unusable(path) or _existing_file_error(path):
            raise LogError(f"{path}: cannot write a log here: {reason}")
        self.path = path
        # Links are followed, so that they stay links; a controller may change the directory later.
        self._target = resolve(path) if path.is_symlink() else path.absolute()
        self.part = self._target.with_name(self._target.name + ".part")
        self._target_identity = Identity.of(self._target)
        self._clock = clock
        self.on_failure: Callable[[str], None] | None = None
        self.on_exit = self.discard
        try:
            with block_signals():
                self.previous_part = rename_unfinished(self.part)
                self._file = PartFile(self.part)
                self._unregister = register_cleanup(lambda: self.on_exit())
        except OSError as error:
            raise LogError(f"{path}: cannot write a log here: {error.strerror}") from error
        with self.error_guard():
            super().__init__(BatchWriter(self._file, "ros2", f"khep_twin {__version__}"))

    def finish(self) -> None:
        """Complete the file and rename it to its path, or to a free name if another file exists there."""
        with self.error_guard():
            self._writer.finish()
            # A log under its final name is complete, even after a power failure, which may undo the renaming.
            self._file.synchronize()
            self._close_before_rename()
            final_path = rename_into_place(self.part, self._target, self._target_identity)
            self._close()
            if final_path != self._target:
                self._fail(LogError(name_taken_message(self.path, final_path)))

    def discard(self) -> None:
        """Remove the file of a run that has not started; on a disk error it remains."""
        with block_signals():
            if self.open:
                # While it is locked, the name is that of no other run's file.
                self._close_before_rename()
                with suppress(OSError):
                    remove(self.part)
                with suppress(OSError):
                    self._close()

    @contextmanager
    def error_guard(self) -> Generator[None, None, None]:
        """Close the file at its first error, and raise it as a `LogError` or pass it to `on_failure`."""
        try:
            with block_signals():
                yield
        except OSError as error:
            if not self.open:  # another thread has completed it
                return
            with suppress(OSError):
                self._close()
            reason = (
                f"{self.path}: the log cannot be written any more at {self._clock() / NS_PER_S:.2f} s: "
                f"{error.strerror}; what came before is kept in {self.part}"
            )
            self._fail(LogError(reason), "; the run goes on without it")

    def _close_before_rename(self) -> None:
        """Close the file, and so release its lock, on a system that cannot rename or remove an open one."""
        if not RENAMES_OPEN_FILES:
            self._file.close()

    def _fail(self, failure: LogError, suffix: str = "") -> None:
        self.failure = failure
        if self.on_failure is None:
            raise failure
        self.on_failure(f"{failure}{suffix}")

    def _close(self) -> None:
        self.open = False
        self._unregister()
        self._file.close()


class FileRecorder:
    """Recorder of one log, in a `LogFile`."""

    _file: LogFile

    @property
    def previous_part(self) -> Path | None:
        """New path of an unfinished log of an earlier run, None if there was none."""
        return self._file.previous_part

    @property
    def failure(self) -> LogError | None:
        """Error after which the log is no longer written, None if there was none."""
        return self._file.failure

    def discard(self) -> None:
        """Remove the unfinished file of a run that has not started."""
        self._file.discard()


def _existing_file_error(path: Path) -> str:
    """Return why a log must not replace the file at a path; empty if it may."""
    try:
        if not path.exists() or path.stat().st_size == 0:
            return ""
        with open_regular(path) as file:
            is_log = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        return "" if is_log else "this file is no log; expected another name"
    except OSError as error:
        return error.strerror or str(error)
