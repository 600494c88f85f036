"""Threads and an event loop of one simulated program; each thread is a process of the kernel.

asyncio's loop, tasks and futures run unchanged; only its clock and its waiting are the simulated kernel's.
"""

import asyncio
import inspect
from asyncio import events
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from checks.simulate.kernel import NS_PER_S, OpenFile, Process
from checks.simulate.simulation import Simulation

REQUEST: ContextVar[object] = ContextVar("REQUEST", default=None)
"""Request that a task of the loop answers."""


class Group:
    """Threads of one program, which die together.

    Attributes:
        name: Name of the program.
        threads: All threads that run.
        alive: False once it was killed, or has ended.
        requests: Requests that threads carry out, by thread.
    """

    def __init__(self, simulation: Simulation, name: str, died: Callable[[], object]) -> None:
        self.simulation, self.name, self._died = simulation, name, died
        self.threads: list[Process] = []
        self.alive = True
        self.requests: dict[Process, Any] = {}
        self._n_threads = 0

    def thread(self, name: str, function: Callable[[], object], ended: Callable[[], object]) -> Process:
        """Start a thread."""
        self._n_threads += 1
        process = self.simulation.spawn(f"{self.name} {name} {self._n_threads}", function)
        process.group = self  # type: ignore[attr-defined]
        self.threads.append(process)

        def end(process: Process) -> None:
            self.threads.remove(process)
            self.requests.pop(process, None)
            if process.dying:
                self.kill()
            else:
                self.simulation.check_end(process)
            ended()

        process.on_end = end
        return process

    def kill(self) -> None:
        """Kill all threads together."""
        if self.alive:
            self.alive = False
            for thread in [*self.threads]:
                self.simulation.kernel.kill(thread)
            self._died()


class Threading:
    """Functions of the module `threading` for the program of the calling thread."""

    def __init__(self, simulation: Simulation) -> None:
        kernel = simulation.kernel

        class Event:
            def __init__(self) -> None:
                self._file, self._set = OpenFile(kernel), False

            def is_set(self) -> bool:
                return self._set

            def set(self) -> None:
                self._set = True
                self._file.changed()

            def clear(self) -> None:
                self._set = False

            def wait(self, timeout: float | None = None) -> bool:
                deadline_ns = None if timeout is None else kernel.now_ns + round(timeout * NS_PER_S)
                kernel.called()
                return kernel.wait([self._file], self.is_set, deadline_ns) or self._set

        class RLock:
            owner: Process | None = None
            count = 0

            def __init__(self) -> None:
                self._file = OpenFile(kernel)

            def acquire(self, blocking: bool = True) -> bool:
                if (process := kernel.current) is None:
                    return True
                if self.owner is not process:
                    kernel.called()
                    if self.owner is not None and not blocking:
                        return False
                    kernel.wait([self._file], lambda: self.owner is None, None)
                    self.owner = process
                self.count += 1
                return True

            def release(self) -> None:
                if kernel.current is self.owner and self.owner is not None:
                    self.count -= 1
                    if not self.count:
                        self.owner = None
                        self._file.changed()

            def __enter__(self) -> bool:
                return self.acquire()

            def __exit__(self, *_: object) -> None:
                self.release()

        class Thread:
            def __init__(self, target: Callable[[], object], name: str = "", daemon: bool = False) -> None:
                self._target, self._name = target, name
                self._file = OpenFile(kernel)
                self._process: Process | None = None

            def start(self) -> None:
                group: Group = kernel.called().group  # type: ignore[attr-defined]
                self._process = group.thread(self._name, self._target, self._file.changed)

            def is_alive(self) -> bool:
                return self._process is not None and self._process.alive

            def join(self, timeout: float | None = None) -> None:
                deadline_ns = None if timeout is None else kernel.now_ns + round(timeout * NS_PER_S)
                kernel.called()
                kernel.wait([self._file], lambda: not self.is_alive(), deadline_ns)

        self.Event, self.RLock, self.Lock, self.Thread = Event, RLock, RLock, Thread
        self.main_thread = object

    def install(self, shim: Any) -> None:
        """Put them into the simulated module."""
        for name, value in vars(self).items():
            setattr(shim, name, value)


class Loop(asyncio.BaseEventLoop):
    """asyncio's event loop on the simulated kernel."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__()
        self._kernel = simulation.kernel
        self._file = OpenFile(self._kernel)
        self._woken = False
        self._selector = self
        self.trouble: BaseException | None = None
        self.set_exception_handler(self._noted)

    def run(self) -> None:
        """Run until the process is killed."""
        events._set_running_loop(self)
        try:
            while True:
                self._run_once()  # type: ignore[attr-defined]
        finally:
            events._set_running_loop(None)

    def close(self) -> None:
        """Forget all tasks; Python would warn of those that a kill has ended, or has kept from beginning."""
        self.set_exception_handler(lambda *_: None)
        for task in asyncio.all_tasks(self):
            coroutine = task.get_coro()
            if inspect.iscoroutine(coroutine) and inspect.getcoroutinestate(coroutine) == "CORO_CREATED":
                coroutine.close()
        super().close()

    def time(self) -> float:
        """Return the simulated time [s]."""
        return self._kernel.now_ns / NS_PER_S

    def select(self, timeout: float | None) -> list[Any]:
        """Wait for other threads, or for the next timer."""
        events._set_running_loop(None)
        deadline_ns = None if timeout is None else self._kernel.now_ns + round(timeout * NS_PER_S)
        self._kernel.called()
        self._kernel.wait([self._file], lambda: self._woken, deadline_ns)
        self._woken = False
        events._set_running_loop(self)
        return []

    def _process_events(self, event_list: Any) -> None:
        pass

    def _write_to_self(self) -> None:
        self._woken = True
        self._file.changed()

    def _noted(self, _: Any, context: dict[str, Any]) -> None:
        self.trouble = context.get("exception") or RuntimeError(context["message"])
