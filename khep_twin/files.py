"""Writing files so that each is there as a whole or not at all."""

import os
from pathlib import Path

from khep_twin.errors import KhepTwinError
from khep_twin.stopping import undisturbed


def unusable(path: Path) -> str:
    """Why nothing can be written under a name; empty if it can.

    Devices, pipes and directories are left alone: giving a file their name would take them away.
    """
    try:
        if not path.name or path.is_dir():
            return "this is a directory; right is the name of a file"
        if not path.parent.is_dir():
            return f"there is no directory {path.parent}"
        if path.exists() and not path.is_file():
            return "this is no regular file; right is the name of a file"
        if path.exists() and not (path.stat().st_mode & 0o222 and os.access(path, os.W_OK)):
            return "the file is read-only"
        if not os.access(path.resolve().parent, os.W_OK):
            return f"nothing can be written in {path.parent}"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return ""


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file beside `path` and gives it its name when it is whole; a link is followed.

    Raises:
        KhepTwinError: that is not possible; what was there before is untouched.
    """
    if reason := unusable(path):
        raise KhepTwinError(f"{path}: cannot be written: {reason}")
    try:
        put_whole(path, data)
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error


def put_whole(path: Path, data: bytes) -> None:
    """What `write_whole` does, for those who tell of trouble in their own words.

    Raises:
        OSError: that is not possible; what was there before is untouched.
    """
    target = path.resolve()
    part = target.with_name(f".{target.name}.part")
    with undisturbed():
        try:
            part.write_bytes(data)
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)
