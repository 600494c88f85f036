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
from typing import NamedTuple
from urllib.parse import urlsplit

from khep_twin.errors import NO_TEMPORARY_FOLDER, PortError
from khep_twin.process.machine import lock, remove
from khep_twin.process.signals import register_cleanup

_ENTRY_SUFFIX = ".served"


class ServedPort(NamedTuple):
    """Port of a running server.

    Attributes:
        path: Path or URL that hosts open.
        subject: Name of the served playpen or device.
        speed: Simulated seconds per second of wall time; inf without pacing, 0 for the wire clock.
    """

    path: str
    subject: str
    speed: float = 1.0


@contextmanager
def registered_ports(paths: Sequence[str], subject: str, speed: float = 1.0) -> Generator[None, None, None]:
    """Register ports within the context, for `served_ports`.

    Args:
        paths: Paths or URLs that hosts open, one for each robot.
        subject: Name of the served playpen or device.
        speed: Speed of the server, as in `ServedPort`.

    Raises:
        PortError: The directory or the entry cannot be written.
    """
    folder = private_folder()
    for entry_path in folder.glob(f"*{_ENTRY_SUFFIX}"):
        if not _is_locked(entry_path):
            remove(entry_path)
    # Named by thread: a web page may serve the next twin while its last one still hangs.
    entry_path = folder / f"{threading.get_native_id()}{_ENTRY_SUFFIX}"
    lines = [path if "://" in path else os.path.abspath(path) for path in paths]
    with ExitStack() as stack:
        remove_entry = partial(remove, entry_path)
        stack.callback(register_cleanup(remove_entry))
        stack.callback(remove_entry)
        text = "\n".join([" ".join(subject.split()), str(speed), *lines])
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


def served_ports() -> list[ServedPort]:
    """Return the ports of this user's running servers."""
    ports: list[ServedPort] = []
    for entry_path in sorted(private_folder().glob(f"*{_ENTRY_SUFFIX}")):
        # The server may end meanwhile; an entry of another version may have no speed.
        with suppress(FileNotFoundError, ValueError):
            if _is_locked(entry_path):
                text = entry_path.read_text(encoding="utf-8", errors="surrogateescape")
                subject, speed, *paths = text.split("\n")
                ports += [ServedPort(path, subject, float(speed)) for path in paths]
    return ports


def served_speed(url: str) -> float:
    """Return the speed of the server at a port, as in `ServedPort`; 1.0 for any other port."""
    with suppress(PortError, OSError, ValueError):
        place = _place(url)
        return next((port.speed for port in served_ports() if _place(port.path) == place), 1.0)
    return 1.0


def _place(url: str) -> object:
    """Return the place of a port, equal for all links to a terminal and names of this machine."""
    if "://" not in url:
        return os.path.realpath(url)
    address = urlsplit(url)
    host = "127.0.0.1" if address.hostname in ("localhost", "::1") else address.hostname
    return address.scheme, host, address.port


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
    try:
        folder = Path(runtime or tempfile.gettempdir()) / name
    except FileNotFoundError as error:
        raise PortError(NO_TEMPORARY_FOLDER) from error
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise PortError(f"{folder}: cannot make a directory for links: {error.strerror}") from error
    is_private = sys.platform == "win32" or not status.st_mode & 0o022
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != user or not is_private:
        raise PortError(f"{folder}: not a directory of this user's alone; expected a path with --link")
    return folder
