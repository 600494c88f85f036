"""Safe reading and atomic writing: only regular files are read, and a file is written whole or not at all."""

import errno
import os
import stat
from collections.abc import Generator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

from khep_twin.errors import KhepTwinError
from khep_twin.files.paths import StrPath
from khep_twin.invocation import quoted
from khep_twin.machine import flags
from khep_twin.signals import clear_at_end, undisturbed


def open_regular(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file to read it; refuse pipes, which could block for ever, and devices at once.

    Raises:
        OSError: It cannot be opened, or is no regular file.
    """
    # Check before opening, which alone may act on a device, and after, as the file may be another by then.
    try:
        _check_regular(os.stat(path))
    except FileNotFoundError as error:
        raise FileNotFoundError(errno.ENOENT, f"{error.strerror}{_nearest(path)}", str(path)) from None
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


def resolved(path: Path) -> Path:
    """Return a path without links; it need not exist, and links in a circle stay, for its use to report."""
    # Path.resolve raises another error for such links, on some versions of Python only.
    return Path(os.path.realpath(path))


def is_same(path: Path, other: Path) -> bool:
    """Return whether two paths name the same file, which need not exist yet."""
    try:
        return resolved(path) == resolved(other) or path.samefile(other)
    except (OSError, ValueError):  # a missing file is not the same as any other
        return False


def unusable(path: StrPath) -> str:
    """Return the reason why nothing can be written under a name; empty if it can.

    Devices, pipes and directories are refused: a rename to their name would replace them.
    """
    path = Path(path)
    try:
        if not path.name or path.is_dir():
            return "this is a directory; expected the name of a file"
        if not path.parent.is_dir():
            return f"there is no directory {path.parent}; to make it: mkdir -p {quoted(str(path.parent))}"
        if path.exists() and not path.is_file():
            return "this is no regular file; expected the name of a file"
        if path.exists() and not (path.stat().st_mode & 0o222 and os.access(path, os.W_OK)):
            return "the file is read-only"
        if path.is_symlink() and not path.exists():
            with suppress(FileNotFoundError):  # of a link to a new file; any other error is a reason
                path.stat()
        if not os.access(resolved(path).parent, os.W_OK):
            return f"nothing can be written in {path.parent}"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return ""


def write_whole(path: Path, data: bytes, replace: bool = True) -> None:
    """Write a file beside `path` and rename it when it is whole; a link is followed.

    After a power failure, too, the previous or the new file is there, and after the return the new one.

    Raises:
        KhepTwinError: It cannot be written; the previous file is unchanged. With `replace` false also: a file
            that is not empty is there by now, and the new one has another name.
    """
    with undisturbed(), whole_file(path, replace) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path, replace: bool = True) -> Generator[BinaryIO]:
    """Open a file for writing that is renamed to `path` when it is whole; a link is followed.

    Raises:
        KhepTwinError: As `write_whole`.
    """
    if reason := unusable(path):
        raise KhepTwinError(f"{path}: cannot be written: {reason}")
    try:
        with part_file(path, replace) as file:
            yield file
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error


@contextmanager
def part_file(path: Path, replace: bool = True) -> Generator[BinaryIO]:
    """Do the same as `whole_file`, for callers that report errors in their own words.

    Raises:
        OSError: It cannot be written; the previous file is unchanged, or the new one there in spite of a disk
            that fails.
        KhepTwinError: With `replace` false, another file was there at the end.
    """
    target = resolved(path)
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
        placed, there = target, Identity.of(target)
        if replace:
            os.replace(part, target)
        else:
            placed = put(part, target, there if there and not there.size else None)
        synchronize_folder(target.parent)
        if placed != target:
            raise KhepTwinError(kept_both(path, placed))
    finally:
        clear()
        forget()


class Identity(NamedTuple):
    """Identity of a file, beside another one that has taken its name."""

    device: int
    inode: int
    size: int
    changed_ns: int

    @classmethod
    def of(cls, path: Path) -> "Identity | None":
        """Return the identity of a file; None if there is none."""
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


def put(part: Path, target: Path, before: Identity | None, word: str = "kept") -> Path:
    """Rename a file to `target`, or to a free name like it if another file than `before` is there.

    Returns:
        Its new name.

    Raises:
        OSError: It cannot be renamed.
    """
    if before is not None and Identity.of(target) in (before, None):
        os.replace(part, target)
        return target
    place = target
    while True:
        try:
            _rename_to_new(part, place)
            return place
        except FileExistsError:
            place = free_name(target, word)


def free_name(path: Path, word: str) -> Path:
    """Return a name, or the first free one like it: NAME.word.mcap, NAME.word.2.mcap and so on."""
    found, number = path, 1
    while os.path.lexists(found):
        count = "" if number == 1 else f".{number}"
        found, number = path.with_name(f"{path.stem}.{word}{count}{path.suffix}"), number + 1
    return found


def kept_both(path: Path, placed: Path) -> str:
    """Return the line about a file that was written under another name, as its own was taken."""
    shown = placed if path.is_symlink() else path.with_name(placed.name)
    return f"{path}: another file is there by now, and stays; what was to be written is {shown}"


def _rename_to_new(part: Path, name: Path) -> None:
    """Rename a file without replacing another, as a hard link can; some file systems have none."""
    try:
        os.link(part, name)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        os.close(os.open(name, flags("O_WRONLY", "O_CREAT", "O_EXCL")))
        os.replace(part, name)
    else:
        os.unlink(part)


_NO_LINKS = errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK
"""Errors of file systems without hard links, such as FAT."""


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


def _nearest(path: Path) -> str:
    """Return the question about a file of the same folder and kind that was probably meant; empty without."""
    with suppress(OSError):
        there = [Path(name).stem for name in os.listdir(path.parent) if Path(name).suffix == path.suffix]
        for stem in get_close_matches(path.stem, there, n=1):
            return f"; did you mean {str(path.with_stem(stem))!r}?"
    return ""


def _check_regular(found: os.stat_result) -> None:
    if stat.S_ISDIR(found.st_mode):
        reason = os.strerror(errno.EISDIR)
        raise IsADirectoryError(errno.EISDIR, f"{reason}; expected the name of a file")
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "this is no regular file; expected the name of a file")
