"""File of a log while it is written: NAME.mcap.part, of which written data is never lost.

A full disk, a second run of the same name and the remains of a crash do no harm to existing data.
"""

import errno
import os
from contextlib import suppress
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from khep_twin.errors import LogError
from khep_twin.files.atomic import open_regular
from khep_twin.machine import flags, lock, n_forks


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
        """Bring everything to the disk, so that a power failure takes nothing of it.

        Raises:
            OSError: The disk fails.
        """
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            # The number of the descriptor may be reused from now on.
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)


def set_aside(part: Path) -> Path | None:
    """Move an unfinished log out of the way, so that it can still be recovered.

    Returns:
        Its new path; None if there was none.

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
        while (kept := part.with_name(f"{part.name}.{number}")).exists():
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
