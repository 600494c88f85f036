"""A disk with faults: full, failing, slow, read-only; a power cut removes unsynchronized changes.

Files are real ones in the simulation's folder. Their changes are also kept in the order of a journalling file
system, so that a power cut can undo them:

    names      creations, renames, links and removals survive up to some moment, in their order; an fsync
               of a file or of its folder makes its changes, and all before them, survive
    contents   data written to a file since its last fsync survives, or not, or up to some byte, or with
               blocks that hold zeros or the previous data
"""

# The functions are Python's, which documents them.
# ruff: noqa: D102

import errno
import os
from collections.abc import Callable
from typing import Any

from checks.simulate.disk_files import DiskFile, Journal, opened_buffered
from checks.simulate.kernel import FIRST_DESCRIPTOR, NS_PER_S, Process
from checks.simulate.simulation import Simulation

MAX_RATES = {
    "disk-error": 0.02,
    "disk-full": 0.02,
    "disk-read-only": 0.003,
    "disk-short": 0.2,
    "disk-slow": 0.05,
    "kill-at-disk": 0.03,
    "power-cut": 0.02,
}
"""Highest probability of each fault at a call."""


class Disk:
    """The disk below the files of a simulation; of mortal processes only, others find it in order.

    Args:
        simulation: Simulation whose folder it holds.

    Attributes:
        on_power_cut: Function called after the machine has lost its power, and is there again.
        cuts: Number of power cuts.
        failing: True while it is full or read-only.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation, self._kernel = simulation, simulation.kernel
        self._faults = simulation.faults
        self._root = os.path.realpath(simulation.folder)
        self._journal = Journal(self._root)
        self._open: dict[int, DiskFile] = {}
        self._full_until_ns = self._read_only_until_ns = 0
        self.on_power_cut: Callable[[], object] = lambda: None
        self.cuts = 0
        simulation.system.os.disk = self

    @property
    def failing(self) -> bool:
        return self._kernel.now_ns < max(self._full_until_ns, self._read_only_until_ns)

    # Calls of `os` -------------------------------------------------------------------------------------

    def holds(self, path: Any, dir_fd: int | None = None) -> bool:
        if isinstance(path, int):
            return path < FIRST_DESCRIPTOR and self._opened(path) is not None
        return self._is_below(_absolute(path, dir_fd))

    def open(self, path: Any, flags: int, mode: int = 0o666) -> int:
        process, name = self._kernel.current, _absolute(path)
        writes = bool(flags & (os.O_WRONLY | os.O_RDWR))
        fresh = bool(flags & os.O_CREAT) and not os.path.lexists(name)
        if process is not None:
            self._begin_call("open", changes=writes)
            fresh = bool(flags & os.O_CREAT) and not os.path.lexists(name)
        descriptor = os.open(path, flags, mode)
        target = os.path.realpath(name)
        if writes or os.path.isdir(target):
            if fresh:
                self._journal.created(target)
            self._open[descriptor] = file = self._journal.file(target)
            if flags & os.O_TRUNC:
                file.truncate(0)
            if process is not None:
                process.opened_real(descriptor)
        else:
            self._open.pop(descriptor, None)
        self._end_call("open", writes)
        return descriptor

    def open_buffered(self, path: Any, mode: str, *options: Any) -> Any:
        return opened_buffered(self._simulation.system.os, path, mode, *options)

    def write(self, descriptor: int, data: Any) -> int:
        view = memoryview(data).cast("B")
        if process := self._kernel.current:
            limit = self._begin_call("write", length=len(view))
            if limit is not None:
                view = view[:limit]
            assert descriptor in process.real
        place = os.lseek(descriptor, 0, os.SEEK_CUR)
        written = os.write(descriptor, view)
        self._open[descriptor].write(place, bytes(view[:written]))
        self._end_call("write")
        return written

    def call(self, name: str, *args: Any, **options: Any) -> Any:
        if self._kernel.current is not None:
            self._begin_call(name)
        result = getattr(os, name)(*args, **options)
        journal, dir_fd = self._journal, options.get("dir_fd")
        match name:
            case "unlink" | "remove" | "rmdir":
                journal.removed(_absolute(args[0], dir_fd))
            case "replace" | "rename":
                journal.renamed(_absolute(args[0]), _absolute(args[1]))
            case "link":
                journal.linked(_absolute(args[0]), _absolute(args[1]))
            case "mkdir":
                journal.created(_absolute(args[0]), folder=True)
            case "ftruncate":
                self._open[args[0]].truncate(args[1])
            case "truncate":
                journal.file(os.path.realpath(args[0])).truncate(args[1])
            case "fsync":
                if (file := self._opened(args[0])) is not None:
                    file.synchronize()
                    journal.synchronize(file)
            case "chmod":
                pass
            case _:
                raise NotImplementedError(name)
        self._end_call(name)
        return result

    def _opened(self, descriptor: int) -> DiskFile | None:
        """Return the file of a descriptor; one that is open for reading is found by its name."""
        process = self._kernel.current
        if descriptor in self._open and (process is None or descriptor in process.real):
            return self._open[descriptor]
        try:
            name = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:
            return None
        return self._journal.file(name) if self._is_below(name) and os.path.exists(name) else None

    def _is_below(self, name: str) -> bool:
        return name == self._root or name.startswith(f"{self._root}/")

    # Faults --------------------------------------------------------------------------------------------

    def _begin_call(self, call: str, length: int = 0, changes: bool = True) -> int | None:
        """Begin a call of the current process; return how many bytes it may write, None for all.

        Raises:
            OSError: The disk does not do it.
            Killed: The process, or the machine, ends here.
        """
        process = self._kernel.called()
        self._simulation.count("disk calls")
        if not process.mortal or not changes:
            return None
        self._kill("kill-at-disk", process)
        if self._happens("power-cut", process):
            self.cut()
        drawn = self._faults.drawn
        if self._happens("disk-slow", process):
            self._kernel.elapse(round(10 ** drawn("disk-slow", process.name).uniform(6, 9.8)))
        now_ns = self._kernel.now_ns
        limit = None
        if self._happens("disk-read-only", process):
            self._read_only_until_ns = now_ns + _duration_ns(drawn("disk-read-only", process.name).random())
        if now_ns < self._read_only_until_ns:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        if call == "write" and self._happens("disk-full", process):
            rng = drawn("disk-full", process.name)
            self._full_until_ns = now_ns + _duration_ns(rng.random())
            limit = rng.randrange(length) if length else 0
            if limit:  # the rest of the room
                return limit
        if now_ns < self._full_until_ns and call in ("write", "mkdir"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self._happens("disk-error", process):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if call == "write" and length > 1 and self._happens("disk-short", process):
            return drawn("disk-short", process.name).randrange(1, length)
        return limit

    def _end_call(self, call: str, changes: bool = True) -> None:
        """End a call; the power may be cut before the next one."""
        process = self._kernel.current
        if process is not None and process.mortal and changes and self._happens("power-cut", process):
            self.cut()

    def agrees(self) -> bool:
        """Return whether the real files equal those of this disk."""
        return self._journal.agrees()

    def _happens(self, kind: str, process: Process) -> bool:
        return self._faults.happens(kind, process.name, MAX_RATES[kind])

    def _kill(self, kind: str, process: Process) -> None:
        if self._happens(kind, process):
            self._kernel.kill(process)

    # Power cuts ----------------------------------------------------------------------------------------

    def cut(self) -> None:
        """Cut the machine's power: all processes end, and the disk may lose unsynchronized changes."""
        if self._kernel.current is None:
            self._lose()
            return
        self._kernel.at(self._kernel.now_ns, self._lose)
        self._kernel.kill(self._kernel.current)

    def _lose(self) -> None:
        self._kernel.stop_all()
        self.cuts += 1
        rng = self._simulation.rng("power cut", self.cuts)
        self._open.clear()
        self._full_until_ns = self._read_only_until_ns = 0
        survivors = self._journal.cut(rng)
        # By the real functions, which are no calls of this disk.
        for folder, folders, names in os.walk(self._root, topdown=False):
            for name in names:
                os.unlink(os.path.join(folder, name))
            for name in folders:
                os.rmdir(os.path.join(folder, name))
        written: dict[int, str] = {}
        for name, file in survivors.items():
            if file.is_folder:
                os.makedirs(name, exist_ok=True)
            elif (first := written.get(file.number)) is not None:
                os.link(first, name)
            else:
                with open(name, "wb") as real:
                    real.write(file.content)
                written[file.number] = name
        self.on_power_cut()


def _absolute(path: Any, dir_fd: int | None = None) -> str:
    """Return a path as it is named from the root, without following it."""
    name = os.fspath(path)
    if isinstance(name, bytes):
        name = os.fsdecode(name)
    if dir_fd is not None:
        name = os.path.join(os.readlink(f"/proc/self/fd/{dir_fd}"), name)
    folder, last = os.path.split(os.path.abspath(name))
    return os.path.join(os.path.realpath(folder), last)


def _duration_ns(share: float) -> int:
    """Return a duration from 0.1 s to 100 s [ns]."""
    return round(10 ** (3 * share - 1) * NS_PER_S)
