"""Safe reading of regular files, and atomic writing: a failed write leaves the previous file unchanged."""

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
from khep_twin.process.invocation import quoted
from khep_twin.process.machine import flags, remove, rename
from khep_twin.process.signals import block_signals, register_cleanup

_NO_HARD_LINKS = errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EINVAL
"""Errors of file systems without hard links, such as FAT; EINVAL is that of Windows."""

_NO_FOLDER_SYNC = errno.EINVAL, errno.ENOTSUP
"""Errors of file systems that cannot synchronize a folder, such as some network file systems."""


def open_regular(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file to read it; refuse devices, and pipes, which could block for ever.

    Raises:
        OSError: It cannot be opened, or is no regular file.
    """
    # Check before opening, as that may act on a device, and after, as the file may have been replaced.
    try:
        _check_regular(os.stat(path))
    except FileNotFoundError as error:
        raise FileNotFoundError(errno.ENOENT, f"{error.strerror}{_suggestion(path)}", str(path)) from None
    except ValueError as error:  # a name with a null byte, or with characters that no file name has
        raise OSError(errno.EINVAL, str(error), str(path)) from None
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


def resolve(path: Path) -> Path:
    """Return a path without symbolic links, which need not exist; circular links stay."""
    # Path.resolve raises another error for circular links, on some versions of Python only.
    return Path(os.path.realpath(path))


def is_same(path: Path, other: Path) -> bool:
    """Return whether two paths name the same file, which need not exist yet."""
    try:
        return resolve(path) == resolve(other) or path.samefile(other)
    except (OSError, ValueError):  # a missing file is not the same as any other
        return False


def unusable(path: StrPath) -> str:
    """Return the reason why a file cannot be written; empty if it can.

    Devices, pipes and directories are refused, as a rename would replace them.
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
        if not os.access(resolve(path).parent, os.W_OK):
            return f"nothing can be written in {path.parent}"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return ""


def write_atomic(path: Path, data: bytes, replace: bool = True) -> None:
    """Write a temporary file beside `path` and rename it when it is complete; a link is followed.

    A power failure leaves the previous or the new file; after the return, the new one.

    Raises:
        KhepTwinError: It cannot be written; the previous file is unchanged. Or `replace` is false, and a file
            that is not empty has appeared; the new one gets another name.
    """
    with block_signals(), atomic_file(path, replace) as file:
        file.write(data)


@contextmanager
def atomic_file(path: Path, replace: bool = True) -> Generator[BinaryIO]:
    """Open a temporary file that is renamed to `path` when it is complete; a link is followed.

    Raises:
        KhepTwinError: As `write_atomic`.
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
    """Open a file like `atomic_file`, for callers that report errors themselves.

    Raises:
        OSError: It cannot be written; the previous file is unchanged, unless the disk fails after the rename.
        KhepTwinError: With `replace` false, another file has appeared.
    """
    target = resolve(path)
    with block_signals():
        part = _new_part(target)
        remove_part = partial(remove, part)
        cancel_removal = register_cleanup(remove_part)
    try:
        with part.open("w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists() and (mode := target.stat().st_mode) != part.stat().st_mode:
            part.chmod(stat.S_IMODE(mode))
        final_path = target
        previous = Identity.of(target)
        if replace:
            rename(part, target)
        else:
            final_path = rename_into_place(part, target, previous if previous and not previous.size else None)
        synchronize_folder(target.parent)
        if final_path != target:
            raise KhepTwinError(name_taken_message(path, final_path))
    finally:
        remove_part()
        cancel_removal()


class Identity(NamedTuple):
    """Identity of a file, to notice that another one has replaced it."""

    device: int
    inode: int
    size: int
    changed_ns: int

    @classmethod
    def of(cls, path: Path) -> "Identity | None":
        """Return the identity of a file; None if there is none."""
        try:
            status = path.stat()
        except FileNotFoundError:
            return None
        return cls(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)


def rename_into_place(part: Path, target: Path, previous: Identity | None, infix: str = "kept") -> Path:
    """Rename a file to `target`, or to a similar free name if a file other than `previous` exists there.

    Returns:
        The new path.

    Raises:
        OSError: It cannot be renamed.
    """
    if previous is not None and Identity.of(target) in (previous, None):
        rename(part, target)
        return target
    path = target
    while True:
        try:
            _rename_to_new(part, path)
            return path
        except FileExistsError:
            path = free_name(target, infix)


def free_name(path: Path, infix: str) -> Path:
    """Return a path, or the first free one of NAME.infix.mcap, NAME.infix.2.mcap and so on."""
    candidate = path
    number = 1
    while os.path.lexists(candidate):
        count = "" if number == 1 else f".{number}"
        candidate, number = path.with_name(f"{path.stem}.{infix}{count}{path.suffix}"), number + 1
    return candidate


def name_taken_message(path: Path, final_path: Path) -> str:
    """Return the message that a file was written under another name, as another file took its name."""
    new_path = final_path if path.is_symlink() else path.with_name(final_path.name)
    return f"{path}: another file exists by now and is kept; the new one is {new_path}"


def _rename_to_new(part: Path, name: Path) -> None:
    """Rename a file without replacing another, by a hard link where the file system supports it."""
    try:
        os.link(part, name)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        os.close(os.open(name, flags("O_WRONLY", "O_CREAT", "O_EXCL")))
        rename(part, name)
    else:
        remove(part)


def synchronize_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, so that a rename survives a power failure.

    Raises:
        OSError: The disk fails.
    """
    try:
        descriptor = os.open(folder, flags("O_RDONLY", "O_DIRECTORY", "O_CLOEXEC"))
    except PermissionError:  # the folder is writable, but not readable
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def is_part(path: Path, target: Path) -> bool:
    """Return whether a path is the temporary file of `target`."""
    return path.parent == target.parent and path.name.startswith(f".{target.name}.part")


def _new_part(target: Path) -> Path:
    """Create an empty temporary file beside `target`, with a unique name."""
    number = 0
    while True:
        part = target.with_name(f".{target.name}.part{number or ''}")
        try:
            part.touch(exist_ok=False)
            return part
        except FileExistsError:
            number += 1


def _suggestion(path: Path) -> str:
    """Return a suggestion of a similar file name in the same folder; empty if there is none."""
    with suppress(OSError):
        stems = [Path(name).stem for name in os.listdir(path.parent) if Path(name).suffix == path.suffix]
        for stem in get_close_matches(path.stem, stems, n=1):
            return f"; did you mean {str(path.with_stem(stem))!r}?"
    return ""


def _check_regular(status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        reason = os.strerror(errno.EISDIR)
        raise IsADirectoryError(errno.EISDIR, f"{reason}; expected the name of a file")
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "this is no regular file; expected the name of a file")
