"""Simulation of Windows, for khep_twin's modules in a separate process.

Importing this module gives them other modules `sys`, `os`, `select` and `signal`, and a `msvcrt`. In the
whole process, files that are open cannot be renamed, replaced or removed, as on Windows.
"""

import builtins
import errno
import fcntl
import os
import select
import signal
import socket
import stat
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType, SimpleNamespace
from typing import Any

MISSING_MODULES = {"fcntl", "termios", "tty", "pty", "resource", "curses", "grp", "pwd"}

MISSING_NAMES = {
    "os": {
        *("fork", "forkpty", "register_at_fork", "wait", "waitid", "killpg", "setsid", "getpgid", "openpty"),
        *(
            "getuid",
            "geteuid",
            "getgid",
            "ttyname",
            "ctermid",
            "sched_getaffinity",
            "getpriority",
            "setpriority",
        ),
        *(
            "nice",
            "mkfifo",
            "mknod",
            "chown",
            "fchown",
            "pread",
            "pwrite",
            "writev",
            "readv",
            "statvfs",
            "sync",
        ),
        *("uname", "getloadavg", "posix_fadvise", "posix_fallocate", "pipe2", "eventfd", "memfd_create"),
        *(
            "O_NONBLOCK",
            "O_NOCTTY",
            "O_CLOEXEC",
            "O_DIRECTORY",
            "O_NOFOLLOW",
            "O_SYNC",
            "PRIO_PROCESS",
            "WNOHANG",
        ),
    },
    "select": {"poll", "epoll", "POLLIN", "POLLHUP"},
    "signal": {
        *("SIGKILL", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGCONT", "SIGURG", "SIGCHLD", "SIGALRM", "SIGUSR1"),
        *("pthread_sigmask", "pthread_kill", "sigwait", "siginterrupt", "setitimer", "alarm", "pause"),
    },
    "sys": set[str](),
}

File = int | socket.socket
Files = Sequence[File]

_real_import = builtins.__import__


class _Module(ModuleType):
    """Module of Windows: that of this system without some names, and with others."""

    def __init__(self, module: ModuleType, **replacements: Any) -> None:
        vars(self).update(replacements, _module=module, __name__=module.__name__)

    def __getattr__(self, name: str) -> Any:
        """Return a name of this system's module."""
        if name in MISSING_NAMES[self.__name__]:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(vars(self)["_module"], name)

    def __setattr__(self, name: str, value: object) -> None:
        """Set a name of this system's module, for example sys.stdout."""
        setattr(vars(self)["_module"], name, value)


def _open(path: str | os.PathLike[str], flags: int, mode: int = 0o777) -> int:
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    return os.open(path, flags, mode)


def _fsync(file: int) -> None:
    if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "Bad file descriptor")
    os.fsync(file)


def _select(
    readers: Files, writers: Files, exceptional: Files, timeout: float | None = None
) -> tuple[Files, Files, Files]:
    files = [*readers, *writers, *exceptional]
    if not files:
        raise OSError(10022, "An invalid argument was supplied")
    for file in files:
        if not stat.S_ISSOCK(os.fstat(file if isinstance(file, int) else file.fileno()).st_mode):
            raise OSError(10038, "An operation was attempted on something that is not a socket")
    return select.select(readers, writers, exceptional, timeout)


def _locking(file: int, kind: int, n_bytes: int) -> None:
    assert n_bytes == 1
    try:
        fcntl.flock(file, fcntl.LOCK_UN if kind == 0 else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if kind == _MODULES["msvcrt"].LK_LOCK:  # after ten attempts within 10 s
            raise OSError(errno.EDEADLK, "Resource deadlock avoided") from None
        raise PermissionError(errno.EACCES, "Permission denied") from None


_MODULES = {
    "sys": _Module(sys, platform="win32"),
    "os": _Module(os, open=_open, fsync=_fsync, name="nt"),
    "select": _Module(select, select=_select),
    "signal": _Module(signal),
    "msvcrt": SimpleNamespace(locking=_locking, LK_UNLCK=0, LK_LOCK=1, LK_NBLCK=2),
}


def _import(name: str, globals: dict[str, Any] | None = None, *rest: Any, **named: Any) -> Any:
    # The modules that others need, such as pyserial on this system, stay.
    if str((globals or {}).get("__name__", "")).startswith("khep_twin"):
        if name.split(".")[0] in MISSING_MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name in _MODULES:
            return _MODULES[name]
    return _real_import(name, globals, *rest, **named)


def _open_paths() -> set[str]:
    """Return the paths of the files that this process has open, or mapped into its memory."""
    paths: set[str] = set()
    for descriptor in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            paths.add(os.readlink(f"/proc/self/fd/{descriptor}"))
    with open("/proc/self/maps") as maps:
        return paths.union(line.split(maxsplit=5)[5].rstrip() for line in maps if line.count("/"))


def _refuse(path: str | bytes | os.PathLike[str], folder: int) -> None:
    """Raise a `PermissionError` if a file, or one below a folder, is open."""
    start = "" if folder < 0 else os.readlink(f"/proc/self/fd/{folder}")
    path = os.path.realpath(os.path.join(start, os.fsdecode(path)))
    if folder < 0 and any(name == path or name.startswith(f"{path}/") for name in _open_paths()):
        raise PermissionError(errno.EACCES, "The process cannot access the file, as it is open", path)


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "os.rename":
        source, target, source_folder, target_folder = arguments
        _refuse(source, source_folder)
        _refuse(target, target_folder)
    elif event == "os.remove":
        _refuse(*arguments)


builtins.__import__ = _import
sys.addaudithook(_audit)
