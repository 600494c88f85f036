"""A stable name for a pseudo-terminal: a symbolic link that replaces only links made here.

Numbers of terminals are reused at once, so that a link left over from a killed server soon leads to another
process's terminal. Beside each link lies a lock file, held while the server runs, with the terminal in
it: a link whose lock is free and whose terminal is the one in the file is our own and may be replaced.
"""

import os
import sys
from pathlib import Path

from khep_twin.errors import PortError
from khep_twin.files.paths import StrPath
from khep_twin.machine import lock
from khep_twin.ports.service_registry import private_folder
from khep_twin.signals import clear_at_end, undisturbed

if sys.platform == "win32":
    raise ImportError("a terminal's link needs a system with terminals")


class Link:
    """Link to a terminal, until it is closed.

    Args:
        wanted: Path as typed; a bare name is in a private directory of this user, ./NAME in the current one.
        target: Path of the terminal.

    Attributes:
        path: Path of the link.

    Raises:
        PortError: There is something else under this name, or the link cannot be made.
    """

    def __init__(self, wanted: StrPath, target: str) -> None:
        if not str(wanted):
            raise PortError("--link '': expected a name")
        # A Path drops a leading ./, which asks for a link in the current directory.
        is_bare = not os.path.dirname(wanted)
        folder = private_folder() if is_bare else Path.cwd()
        self.path = Path(wanted) if len(Path(wanted).parts) > 1 else folder / wanted
        self._target = target
        self._lock_path = self.path.with_name(f".{self.path.name}.lock")
        if os.path.lexists(self.path) and not self.path.is_symlink():
            raise PortError(f"{wanted}: there is something that is no link; name another path for --link")
        with undisturbed():
            try:
                self._lock = os.open(
                    self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600
                )
            except OSError as error:
                raise PortError(f"{wanted}: cannot make this link: {error.strerror}") from error
            try:
                self._take(wanted)
            except BaseException:
                os.close(self._lock)
                raise
            self._forget = clear_at_end(self.close)

    def close(self) -> None:
        """Remove the link if it is still ours."""
        if self.path.is_symlink() and os.readlink(self.path) == self._target:
            self.path.unlink()
        self._lock_path.unlink(missing_ok=True)
        self._forget()
        os.close(self._lock)

    def _take(self, wanted: StrPath) -> None:
        try:
            lock(self._lock)
        except BlockingIOError:
            raise PortError(
                f"{wanted}: another khep-twin serves under this name; name another path for --link"
            ) from None
        before = os.pread(self._lock, 4096, 0).decode("utf-8", "replace")
        is_left_over = self.path.is_symlink()
        if is_left_over and os.readlink(self.path) != before:
            if not before:
                self._lock_path.unlink(missing_ok=True)
            raise PortError(
                f"{wanted}: this link leads to {os.readlink(self.path)} and is not ours; name another path "
                "for --link, or remove the link if it is left over"
            )
        try:
            # Whenever this is killed, the terminal of a link that is there is the one in the file.
            if is_left_over:
                self.path.unlink()
            os.ftruncate(self._lock, 0)
            os.pwrite(self._lock, self._target.encode(), 0)
            self.path.symlink_to(self._target)
        except OSError as error:
            raise PortError(f"{wanted}: cannot make this link: {error.strerror}") from error


def leads_to_ours(path: Path) -> bool:
    """Return whether this is a link of a running server that leads to the server's terminal."""
    lock_path = path.with_name(f".{path.name}.lock")
    try:
        held = os.open(lock_path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        lock(held, shared=True)
    except BlockingIOError:
        return path.is_symlink() and os.readlink(path) == os.pread(held, 4096, 0).decode("utf-8", "replace")
    finally:
        os.close(held)
    return False
