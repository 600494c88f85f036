"""Simulated inotify: events of hosts at terminals, in the kernel's order."""

# The functions of open files are the system's, which documents them.
# ruff: noqa: D102

import ctypes
import errno
import os
import struct
from types import SimpleNamespace
from typing import Any

from checks.simulate.kernel import Kernel, OpenFile
from checks.simulate.system import Shim

IN_MODIFY, IN_CLOSE_WRITE, IN_CLOSE_NOWRITE, IN_OPEN, IN_Q_OVERFLOW = 0x02, 0x08, 0x10, 0x20, 0x4000

MOST_EVENTS = 256
"""Events that an instance keeps before it reports an overflow; Linux keeps 16384."""

MOST_MERGED = 0.1
"""Highest probability that an act is merged with an equal one within `_AT_ONCE_NS`."""

_AT_ONCE_NS = 100_000
"""Time within which two acts on two processors may be reported together (assumed) [ns]."""

_HEAD = struct.Struct("iIII")


class Instance(OpenFile):
    """An instance of inotify.

    Attributes:
        watches: Watched paths, with their kinds of event and numbers.
        events: Events that were not read, the oldest first.
    """

    def __init__(self, notices: "Notices") -> None:
        super().__init__(notices.kernel)
        self.blocking = False
        self.watches: dict[str, tuple[int, int]] = {}
        self.events: list[bytes] = []
        self._notices = notices

    def readable(self) -> bool:
        return bool(self.events)

    def read(self, limit: int) -> bytes:
        if not self.events:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        data = b""
        while self.events and len(data) + len(self.events[0]) <= limit:
            data += self.events.pop(0)
        if not data:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return data

    def closed(self) -> None:
        self._notices.instances.remove(self)

    def report(self, path: str, kind: int) -> None:
        """Add the events of one act: that of the folder's watch, then that of the file's."""
        folder, name = os.path.split(path)
        if watch := self.watches.get(folder):
            padded = name.encode() + bytes(16 - len(name) % 16)
            self._add(watch, kind, padded)
        if watch := self.watches.get(path):
            self._add(watch, kind, b"")

    def _add(self, watch: tuple[int, int], kind: int, name: bytes) -> None:
        number, mask = watch
        if not kind & mask:
            return
        if len(self.events) >= MOST_EVENTS:
            event = _HEAD.pack(-1, IN_Q_OVERFLOW, 0, 0)
        else:
            event = _HEAD.pack(number, kind, 0, len(name)) + name
        if event in self.events[-1:]:
            return
        self.events.append(event)
        self.changed()


class Notices(Shim):
    """Module `ctypes`, of whose C library the functions of inotify are simulated."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(ctypes, kernel)
        self.instances: list[Instance] = []
        self._last: tuple[str, int, int] = "", 0, 0

    def CDLL(self, name: str | None, **_: Any) -> Any:
        """Return the C library."""
        return SimpleNamespace(inotify_init1=self._init, inotify_add_watch=self._add_watch)

    def report(self, path: str, kind: int) -> None:
        """Report an act on a path to all instances; two acts on two processors may be merged."""
        kernel, (last_path, last_kind, last_ns) = self.kernel, self._last
        self._last = path, kind, kernel.now_ns
        at_once = (path, kind) == (last_path, last_kind) and kernel.now_ns - last_ns < _AT_ONCE_NS
        if at_once and kernel.faults.happens("merged event", "inotify", MOST_MERGED):
            return
        for instance in self.instances:
            instance.report(path, kind)

    def _init(self, _: int) -> int:
        process = self.kernel.called()
        self.instances.append(instance := Instance(self))
        return process.opened(instance)

    def _add_watch(self, descriptor: int, path: bytes, kinds: int) -> int:
        instance = self.kernel.called().file(descriptor)
        assert isinstance(instance, Instance)
        number = len(instance.watches) + 1
        instance.watches[path.decode()] = number, kinds
        return number
