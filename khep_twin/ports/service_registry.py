"""Registry of servers on this machine: a note of each in the user's own directory, locked while it runs."""

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
from khep_twin.signals import clear_at_end

_ENDING = ".served"


@contextmanager
def registered(paths: Sequence[str], what: str) -> Generator[None, None, None]:
    """Register these ports for `served` within the context.

    Args:
        paths: Paths or URLs that hosts open, one for each robot.
        what: Name of what is served: a playpen or a device.

    Raises:
        PortError: There is no directory for the note, or it cannot be written.
    """
    folder = private_folder()
    for note in folder.glob(f"*{_ENDING}"):
        if not _is_held(note):
            note.unlink(missing_ok=True)
    # By its thread: a page whose last twin still hangs serves the next one, too.
    note = folder / f"{threading.get_native_id()}{_ENDING}"
    lines = [path if "://" in path else os.path.abspath(path) for path in paths]
    with ExitStack() as stack:
        remove = partial(note.unlink, missing_ok=True)
        stack.callback(clear_at_end(remove))
        stack.callback(remove)
        text = "\n".join([" ".join(what.split()), *lines])
        try:
            # Without a buffer: what does not fit on a full disk would be written again at its end.
            file = stack.enter_context(note.open("wb", buffering=0))
            lock(file, waits=True)
            rest = text.encode("utf-8", "surrogateescape")
            while rest:
                rest = rest[file.write(rest) :]
        except OSError as error:
            raise PortError(f"{note}: cannot be written: {error.strerror}") from error
        yield


def served() -> list[tuple[str, str]]:
    """Return the ports that running servers of this user offer: path, and name of what is served there."""
    found: list[tuple[str, str]] = []
    for note in sorted(private_folder().glob(f"*{_ENDING}")):
        with suppress(FileNotFoundError):  # it may end meanwhile
            if _is_held(note):
                what, *paths = note.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
                found += [(path, what) for path in paths]
    return found


def _is_held(note: Path) -> bool:
    """Return whether the note's server is running."""
    try:
        with note.open("rb") as file:
            lock(file, shared=True)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def private_folder() -> Path:
    """Return the directory that only this user can write to; make it if necessary.

    Raises:
        PortError: It cannot be made, or is not this user's alone.
    """
    # On Windows, the folder for temporary files is the user's own.
    user = os.getuid() if sys.platform != "win32" else 0
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    name = "khep_twin" if runtime else f"khep_twin-{user}"
    folder = Path(runtime or tempfile.gettempdir()) / name
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise PortError(f"{folder}: cannot make a directory for links: {error.strerror}") from error
    is_private = sys.platform == "win32" or not found.st_mode & 0o022
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or not is_private:
        raise PortError(f"{folder}: not a directory of this user's alone; expected a path with --link")
    return folder
