"""The simulated kernel in place of Python's modules of the operating system, in the modules that use them.

Descriptors below `FIRST_DESCRIPTOR`, and paths without a device, are real ones.
"""

# The functions are Python's, which documents them.
# ruff: noqa: D102

import errno
import fcntl
import io
import os
import select
import signal
import stat
import sys
import termios
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, Protocol
from unittest.mock import patch

from serial.serialutil import Timeout

from checks.simulate.kernel import FIRST_DESCRIPTOR, NS_PER_S, Kernel, OpenFile, Process

EPOCH_NS = 1_700_000_000 * NS_PER_S
"""Wall time at the start of a simulation [ns] (assumed)."""

TERMINALS = 136
"""Major number of the devices of pseudo-terminals."""

BEGIN_MODULES = "pathlib", "tempfile", "shutil", "serial.", "khep_twin."
"""Beginnings of the names of the modules that get the simulated system."""


LEFT_OUT = "__main__", "cli", "drawing", "envs", "episodes", "lab", "shadow", "toolbox", "viewer"
"""Parts of khep_twin that a scenario imports when it uses them."""


class Device(Protocol):
    """A path that is served by the simulated kernel."""

    def open(self, process: Process, flags: int) -> OpenFile:
        """Open it.

        Raises:
            OSError: It cannot be opened.
        """
        ...


class Storage(Protocol):
    """A disk that holds the files of a simulation."""

    def holds(self, path: Any, dir_fd: int | None = None) -> bool:
        """Return whether a path, or a descriptor, is of a file on it."""
        ...

    def open(self, path: Any, flags: int, mode: int) -> int:
        """Open a file."""
        ...

    def write(self, descriptor: int, data: Any) -> int:
        """Write to an open file."""
        ...

    def call(self, name: str, *args: Any, **options: Any) -> Any:
        """Call another function of `os`, by its name."""
        ...

    def open_buffered(self, path: Any, mode: str, *args: Any, **options: Any) -> Any:
        """Open a file as `io.open` does."""
        ...


class Terminals(Protocol):
    """Terminals of a simulation.

    Attributes:
        root: Folder in place of the machine's root.
    """

    root: str

    def make(self) -> tuple[int, int]:
        """Make a terminal; return the descriptors of its two sides."""
        ...

    def number_of(self, path: str) -> int | None:
        """Return the number of the terminal at a path; None for another file."""
        ...


class Shim:
    """A module of which some functions are simulated; all others are the real ones."""

    def __init__(self, module: ModuleType, kernel: Kernel) -> None:
        self._module = module
        self.kernel = kernel

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class System:
    """The simulated modules of one simulation.

    Args:
        kernel: Kernel below them.

    Attributes:
        devices: Devices by path.
        os: Simulated module `os`, which may have a disk.
        modules: Simulated modules by name.
    """

    def __init__(self, kernel: Kernel) -> None:
        self.devices: dict[str, Device] = {}
        self.os = SimulatedOs(kernel, self.devices)
        self.modules: dict[str, Any] = {
            "os": self.os,
            "io": SimulatedIo(self.os),
            "signal": SimulatedSignal(kernel),
            "select": SimulatedSelect(kernel),
            "time": SimulatedTime(kernel),
            "fcntl": SimulatedFcntl(kernel),
            "termios": SimulatedTermios(kernel),
        }

    @contextmanager
    def installed(self) -> Generator[None]:
        """Replace the modules in all modules of the product, of pyserial, and of pathlib.

        Raises:
            RuntimeError: A module was imported meanwhile, and has used the real system.
        """
        with ExitStack() as stack:
            replaced = {id(sys.modules[name]): simulated for name, simulated in self.modules.items()}
            for module in _users():
                # Some import a module under another name.
                for used, value in [*vars(module).items()]:
                    if (simulated := replaced.get(id(value))) is not None:
                        stack.enter_context(patch.object(module, used, simulated))
            # pyserial keeps the clock itself.
            stack.enter_context(patch.object(Timeout, "TIME", self.modules["time"].monotonic))
            before = _users()
            yield
            for module in _users():
                if module not in before and not self.modules.keys().isdisjoint(vars(module)):
                    raise RuntimeError(f"{module.__name__} was imported within a simulation; expected before")


class SimulatedOs(Shim):
    """Module `os`; calls of a dead process have no effect.

    Attributes:
        disk: Disk of the files; None for one without faults.
    """

    def __init__(self, kernel: Kernel, devices: Mapping[str, Device]) -> None:
        super().__init__(os, kernel)
        self._devices = devices
        self.disk: Storage | None = None
        self.terminals: Terminals | None = None

    def getpid(self) -> int:
        process = self.kernel.current
        return os.getpid() if process is None else process.leader.pid

    def open(self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        # A link leads to its device, as long as that is there.
        device = self._devices.get(os.path.realpath(path)) if self._devices else None
        if device is None and self.disk is not None and dir_fd is None and self.disk.holds(path):
            return self.disk.open(path, flags, mode)
        if self.kernel.current is None:
            return os.open(path, flags, mode, dir_fd=dir_fd)
        process = self.kernel.called()
        if device is not None:
            file = device.open(process, flags)
            file.blocking = not flags & os.O_NONBLOCK
            return process.opened(file)
        descriptor = os.open(path, flags, mode, dir_fd=dir_fd)
        # Others pass to an object of Python's, which closes them.
        if flags & (os.O_WRONLY | os.O_RDWR) or stat.S_ISDIR(os.fstat(descriptor).st_mode):
            process.opened_real(descriptor)
        return descriptor

    def close(self, descriptor: int) -> None:
        process = self.kernel.current
        if descriptor >= FIRST_DESCRIPTOR:
            # An object that goes with its process, or after it, has nothing left to close.
            if process is not None and not process.dying:
                self.kernel.called().close(descriptor)
            return
        if process is not None:
            self.kernel.called().real.pop(descriptor, None)
        os.close(descriptor)

    def read(self, descriptor: int, limit: int) -> bytes:
        if descriptor < FIRST_DESCRIPTOR:
            return os.read(descriptor, limit)
        file = self.kernel.called().file(descriptor)
        while True:
            if file.blocking:
                self.kernel.wait([file], file.readable, None)
            try:
                return file.read(limit)
            except BlockingIOError:  # another reader took the bytes
                if not file.blocking:
                    raise

    def write(self, descriptor: int, data: Any) -> int:
        if self.disk is not None and self.disk.holds(descriptor):
            return self.disk.write(descriptor, data)
        if descriptor < FIRST_DESCRIPTOR:
            if self.kernel.current is not None:
                self.kernel.called()
            return os.write(descriptor, data)
        file = self.kernel.called().file(descriptor)
        rest = bytes(data)
        if not file.blocking:
            return file.write(rest)
        while rest:
            self.kernel.wait([file], file.writable, None)
            rest = rest[file.write(rest) :]
        return len(data)

    def openpty(self) -> tuple[int, int]:
        assert self.terminals is not None, "a simulation without terminals"
        return self.terminals.make()

    def ttyname(self, descriptor: int) -> str:
        return str(self.kernel.called().file(descriptor).terminal.path)

    def stat(self, path: Any, *args: Any, **options: Any) -> Any:
        """Look at a file; the host side of a terminal is a device."""
        status = os.stat(path, *args, **options)
        if self.terminals is None or isinstance(path, int) or options.get("follow_symlinks") is False:
            return status
        number = self.terminals.number_of(os.path.realpath(path))
        if number is None:
            return status
        mode = stat.S_IFCHR | stat.S_IMODE(status.st_mode)
        return os.stat_result((mode, *status[1:10]), {"st_rdev": os.makedev(TERMINALS, number)})

    def readlink(self, path: Any, *, dir_fd: int | None = None) -> str:
        target = os.readlink(path, dir_fd=dir_fd)
        if self.kernel.current is not None:
            self.kernel.called()
        # The descriptors of the simulated /proc lead to the simulated /dev.
        if self.terminals is not None and os.fspath(path).startswith(f"{self.terminals.root}/proc/"):
            return target.removeprefix(self.terminals.root)
        return target

    def set_blocking(self, descriptor: int, blocking: bool) -> None:
        if descriptor < FIRST_DESCRIPTOR:
            os.set_blocking(descriptor, blocking)
        else:
            self.kernel.called().file(descriptor).blocking = blocking

    def pipe(self) -> tuple[int, int]:
        process = self.kernel.called()
        reader = _Pipe(self.kernel)
        return process.opened(reader), process.opened(_PipeEnd(reader))

    def _forward(name: str) -> Callable[..., Any]:  # type: ignore[misc]
        """Return a method that calls the real function, unless its process is dead."""

        def call(self: "SimulatedOs", *args: Any, **options: Any) -> Any:
            if self.disk is not None and self.disk.holds(args[0], options.get("dir_fd")):
                return self.disk.call(name, *args, **options)
            if self.kernel.current is not None:
                self.kernel.called()
            return getattr(os, name)(*args, **options)

        return call

    unlink, remove, symlink, link = map(_forward, ("unlink", "remove", "symlink", "link"))
    replace, rename, truncate = map(_forward, ("replace", "rename", "truncate"))
    ftruncate, fsync, pwrite = map(_forward, ("ftruncate", "fsync", "pwrite"))
    mkdir, rmdir, chmod = map(_forward, ("mkdir", "rmdir", "chmod"))


class _Pipe(OpenFile):
    """Reading end of a pipe."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(kernel)
        self.data = bytearray()
        self.writer_is_open = True

    def readable(self) -> bool:
        return bool(self.data) or not self.writer_is_open

    def read(self, limit: int) -> bytes:
        if not self.readable():
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        data = bytes(self.data[:limit])
        del self.data[:limit]
        return data


class _PipeEnd(OpenFile):
    """Writing end of a pipe."""

    def __init__(self, reader: _Pipe) -> None:
        super().__init__(reader.kernel)
        self._reader = reader

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:
        self._reader.data += data
        self._reader.changed()
        return len(data)

    def closed(self) -> None:
        self._reader.writer_is_open = False
        self._reader.changed()


class SimulatedIo(Shim):
    """Module `io`: files of Python's that are opened for writing write to the disk."""

    def __init__(self, system: SimulatedOs) -> None:
        super().__init__(io, system.kernel)
        self._os = system

    def open(self, path: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
        disk = self._os.disk
        if disk is None or not set("wxa+") & set(mode) or not disk.holds(path):
            return open(path, mode, *args, **options)
        return disk.open_buffered(path, mode, *args, **options)


class SimulatedSignal(Shim):
    """Module `signal`: simulated processes share one, which none may change."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(signal, kernel)

    def getsignal(self, number: int) -> Any:
        return signal.getsignal(number) if self.kernel.current is None else signal.SIG_DFL

    def signal(self, number: int, handler: Any) -> Any:
        return signal.signal(number, handler) if self.kernel.current is None else signal.SIG_DFL


class SimulatedSelect(Shim):
    """Module `select`."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(select, kernel)

    def select(
        self, readers: Iterable[Any], writers: Iterable[Any], _: Iterable[Any], timeout: float | None = None
    ) -> tuple[list[Any], list[Any], list[Any]]:
        kernel = self.kernel
        process = kernel.called()
        reading = [(reader, process.file(_number(reader))) for reader in readers]
        writing = [(writer, process.file(_number(writer))) for writer in writers]

        def ready() -> tuple[list[Any], list[Any], list[Any]]:
            return (
                [reader for reader, file in reading if file.readable() or file.hung_up()],
                [writer for writer, file in writing if file.writable() or file.hung_up()],
                [],
            )

        deadline_ns = None if timeout is None else kernel.now_ns + max(round(timeout * NS_PER_S), 0)
        kernel.wait([file for _, file in reading + writing], lambda: any(ready()), deadline_ns)
        return ready()

    def poll(self) -> "SimulatedPoll":
        return SimulatedPoll(self.kernel)


class SimulatedPoll:
    """Object of `select.poll`."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._masks: dict[int, int] = {}

    def register(self, descriptor: Any, mask: int = select.POLLIN | select.POLLPRI | select.POLLOUT) -> None:
        self._masks[_number(descriptor)] = mask

    def poll(self, timeout_ms: float | None = None) -> list[tuple[int, int]]:
        kernel = self._kernel
        process = kernel.called()
        files = {number: process.files.get(number) for number in self._masks}

        def poll_states() -> list[tuple[int, int]]:
            states: list[tuple[int, int]] = []
            for number, file in files.items():
                if file is None:
                    states.append((number, select.POLLNVAL))
                    continue
                mask = self._masks[number]
                state = (select.POLLIN if file.readable() else 0) | (select.POLLOUT if file.writable() else 0)
                state = (state & mask) | (select.POLLHUP if file.hung_up() else 0)
                if state:
                    states.append((number, state))
            return states

        if timeout_ms == 0:
            return poll_states()
        deadline_ns = (
            None if timeout_ms is None or timeout_ms < 0 else kernel.now_ns + round(timeout_ms * 1e6)
        )
        kernel.wait([file for file in files.values() if file], lambda: bool(poll_states()), deadline_ns)
        return poll_states()


class SimulatedTime(Shim):
    """Module `time`.

    Attributes:
        ahead_ns: Wall time beyond the one that has passed, as a clock that is set jumps [ns].
    """

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(time, kernel)
        self.ahead_ns = 0

    def monotonic_ns(self) -> int:
        return self.kernel.now_ns

    def monotonic(self) -> float:
        return self.kernel.now_ns / NS_PER_S

    perf_counter_ns, perf_counter = monotonic_ns, monotonic

    def time_ns(self) -> int:
        return EPOCH_NS + self.kernel.now_ns + self.ahead_ns

    def time(self) -> float:
        return self.time_ns() / NS_PER_S

    def sleep(self, duration: float) -> None:
        self.kernel.called()
        self.kernel.wait([], lambda: False, self.kernel.now_ns + round(duration * NS_PER_S))


class SimulatedFcntl(Shim):
    """Module `fcntl`."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(fcntl, kernel)

    def ioctl(self, descriptor: Any, request: int, argument: Any = 0, mutate: bool = True) -> Any:
        if (number := _number(descriptor)) < FIRST_DESCRIPTOR:
            return fcntl.ioctl(descriptor, request, argument, mutate)
        return _terminal_method(self.kernel, number, "ioctl")(request, argument)

    def fcntl(self, descriptor: Any, command: int, argument: Any = 0) -> Any:
        if (number := _number(descriptor)) < FIRST_DESCRIPTOR:
            return fcntl.fcntl(descriptor, command, argument)
        file = self.kernel.called().file(number)
        if command == fcntl.F_SETFL:
            file.blocking = not argument & os.O_NONBLOCK
        return 0 if file.blocking else os.O_NONBLOCK

    def flock(self, descriptor: Any, operation: int) -> None:
        if (number := _number(descriptor)) < FIRST_DESCRIPTOR:
            if self.kernel.current is not None:
                self.kernel.called()
            fcntl.flock(descriptor, operation)
        else:
            _terminal_method(self.kernel, number, "flock")(operation)


class SimulatedTermios(Shim):
    """Module `termios`: the functions ask the open file, which is a terminal's."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(termios, kernel)

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(termios, name)
        if not name.startswith("tc"):
            return attribute

        def call(descriptor: Any, *args: Any) -> Any:
            if (number := _number(descriptor)) < FIRST_DESCRIPTOR:
                return attribute(descriptor, *args)
            try:
                return _terminal_method(self.kernel, number, name)(*args)
            except OSError as error:
                raise termios.error(*error.args) from None

        return call


def load(package: str = "khep_twin") -> None:
    """Import a package and all in it: a module imported within a simulation would use the machine's calls."""
    module = import_module(package)
    for module_info in iter_modules(getattr(module, "__path__", ())):
        if module_info.name not in LEFT_OUT:
            load(f"{package}.{module_info.name}")


def _users() -> list[ModuleType]:
    """Return the modules that get the simulated system, as far as they are imported."""
    return [module for name, module in [*sys.modules.items()] if name.startswith(BEGIN_MODULES)]


def _terminal_method(kernel: Kernel, descriptor: int, name: str) -> Callable[..., Any]:
    """Return the method of an open file for a call; without one it is no terminal."""
    file = kernel.called().file(descriptor)
    method = getattr(file, name, None)
    if method is None:
        raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
    return method


def _number(descriptor: Any) -> int:
    return descriptor if isinstance(descriptor, int) else descriptor.fileno()


load()
# pyserial imports these when a port is opened.
for name in ("rfc2217", "socket"):
    import_module(f"serial.urlhandler.protocol_{name}")
