"""Differences between operating systems: open files, locks, waits, flags of `os.open`, limits, priorities.

Modules that a system lacks are None here. Linux is tested, macOS and Windows are not (docs/install.md).
"""

import errno
import importlib.util
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

_fcntl: Any = None
_msvcrt: Any = None
_resource: Any = None
with suppress(ImportError):
    import fcntl

    _fcntl = fcntl
with suppress(ImportError):
    import msvcrt

    _msvcrt = msvcrt
with suppress(ImportError):
    import resource

    _resource = resource

RENAMES_OPEN_FILES = sys.platform != "win32"
"""Whether a file can be renamed and removed while a process has it open."""

_READERS_S = 2.0
"""Longest wait for other processes to close a file that is renamed or removed (assumed) [s]."""

_RETRY_INTERVAL_S = 0.05

FOLDER_LOCK = ".lock"
"""Name of the file that is locked in place of its folder, on systems that cannot open folders."""

_WAITS_FOR_FILES = sys.platform != "win32"
"""Whether `select` also waits for files, such as standard input, and not only for sockets."""

_LOCKED_BYTE = 1 << 40
"""Locked byte of a file on systems that lock bytes; other processes may use the bytes before it."""

_forks: list[int] = []
"""Process ids of the forks that led to this process since this module was imported."""
if sys.platform != "win32":
    os.register_at_fork(after_in_child=lambda: _forks.append(os.getpid()))


def name_glfw() -> None:
    """Name the library of GLFW on Linux, unless the user does.

    Otherwise its Python package, which mujoco imports, starts a process to read the library's version. A
    process takes 0.1 s.
    """
    package = importlib.util.find_spec("glfw") if sys.platform == "linux" else None
    if package is None or package.origin is None or os.environ.get("PYGLFW_LIBRARY_VARIANT"):
        return
    variant = "wayland" if os.environ.get("XDG_SESSION_TYPE") == "wayland" else "x11"
    path = Path(package.origin).parent / variant / "libglfw.so"
    if path.exists():
        os.environ.setdefault("PYGLFW_LIBRARY", str(path))


def n_forks() -> int:
    """Return the number of forks that lead to this process; a fork of it has one more."""
    return len(_forks)


def flags(*names: str) -> int:
    """Return flags of `os.open` together, without those that the system lacks; files are binary."""
    return sum(getattr(os, name, 0) for name in {"O_BINARY", *names})


def lock(file: IO[Any] | int, *, shared: bool = False, waits: bool = False) -> None:
    """Lock an open file until it is closed; without any kind of locks on the system, do nothing.

    Args:
        file: Open file, or its descriptor.
        shared: True for a lock that other processes may share; not on Windows.
        waits: True to wait for other processes.

    Raises:
        BlockingIOError: Another process has locked it.
        OSError: Its file system has no locks.
    """
    descriptor = file if isinstance(file, int) else file.fileno()
    if _fcntl is not None:
        kind = _fcntl.LOCK_SH if shared else _fcntl.LOCK_EX
        _fcntl.flock(descriptor, kind if waits else kind | _fcntl.LOCK_NB)
    elif _msvcrt is not None:
        # LK_LOCK gives up after 10 s.
        while not _try_lock_byte(descriptor):
            if not waits:
                raise BlockingIOError(errno.EWOULDBLOCK, "another process has locked the file")
            time.sleep(_RETRY_INTERVAL_S)


def unlock(file: IO[Any] | int) -> None:
    """Unlock a file that is locked."""
    descriptor = file if isinstance(file, int) else file.fileno()
    if _fcntl is not None:
        _fcntl.flock(descriptor, _fcntl.LOCK_UN)
    elif _msvcrt is not None:
        _lock_byte(descriptor, _msvcrt.LK_UNLCK)


def rename(source: Path, target: Path) -> None:
    """Rename a file, and replace another one of the new name; on Windows, wait for their readers.

    Raises:
        OSError: It cannot be renamed.
    """
    _retry_while_open(partial(os.replace, source, target))


def remove(path: Path) -> None:
    """Remove a file if it exists; on Windows, wait for its readers.

    Raises:
        OSError: It cannot be removed.
    """
    _retry_while_open(partial(path.unlink, missing_ok=True))


def open_folder(folder: Path) -> int:
    """Return a descriptor to lock a folder by: the folder's, or that of its file `FOLDER_LOCK`.

    Raises:
        OSError: It cannot be opened.
    """
    if sys.platform == "win32":
        return os.open(folder / FOLDER_LOCK, flags("O_RDWR", "O_CREAT"))
    return os.open(folder, os.O_RDONLY)


def wait_readable(descriptors: Collection[int], timeout_s: float) -> Sequence[int]:
    """Wait at most `timeout_s` [s] until a descriptor is readable; return those that are.

    On Windows, all must be sockets.
    """
    if not descriptors:  # which select refuses on Windows
        time.sleep(timeout_s)
        return ()
    return select.select(descriptors, [], [], timeout_s)[0]


def read_byte(descriptor: int, timeout_s: float) -> bytes | None:
    """Return the next byte of an input, empty at its end; None if none comes within `timeout_s` [s].

    On Windows, a thread reads the input, also beyond this byte.
    """
    if _WAITS_FOR_FILES:
        return os.read(descriptor, 1) if wait_readable([descriptor], timeout_s) else None
    if (input_bytes := _input_bytes.get(descriptor)) is None:
        input_bytes = _input_bytes[descriptor] = queue.SimpleQueue()
        threading.Thread(target=_read_all, args=(descriptor, input_bytes), daemon=True).start()
    try:
        byte = input_bytes.get(timeout=timeout_s)
    except queue.Empty:
        return None
    if not byte:
        del _input_bytes[descriptor]
    return byte


_input_bytes: dict[int, "queue.SimpleQueue[bytes]"] = {}
"""Bytes that threads have read, by the input's descriptor."""


def is_writable(descriptor: int) -> bool:
    """Return whether a descriptor is open for writing; without fcntl, whether it is open.

    Raises:
        OSError: It is not open.
    """
    if _fcntl is None:
        return bool(os.fstat(descriptor))
    mode = os.O_RDONLY | os.O_WRONLY | os.O_RDWR
    return _fcntl.fcntl(descriptor, _fcntl.F_GETFL) & mode != os.O_RDONLY


def n_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def open_files_limit(minimum: int = 0) -> int:
    """Return the number of files that this process may have open; raise it to `minimum` if allowed."""
    if _resource is None:
        return sys.maxsize
    soft, hard = (
        sys.maxsize if limit == _resource.RLIM_INFINITY else limit
        for limit in _resource.getrlimit(_resource.RLIMIT_NOFILE)
    )
    if soft < minimum:
        soft = min(hard, minimum)
        _resource.setrlimit(_resource.RLIMIT_NOFILE, (soft, hard))
    return soft


def lower_priority(process: int = 0, by: int = 19) -> None:
    """Lower the priority of a process; on Windows do nothing.

    Args:
        process: Number of the process; 0 for this one.
        by: Steps by which its priority is lowered, up to 19.
    """
    if sys.platform != "win32":
        priority = os.getpriority(os.PRIO_PROCESS, process) + by
        os.setpriority(os.PRIO_PROCESS, process, min(priority, 19))


def _retry_while_open(act: Callable[[], None]) -> None:
    """Rename or remove a file; on Windows, repeat it while another process has the file open."""
    deadline_s = time.monotonic() + _READERS_S
    while True:
        try:
            return act()
        except PermissionError:
            if RENAMES_OPEN_FILES or time.monotonic() > deadline_s:
                raise
            time.sleep(_RETRY_INTERVAL_S)


def _read_all(descriptor: int, input_bytes: "queue.SimpleQueue[bytes]") -> None:
    """Read an input byte by byte until its end."""
    byte = b"-"
    while byte:
        byte = os.read(descriptor, 1)
        input_bytes.put(byte)


def _try_lock_byte(descriptor: int) -> bool:
    """Lock one byte of a file on Windows; return False if another process has locked it."""
    try:
        _lock_byte(descriptor, _msvcrt.LK_NBLCK)
    except PermissionError:
        return False
    return True


def _lock_byte(descriptor: int, kind: int) -> None:
    """Lock or unlock one byte of a file on Windows, where locks start at the current position."""
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
    try:
        _msvcrt.locking(descriptor, kind, 1)
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)
