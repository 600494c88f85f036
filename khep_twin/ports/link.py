"""Stable name for a pseudo-terminal: a symbolic link that replaces only links made by this module.

The kernel reuses numbers of terminals immediately, so a link left by a killed server soon leads to another
process's terminal. Each link therefore has a lock file beside it, which is locked while the server runs and
contains the terminal's path. A link may be replaced if its lock is free and the file has the link's target.
"""

import os
import sys
from pathlib import Path

from khep_twin.errors import PortError
from khep_twin.files.paths import StrPath
from khep_twin.ports.service_registry import private_folder
from khep_twin.process.machine import lock
from khep_twin.process.signals import block_signals, register_cleanup

if sys.platform == "win32":
    raise ImportError("a terminal's link needs a system with terminals")


class Link:
    """Link to a terminal, until it is closed.

    Args:
        name: Path as typed; a bare name is in this user's private directory, ./NAME in the current one.
        target: Path of the terminal.

    Attributes:
        path: Path of the link.

    Raises:
        PortError: Another file has this name, or the link cannot be made.
    """

    def __init__(self, name: StrPath, target: str) -> None:
        if not str(name):
            raise PortError("--link '': expected a name")
        # A Path drops a leading ./, which asks for a link in the current directory.
        is_bare = not os.path.dirname(name)
        folder = private_folder() if is_bare else Path.cwd()
        self.path = Path(name) if len(Path(name).parts) > 1 else folder / name
        self._target = target
        self._lock_path = self.path.with_name(f".{self.path.name}.lock")
        if os.path.lexists(self.path) and not self.path.is_symlink():
            raise PortError(f"{name}: it exists and is not a symbolic link; name another path for --link")
        with block_signals():
            try:
                self._lock = os.open(
                    self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600
                )
            except OSError as error:
                raise PortError(f"{name}: cannot make this link: {error.strerror}") from error
            try:
                self._claim(name)
            except BaseException:
                os.close(self._lock)
                raise
            self._unregister = register_cleanup(self.close)

    def close(self) -> None:
        """Remove the link if it is still ours."""
        if self.path.is_symlink() and os.readlink(self.path) == self._target:
            self.path.unlink()
        self._lock_path.unlink(missing_ok=True)
        self._unregister()
        os.close(self._lock)

    def _claim(self, name: StrPath) -> None:
        """Lock the lock file, and make the link in place of a stale one."""
        try:
            lock(self._lock)
        except BlockingIOError:
            raise PortError(
                f"{name}: another khep-twin serves under this name; name another path for --link"
            ) from None
        old_target = os.pread(self._lock, 4096, 0).decode("utf-8", "replace")
        is_stale = self.path.is_symlink()
        if is_stale and os.readlink(self.path) != old_target:
            if not old_target:
                self._lock_path.unlink(missing_ok=True)
            raise PortError(
                f"{name}: this link leads to {os.readlink(self.path)} and is not ours; name another path "
                "for --link, or remove the link if it is left over"
            )
        try:
            # If this process is killed at any point here, an existing link has the target in the file.
            if is_stale:
                self.path.unlink()
            os.ftruncate(self._lock, 0)
            os.pwrite(self._lock, self._target.encode(), 0)
            self.path.symlink_to(self._target)
        except OSError as error:
            raise PortError(f"{name}: cannot make this link: {error.strerror}") from error


def is_live_link(path: Path) -> bool:
    """Return whether this is the link of a running server to its terminal."""
    lock_path = path.with_name(f".{path.name}.lock")
    try:
        fd = os.open(lock_path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        lock(fd, shared=True)
    except BlockingIOError:
        return path.is_symlink() and os.readlink(path) == os.pread(fd, 4096, 0).decode("utf-8", "replace")
    finally:
        os.close(fd)
    return False
