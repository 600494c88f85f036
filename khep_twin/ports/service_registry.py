"""Who serves what on this machine: a note of each server in a private directory, locked while it lives."""

import fcntl
import os
import threading
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from khep_twin.errors import PortError
from khep_twin.ports.link import private_folder
from khep_twin.signals import clear_at_end

_ENDING = ".served"


@contextmanager
def registered(paths: Sequence[str], what: str) -> Generator[None, None, None]:
    """Lets `served` find these ports, as long as this goes on.

    Args:
        paths: what hosts open, for each robot.
        what: is served, in a word: a playpen or a device.

    Raises:
        PortError: there is no directory for the note.
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
        try:
            file = stack.enter_context(note.open("w", encoding="utf-8", errors="surrogateescape"))
        except OSError as error:
            raise PortError(f"{note}: cannot be written: {error.strerror}") from error
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write("\n".join([" ".join(what.split()), *lines]))
        file.flush()
        yield


def served() -> list[tuple[str, str]]:
    """The ports that living servers of this user offer: what hosts open, and what is served there.

    Raises:
        PortError: the private directory is none.
    """
    found: list[tuple[str, str]] = []
    for note in sorted(private_folder().glob(f"*{_ENDING}")):
        if _is_held(note):
            what, *paths = note.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
            found += [(path, what) for path in paths]
    return found


def _is_held(note: Path) -> bool:
    """Whether its server lives."""
    try:
        with note.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False
