"""Directory of this user's alone, for links to terminals and notes of servers."""

import os
import stat
import sys
import tempfile
from pathlib import Path

from khep_twin.errors import PortError


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
