"""Simulated inotify for terminals: what `khep_twin.ports.event_sources` calls by ctypes.

Equal events that follow each other are merged, as Linux does. Events of two processes at the same moment come
in any order, as on two processors.
"""

# ruff: noqa: D102

import ctypes
import errno
import os
import struct
from typing import Any

from tools.simulate.kernel import Kernel, OpenFile
from tools.simulate.system import Shim

_MODIFY, _CLOSE_WRITE, _CLOSE_NOWRITE, _OPEN, _OVERFLOW = 0x02, 0x08, 0x10, 0x20, 0x4000
_HEAD = struct.Struct("iIII")
_LONGEST = 16384
"""Events that a queue holds; Linux's default."""

_LATE_NS = 400
"""Longest delay of an event [ns] (assumed); the next call of its process begins later."""

MOST_LOST = 1e-4
"""Highest probability that an event finds no room in the queue."""


class Watches:
    """All watches on terminals and on their directory.

    Args:
        kernel: Kernel.
        folder: Directory of the terminals.
    """

    def __init__(self, kernel: Kernel, folder: str) -> None:
        self._kernel, self._folder = kernel, folder
        self.watchers: list[Inotify] = []

    def opened(self, path: str) -> None:
        """Report that a terminal was opened."""
        self._report(path, _OPEN)

    def written(self, path: str) -> None:
        """Report that a terminal was written."""
        self._report(path, _MODIFY)

    def closed(self, path: str, writes: bool) -> None:
        """Report that a terminal was closed."""
        self._report(path, _CLOSE_WRITE if writes else _CLOSE_NOWRITE)

    def _report(self, path: str, mask: int) -> None:
        kernel = self._kernel
        for each in self.watchers:
            order = kernel.delays.randrange(8)
            if order > 1:
                each.add(self._folder, mask, os.path.basename(path))
                each.add(path, mask, "")
                continue
            # Another processor may come between the two, or before both.
            if order:
                each.add(self._folder, mask, os.path.basename(path))
            due_ns = kernel.now_ns + kernel.delays.randrange(_LATE_NS)
            kernel.at(due_ns, lambda each=each, order=order: self._add_late(each, path, mask, order))

    def _add_late(self, watcher: "Inotify", path: str, mask: int, order: int) -> None:
        if not order:
            watcher.add(self._folder, mask, os.path.basename(path))
        watcher.add(path, mask, "")


class Inotify(OpenFile):
    """Queue of events."""

    def __init__(self, kernel: Kernel, watches: Watches) -> None:
        super().__init__(kernel)
        self._watches = watches
        self._masks: dict[str, tuple[int, int]] = {}
        self._queue: list[tuple[int, int, str]] = []
        watches.watchers.append(self)

    def watch(self, path: str, mask: int) -> int:
        """Watch a path; return the number of the watch."""
        number = len(self._masks) + 1
        self._masks[path] = number, mask
        return number

    def add(self, path: str, mask: int, name: str) -> None:
        """Add an event if its path is watched for such."""
        number, wanted = self._masks.get(path, (0, 0))
        if not mask & wanted:
            return
        event = number, mask, name
        full = len(self._queue) >= _LONGEST
        if full or self.kernel.faults.happens("lost_event", "inotify", MOST_LOST):
            event = -1, _OVERFLOW, ""
        if not self._queue or self._queue[-1] != event:
            self._queue.append(event)
        self.changed()

    def readable(self) -> bool:
        return bool(self._queue)

    def read(self, limit: int) -> bytes:
        if not self._queue:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        data = b""
        while self._queue:
            number, mask, name = self._queue[0]
            # The name ends in at least one zero and fills whole heads.
            size = -(-(len(name) + 1) // _HEAD.size) * _HEAD.size if name else 0
            packed = _HEAD.pack(number, mask, 0, size) + name.encode().ljust(size, b"\0")
            if len(data) + len(packed) > limit:
                break
            data += packed
            del self._queue[0]
        if not data:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return data

    def closed(self) -> None:
        self._watches.watchers.remove(self)


class SimulatedCtypes(Shim):
    """Module `ctypes`, whose C library has the simulated functions."""

    def __init__(self, kernel: Kernel, watches: Watches) -> None:
        super().__init__(ctypes, kernel)
        self._watches = watches

    def CDLL(self, name: str | None, **options: Any) -> Any:
        if name is None and self.kernel.current is not None:
            return _Library(self.kernel, self._watches)
        return ctypes.CDLL(name, **options)


class _Library:
    """C library."""

    def __init__(self, kernel: Kernel, watches: Watches) -> None:
        self._kernel, self._watches = kernel, watches

    def inotify_init1(self, flags: int) -> int:
        process = self._kernel.called()
        queue = Inotify(self._kernel, self._watches)
        queue.blocking = not flags & os.O_NONBLOCK
        return process.opened(queue)

    def inotify_add_watch(self, descriptor: int, path: bytes, mask: int) -> int:
        file = self._kernel.called().file(descriptor)
        assert isinstance(file, Inotify)
        return file.watch(path.decode(), mask)
