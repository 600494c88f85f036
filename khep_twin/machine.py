"""Differences between operating systems: locks of files, flags of `os.open`, limits, cores, priorities.

Modules that a system lacks are None here. Linux is tested, macOS and Windows are not (docs/install.md).
"""

import os
import sys
from contextlib import suppress
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

_LOCKED_BYTE = 1 << 40
"""Locked byte of a file on systems that lock bytes; other processes may use the bytes before it."""

_forks: list[int] = []
"""Process ids of the forks that led to this process since this module was imported."""
if sys.platform != "win32":
    os.register_at_fork(after_in_child=lambda: _forks.append(os.getpid()))


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
        try:
            _lock_byte(descriptor, _msvcrt.LK_LOCK if waits else _msvcrt.LK_NBLCK)
        except PermissionError as error:
            raise BlockingIOError(*error.args) from None


def unlock(file: IO[Any] | int) -> None:
    """Unlock a file that is locked."""
    descriptor = file if isinstance(file, int) else file.fileno()
    if _fcntl is not None:
        _fcntl.flock(descriptor, _fcntl.LOCK_UN)
    elif _msvcrt is not None:
        _lock_byte(descriptor, _msvcrt.LK_UNLCK)


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


def _lock_byte(descriptor: int, kind: int) -> None:
    """Lock or unlock one byte of a file on Windows, where locks start at the current position."""
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
    try:
        _msvcrt.locking(descriptor, kind, 1)
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)
