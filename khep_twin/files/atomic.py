"""Safe reading and atomic writing: only regular files are read, and a file is written whole or not at all."""

import errno
import os
import stat
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import BinaryIO

from khep_twin.errors import KhepTwinError
from khep_twin.machine import flags
from khep_twin.signals import clear_at_end, undisturbed


def open_regular(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file to read it; refuse pipes, which could block for ever, and devices at once.

    Raises:
        OSError: It cannot be opened, or is no regular file.
    """
    # Check before opening, which alone may act on a device, and after, as the file may be another by then.
    _check_regular(os.stat(path))
    descriptor = os.open(path, flags("O_RDONLY", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC"))
    try:
        _check_regular(os.fstat(descriptor))
    except OSError:
        os.close(descriptor)
        raise
    return open(descriptor, "rb", buffering=buffering)


def read_regular(path: Path) -> bytes:
    """Return the content of a file, which is refused as by `open_regular`.

    Raises:
        OSError: It cannot be read, or is no regular file.
    """
    with open_regular(path) as file:
        return file.read()


def is_same(path: Path, other: Path) -> bool:
    """Return whether two paths name the same file, which need not exist yet."""
    try:
        return path.resolve() == other.resolve() or path.samefile(other)
    except (OSError, ValueError):  # a missing file is not the same as any other
        return False


def unusable(path: Path) -> str:
    """Return the reason why nothing can be written under a name; empty if it can.

    Devices, pipes and directories are refused: a rename to their name would replace them.
    """
    try:
        if not path.name or path.is_dir():
            return "this is a directory; expected the name of a file"
        if not path.parent.is_dir():
            return f"there is no directory {path.parent}"
        if path.exists() and not path.is_file():
            return "this is no regular file; expected the name of a file"
        if path.exists() and not (path.stat().st_mode & 0o222 and os.access(path, os.W_OK)):
            return "the file is read-only"
        if not os.access(path.resolve().parent, os.W_OK):
            return f"nothing can be written in {path.parent}"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return ""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file beside `path` and rename it when it is whole; a link is followed.

    After a power failure, too, the previous or the new file is there, and after the return the new one.

    Raises:
        KhepTwinError: It cannot be written; the previous file is unchanged.
    """
    with undisturbed(), whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path) -> Generator[BinaryIO]:
    """Open a file for writing that is renamed to `path` when it is whole; a link is followed.

    Raises:
        KhepTwinError: It cannot be written; the previous file is unchanged.
    """
    if reason := unusable(path):
        raise KhepTwinError(f"{path}: cannot be written: {reason}")
    try:
        with part_file(path) as file:
            yield file
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error


@contextmanager
def part_file(path: Path) -> Generator[BinaryIO]:
    """Do the same as `whole_file`, for callers that report errors in their own words.

    Raises:
        OSError: It cannot be written; the previous file is unchanged, or the new one there in spite of a disk
            that fails.
    """
    target = path.resolve()
    with undisturbed():
        part = _new_part(target)
        clear = partial(part.unlink, missing_ok=True)
        forget = clear_at_end(clear)
    try:
        with part.open("w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists() and (mode := target.stat().st_mode) != part.stat().st_mode:
            part.chmod(stat.S_IMODE(mode))
        os.replace(part, target)
        synchronize_folder(target.parent)
    finally:
        clear()
        forget()


def synchronize_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, so that a power failure does not take a rename back.

    Raises:
        OSError: The disk fails.
    """
    try:
        descriptor = os.open(folder, flags("O_RDONLY", "O_DIRECTORY", "O_CLOEXEC"))
    except PermissionError:  # it may be written, but not listed
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(descriptor)


_UNSUPPORTED = errno.EINVAL, errno.ENOTSUP
"""Errors of file systems that cannot synchronize a folder, such as some of a network."""


def is_part(path: Path, whole: Path) -> bool:
    """Return whether a name is that of `whole` while it is written."""
    return path.parent == whole.parent and path.name.startswith(f".{whole.name}.part")


def _new_part(target: Path) -> Path:
    """Make an empty file beside another one, under a unique name."""
    number = 0
    while True:
        part = target.with_name(f".{target.name}.part{number or ''}")
        try:
            part.touch(exist_ok=False)
            return part
        except FileExistsError:
            number += 1


def _check_regular(found: os.stat_result) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "this is no regular file; expected the name of a file")
