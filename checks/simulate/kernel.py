"""A simulated kernel: processes that run one at a time, time, descriptors, and waiting for them.

Each process is a greenlet that runs until it calls the kernel. A call takes a little simulated time, in which
another process may come first; only there can a process be stalled or killed. All times are integers, all
delays are drawn from streams of the seed.
"""

import heapq
import os
import random
from collections.abc import Callable, Iterable
from itertools import count
from typing import NoReturn

from greenlet import getcurrent, greenlet

from checks.simulate.faults import Faults, mixed

NS_PER_S = 1_000_000_000

FIRST_DESCRIPTOR = 10_000
"""Lowest number of a simulated descriptor; lower ones are real."""

_CALL_NS = 500, 20_000
"""Shortest and longest usual duration of a call [ns] (assumed)."""

_WAKE_NS = 1_000, 60_000
"""Shortest and longest usual time from an event to the process that waits for it [ns] (assumed)."""

MOST_STALLED = 1e-4
"""Highest probability that a process is held up at a call."""


class Killed(BaseException):
    """End of a simulated process by a kill; it passes through everything, and no call works any more."""


class OpenFile:
    """One open file of the simulated kernel, with the processes that wait for it.

    Attributes:
        blocking: True if a read or write waits until it can be done.
        references: Number of descriptors of it.
    """

    def __init__(self, kernel: "Kernel") -> None:
        self.kernel = kernel
        self.blocking = True
        self.references = 0
        self.waiters: dict[Process, int] = {}

    def readable(self) -> bool:
        """Return whether `select` reports it as readable."""
        return False

    def writable(self) -> bool:
        """Return whether `select` reports it as writable."""
        return False

    def hung_up(self) -> bool:
        """Return whether `poll` reports a hang-up."""
        return False

    def read(self, limit: int) -> bytes:
        """Return the available bytes, at most `limit`; raise BlockingIOError if there are none yet."""
        raise OSError(9, "Bad file descriptor")

    def write(self, data: bytes) -> int:
        """Take bytes and return their number; raise BlockingIOError without room."""
        raise OSError(9, "Bad file descriptor")

    def closed(self) -> None:
        """Release it: its last descriptor is closed."""

    def changed(self) -> None:
        """Wake the processes that wait for this file."""
        for process, token in [*self.waiters.items()]:
            if process.token == token:
                self.kernel.wake(process)


class Process:
    """A simulated process.

    Attributes:
        name: Name, which also names its random streams.
        pid: Number.
        files: Open files by descriptor.
        real: Real descriptors that it has open for writing, for example a log's, with their files.
        alive: True until it has ended.
        mortal: True if the fault "kill" may end it.
        calls_left: Number of calls after which it is killed; None if it is not.
        error: Exception that ended it; None if it returned.
        on_end: Function called with the process when it has ended.
        on_call: Function called at the start of each of its calls; it may arrange faults.
        leader: Process whose files it has, if it is a thread of another; otherwise the process.
        threads: Its threads.
        began_ns: Time at which it was created [ns].
        output_lines: Times and lines of its output to the user [ns].
        outside: True if it is no program of the machine, as a robot, which is never suspended.
        token: Number of its present wait; wake-ups for an earlier one do nothing.
    """

    def __init__(
        self,
        kernel: "Kernel",
        name: str,
        pid: int,
        function: Callable[[], object],
        leader: "Process | None" = None,
    ) -> None:
        self.kernel, self.name, self.pid = kernel, name, pid
        self.leader = leader or self
        self.threads: list[Process] = []
        self.files: dict[int, OpenFile] = {} if leader is None else leader.files
        self.real: dict[int, tuple[int, int]] = {} if leader is None else leader.real
        self.alive = True
        self.dying = False
        self.mortal = False
        self.calls_left: int | None = None
        self.error: BaseException | None = None
        self.on_end: Callable[[Process], object] | None = None
        self.on_call: Callable[[], object] | None = None
        self.thrown: BaseException | None = None
        self.output_lines: list[tuple[int, str]] = []
        self.outside = False
        self.token = 0
        self.began_ns = kernel.now_ns
        self.rng = random.Random(mixed(kernel.seed, "process", name))
        self._function = function
        self.greenlet = greenlet(self._run)

    def say(self, line: str) -> None:
        """Keep a line for the user."""
        self.output_lines.append((self.kernel.now_ns, line))

    def opened(self, file: OpenFile) -> int:
        """Return the descriptor, the lowest that is free, of a file that the process has opened."""
        number = next(candidate for candidate in count(FIRST_DESCRIPTOR) if candidate not in self.files)
        self.files[number] = file
        file.references += 1
        return number

    def file(self, descriptor: int) -> OpenFile:
        """Return the file of a descriptor.

        Raises:
            OSError: There is none.
        """
        try:
            return self.files[descriptor]
        except KeyError:
            raise OSError(9, "Bad file descriptor") from None

    def close(self, descriptor: int) -> None:
        """Close a descriptor."""
        file = self.file(descriptor)
        del self.files[descriptor]
        file.references -= 1
        if not file.references:
            file.closed()

    def opened_real(self, descriptor: int) -> int:
        """Keep a real descriptor; return it."""
        if (file := _identity(descriptor)) is not None:
            self.real[descriptor] = file
        return descriptor

    def _run(self) -> None:
        try:
            self._function()
        except Killed:
            pass
        except BaseException as error:  # the simulation reports it
            self.error = error
        self.alive = False
        self.kernel.ended(self)


class Kernel:
    """Kernel of one simulation.

    Args:
        seed: Seed of all delays.
        faults: Faults of the simulation.

    Attributes:
        now_ns: Time since the machine was started [ns].
        processes: All processes, in the order of their starts.
        current: Process that runs; None between processes.
    """

    def __init__(self, seed: int, faults: Faults) -> None:
        self.seed, self.faults = seed, faults
        self.now_ns = NS_PER_S
        self.processes: list[Process] = []
        self.current: Process | None = None
        self._held_until_ns = 0
        self._events: list[tuple[int, int, Process | None, int, Callable[[], object] | None]] = []
        self._until_ns = 0
        self._numbers = count()
        self._pids = count(1000)
        self._rng = random.Random(mixed(seed, "kernel"))

    # Processes and events ------------------------------------------------------------------------------

    def spawn(self, name: str, function: Callable[[], object], delay_ns: int = 0) -> Process:
        """Start a process that runs `function`, after a while."""
        process = Process(self, name, next(self._pids), function)
        self.processes.append(process)
        self._push(self.now_ns + delay_ns, process)
        return process

    def spawn_thread(self, function: Callable[[], object], leader: Process | None = None) -> Process:
        """Start a thread of a process, the current one: it has the process's files, and ends with it."""
        leader = leader or self._running().leader
        name = f"{leader.name}/{len(leader.threads) + 1}"
        thread = Process(self, name, next(self._pids), function, leader)
        leader.threads.append(thread)
        self.processes.append(thread)
        self._push(self.now_ns, thread)
        return thread

    def interrupt(self, process: Process, error: BaseException) -> None:
        """Raise an exception in a process, at its next call or amid the present one, as a signal does."""
        if process.alive and not process.dying:
            process.thrown = error
            self.wake(process)

    def at(self, time_ns: int, action: Callable[[], object]) -> None:
        """Call a function at a time, between processes."""
        heapq.heappush(self._events, (time_ns, next(self._numbers), None, 0, action))

    def run(self, until_ns: int) -> None:
        """Run everything that happens up to a time."""
        events, self._until_ns = self._events, until_ns
        while events and events[0][0] <= until_ns:
            time_ns, _, process, token, action = heapq.heappop(events)
            if action is not None:
                self.now_ns = max(self.now_ns, time_ns)
                action()
            elif process is not None and process.alive and process.token == token:
                if time_ns < self._held_until_ns and not process.outside:
                    self._push(self._held_until_ns, process)
                    continue
                self.now_ns = max(self.now_ns, time_ns)
                self._switch_to(process)
        self.now_ns = max(self.now_ns, until_ns)

    def suspend(self, duration_ns: int) -> None:
        """Suspend all programs of the machine for a while; time passes, and bytes in transit arrive."""
        self._held_until_ns = max(self._held_until_ns, self.now_ns + duration_ns)

    def kill(self, process: Process) -> None:
        """End a process immediately, as by SIGKILL: its files are closed, and its code runs no more."""
        if not process.alive or process.dying:
            return
        if process is self.current:
            self._die(process)
        process.dying = True
        if process.greenlet:
            self._switch_to(process)
        else:
            process.alive = False
            self.ended(process)

    def stop_all(self) -> None:
        """Kill all processes that still run."""
        for process in [*self.processes]:
            self.kill(process)

    def ended(self, process: Process) -> None:
        """Close the open files of a process that has ended; its threads end with it."""
        if process.leader is process:
            for thread in process.threads:
                self.kill(thread)
            for descriptor in [*process.files]:
                process.close(descriptor)
            for descriptor, file in process.real.items():
                # An object of Python's may have closed it since, and its number may be another's.
                if _identity(descriptor) == file:
                    os.close(descriptor)
            process.real.clear()
        if process.on_end is not None:
            process.on_end(process)

    # Calls of the current process ----------------------------------------------------------------------

    def called(self) -> Process:
        """Begin a call of the current process: time passes, and it may be held up or killed.

        Raises:
            Killed: The process is dead.
        """
        process = self.current
        assert process is not None, "a call without a process"
        if process.dying:
            raise Killed
        self._throw(process)
        if process.on_call is not None:
            process.on_call()
        delay_ns = process.rng.randrange(*_CALL_NS)
        if process.calls_left is not None:
            process.calls_left -= 1
            if process.calls_left < 0:
                self._die(process)
        if process.mortal and self.faults.happens("kill", process.name, 1e-4):
            self._die(process)
        if not process.outside and self.faults.happens("stall", process.name, MOST_STALLED):
            delay_ns += round(10 ** self.faults.drawn("stall", process.name).uniform(6, 9.5))
        self.elapse(delay_ns)
        return process

    def elapse(self, duration_ns: int) -> None:
        """Let time pass for the current process; others may run meanwhile."""
        due_ns = self.now_ns + duration_ns
        if self._is_quiet_to(due_ns):
            self.now_ns = due_ns
            return
        process = self._running()
        process.token += 1
        self._push(due_ns, process)
        self._leave(process)

    def wait(self, files: Iterable[OpenFile], ready: Callable[[], bool], deadline_ns: int | None) -> bool:
        """Wait until `ready` is true, which only a change of `files` makes it; return False at the deadline.

        The last word is the deadline's: a process that is woken late may find both.
        """
        process = self._running()
        while not ready():
            if deadline_ns is not None and self.now_ns >= deadline_ns:
                return False
            process.token += 1
            for file in files:
                file.waiters[process] = process.token
            if deadline_ns is not None:
                late_ns = process.rng.randrange(*_WAKE_NS)
                if self._is_quiet_to(deadline_ns + late_ns):
                    # Nothing can change it before.
                    self.now_ns = max(self.now_ns, deadline_ns + late_ns)
                    continue
                self._push(deadline_ns + late_ns, process)
            self._leave(process)
        return True

    def _is_quiet_to(self, time_ns: int) -> bool:
        """Return whether nothing happens up to a time, which is not after the end of the run."""
        return time_ns <= self._until_ns and (not self._events or self._events[0][0] > time_ns)

    def wake(self, process: Process) -> None:
        """Wake a process that waits, in a moment."""
        self._push(self.now_ns + self._rng.randrange(*_WAKE_NS), process)

    # Turns ---------------------------------------------------------------------------------------------

    def _running(self) -> Process:
        if self.current is None:
            raise RuntimeError("only a process can wait")
        if self.current.dying:
            raise Killed
        return self.current

    def _push(self, time_ns: int, process: Process) -> None:
        heapq.heappush(self._events, (time_ns, next(self._numbers), process, process.token, None))

    def _switch_to(self, process: Process) -> None:
        before, self.current = self.current, process
        process.greenlet.parent = getcurrent()
        try:
            process.greenlet.switch()
        finally:
            self.current = before

    def _leave(self, process: Process) -> None:
        """Let others run until this process is resumed."""
        parent = process.greenlet.parent
        assert parent is not None
        parent.switch()
        if process.dying:
            raise Killed
        self._throw(process)

    @staticmethod
    def _throw(process: Process) -> None:
        """Raise the exception of a signal."""
        if (error := process.thrown) is not None:
            process.thrown = None
            raise error

    def _die(self, process: Process) -> NoReturn:
        process.dying = True
        raise Killed


def _identity(descriptor: int) -> tuple[int, int] | None:
    """Return device and inode number of the file of a real descriptor; None without one."""
    try:
        status = os.fstat(descriptor)
    except OSError:
        return None
    return status.st_dev, status.st_ino
