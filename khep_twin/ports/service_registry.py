"""Registry of this user's servers: an entry file for each in a private directory, locked while it runs."""

import os
import stat
import sys
import tempfile
import threading
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from khep_twin.errors import PortError
from khep_twin.machine import lock
from khep_twin.signals import register_cleanup

_ENTRY_SUFFIX = ".served"


@contextmanager
def registered_ports(paths: Sequence[str], subject: str) -> Generator[None, None, None]:
    """Register ports within the context, for `served_ports`.

    Args:
        paths: Paths or URLs that hosts open, one for each robot.
        subject: Name of the served playpen or device.

    Raises:
        PortError: The directory or the entry cannot be written.
    """
    folder = private_folder()
    for entry_path in folder.glob(f"*{_ENTRY_SUFFIX}"):
        if not _is_locked(entry_path):
            entry_path.unlink(missing_ok=True)
    # Named by thread: a web page may serve the next twin while its last one still hangs.
    entry_path = folder / f"{threading.get_native_id()}{_ENTRY_SUFFIX}"
    lines = [path if "://" in path else os.path.abspath(path) for path in paths]
    with ExitStack() as stack:
        remove = partial(entry_path.unlink, missing_ok=True)
        stack.callback(register_cleanup(remove))
        stack.callback(remove)
        text = "\n".join([" ".join(subject.split()), *lines])
        try:
            # Without a buffer, which would be written again on closing if the disk is full.
            file = stack.enter_context(entry_path.open("wb", buffering=0))
            lock(file, waits=True)
            remaining = text.encode("utf-8", "surrogateescape")
            while remaining:
                remaining = remaining[file.write(remaining) :]
        except OSError as error:
            raise PortError(f"{entry_path}: cannot be written: {error.strerror}") from error
        yield


def served_ports() -> list[tuple[str, str]]:
    """Return the ports of this user's running servers: path and name of the served playpen or device."""
    ports: list[tuple[str, str]] = []
    for entry_path in sorted(private_folder().glob(f"*{_ENTRY_SUFFIX}")):
        with suppress(FileNotFoundError):  # the server may end meanwhile
            if _is_locked(entry_path):
                subject, *paths = entry_path.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
                ports += [(path, subject) for path in paths]
    return ports


def _is_locked(entry_path: Path) -> bool:
    """Return whether the server of an entry is running: it keeps the file locked."""
    try:
        with entry_path.open("rb") as file:
            lock(file, shared=True)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def private_folder() -> Path:
    """Return the directory that only this user can write to; create it if necessary.

    Raises:
        PortError: It cannot be created, or other users can write to it.
    """
    # On Windows, the folder for temporary files is private.
    user = os.getuid() if sys.platform != "win32" else 0
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    name = "khep_twin" if runtime else f"khep_twin-{user}"
    folder = Path(runtime or tempfile.gettempdir()) / name
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise PortError(f"{folder}: cannot make a directory for links: {error.strerror}") from error
    is_private = sys.platform == "win32" or not status.st_mode & 0o022
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != user or not is_private:
        raise PortError(f"{folder}: not a directory of this user's alone; expected a path with --link")
    return folder
