"""Modules `threading` and `queue` on simulated threads: processes that share the files of another.

Without a process, for example where a scenario is set up, they are Python's.
"""

# The functions are Python's, which documents them.
# ruff: noqa: D102

import queue
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self

from checks.simulate.kernel import NS_PER_S, Kernel, OpenFile, Process
from checks.simulate.system import Shim


class SimulatedThreading(Shim):
    """Module `threading`, in which each process has a main thread."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(threading, kernel)

    def get_native_id(self) -> int:
        process = self.kernel.current
        return threading.get_native_id() if process is None else process.pid

    def Lock(self) -> Any:
        return threading.Lock() if self.kernel.current is None else Lock(self.kernel, reentrant=False)

    def RLock(self) -> Any:
        return threading.RLock() if self.kernel.current is None else Lock(self.kernel, reentrant=True)

    def Event(self) -> Any:
        return threading.Event() if self.kernel.current is None else Event(self.kernel)

    def Thread(self, *args: Any, **options: Any) -> Any:
        if self.kernel.current is None:
            return threading.Thread(*args, **options)
        return Thread(self.kernel, *args, **options)


class SimulatedQueue(Shim):
    """Module `queue`."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(queue, kernel)

    def Queue(self, maxsize: int = 0) -> Any:
        return queue.Queue(maxsize) if self.kernel.current is None else Queue(self.kernel)


class _Shared(OpenFile):
    """Object that several threads wait for; an open file, as the kernel's processes wait only for those."""

    def _wait(self, ready: Callable[[], bool], timeout: float | None) -> bool:
        kernel = self.kernel
        end_ns = None if timeout is None or timeout < 0 else kernel.now_ns + round(timeout * NS_PER_S)
        return kernel.wait([self], ready, end_ns)


class Lock(_Shared):
    """Object of `threading.Lock` or `threading.RLock`."""

    def __init__(self, kernel: Kernel, *, reentrant: bool) -> None:
        super().__init__(kernel)
        self._is_reentrant = reentrant
        self._holder: Process | None = None
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        process = self.kernel.current
        if self._holder is not None and not (self._is_reentrant and self._holder is process):
            if not blocking or not self._wait(lambda: self._holder is None, timeout):
                return False
        self._holder = process
        self._count += 1
        return True

    def release(self) -> None:
        self._count -= 1
        if self._count == 0:
            self._holder = None
            self.changed()

    def locked(self) -> bool:
        return self._holder is not None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class Event(_Shared):
    """Object of `threading.Event`."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(kernel)
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True
        self.changed()

    def clear(self) -> None:
        self._is_set = False

    def wait(self, timeout: float | None = None) -> bool:
        return self._wait(lambda: self._is_set, timeout)


class Queue(_Shared):
    """Object of `queue.Queue` without a limit."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(kernel)
        self._items: list[Any] = []

    def qsize(self) -> int:
        return len(self._items)

    def empty(self) -> bool:
        return not self._items

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        self._items.append(item)
        self.changed()

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        if block and not self._items:
            self._wait(lambda: bool(self._items), None if timeout is None else max(timeout, 0.0))
        if not self._items:
            raise queue.Empty
        return self._items.pop(0)


class Thread(_Shared):
    """Object of `threading.Thread`: a process that has the files of the one that started it."""

    def __init__(
        self,
        kernel: Kernel,
        group: None = None,
        target: Callable[..., object] | None = None,
        name: str | None = None,
        args: Iterable[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        *,
        daemon: bool | None = None,
    ) -> None:
        super().__init__(kernel)
        self.name, self.daemon = name or "thread", bool(daemon)
        self._target, self._args, self._options = target, tuple(args), dict(kwargs or {})
        self._process: Process | None = None

    def setDaemon(self, daemon: bool) -> None:
        self.daemon = daemon

    def setName(self, name: str) -> None:
        self.name = name

    @property
    def ident(self) -> int | None:
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        kernel = self.kernel
        kernel.called()
        self._process = kernel.spawn_thread(self.run)
        self._process.on_end = lambda _: self.changed()

    def run(self) -> None:
        if self._target is not None:
            self._target(*self._args, **self._options)

    def is_alive(self) -> bool:
        return self._process is not None and self._process.alive

    def join(self, timeout: float | None = None) -> None:
        self._wait(lambda: not self.is_alive(), timeout)
