"""Detection of waiting threads of the robots' programs, by the Linux kernel's files in /proc.

A thread waits if /proc/PROCESS/task/THREAD/stat reports a sleep (S), a stop (T, or t by a debugger) or its
end (Z, X). It may wait for a lock, another thread, a key or any other system call. A second file changes
whenever the thread runs: two equal readings of it for all threads prove that all waited simultaneously in
between.
"""

import contextlib
import os
import sys
import time
from collections.abc import Collection
from itertools import chain
from pathlib import Path

ThreadId = tuple[int, int]
"""Numbers of a process and of one of its threads."""

_LIVE_STATES = b"S", b"T", b"t"
_WRITE_CALLS = {1, 4, 20, 64, 66, 146}
"""Numbers of `write` and `writev`: 1 and 20 on x86-64, 64 and 66 on ARM of 64 bits, 4 and 146 of 32 bits."""


class ThreadWatch:
    """The threads of processes and of all their child processes.

    Args:
        processes: Numbers of the processes.

    Attributes:
        processes: Numbers of all live processes that are known.
    """

    def __init__(self, processes: Collection[int]) -> None:
        self.processes = {*processes}
        self._known_processes = {*processes}  # all processes of this computer at the last scan
        self._files: dict[ThreadId, tuple[int, int]] = {}  # descriptors of `stat` and of `_run_file`
        self._newest_thread = b""
        # The fastest file that changes whenever a thread runs; some kernels count nothing in it.
        run_counts = _read_file(Path("/proc/thread-self/schedstat")).split()
        self._run_file = "schedstat" if any(map(int, run_counts)) else "status"
        self._load_file = os.open("/proc/loadavg", os.O_RDONLY)

    def close(self) -> None:
        """Close the files of /proc."""
        for file in (self._load_file, *chain(*self._files.values())):
            os.close(file)

    def all_wait(self, pending: set[ThreadId], blocked: set[int], n_connections: int) -> bool:
        """Return whether all threads wait.

        Args:
            pending: Threads with an open request.
            blocked: Numbers of pending threads that no signal wakes; their files need not be read.
            n_connections: Number of connections to the twin.
        """
        self._find_threads(pending)
        if len(pending) == n_connections == len(self._files) == 1:
            return True
        watched_threads = [thread for thread in self._files if thread[1] not in blocked]
        run_counts: list[bytes] = []
        for thread in watched_threads:
            if (run_count := self._read_run_count(thread)) is None:
                return False
            run_counts.append(run_count)
        return run_counts == [self._read_run_count(thread) for thread in watched_threads]

    def is_external(self) -> bool:
        """Return whether waiting threads wait for input: one has not ended, and none waits to write."""
        is_live = False
        for thread in [*self._files]:
            state = self._read_state(thread)
            is_live |= state in _LIVE_STATES
            call = _read_file(Path("/proc/{}/task/{}/syscall".format(*thread))).partition(b" ")[0]
            if state == b"S" and call.isdigit() and int(call) in _WRITE_CALLS:
                return False
        return is_live

    def cpu_ns(self) -> int:
        """Return the processor time of all processes [ns]."""
        assert sys.platform == "linux"
        total_ns = 0
        for process in self.processes:
            with contextlib.suppress(OSError):  # it may have ended
                total_ns += time.clock_gettime_ns(~process << 3 | 2)  # as C's clock_getcpuclockid
        return total_ns

    def _find_threads(self, pending: set[ThreadId]) -> None:
        """Find new threads, and new child processes of known ones."""
        assert sys.platform == "linux"
        newest_thread = os.pread(self._load_file, 256, 0).rpartition(b" ")[2]
        if newest_thread == self._newest_thread and pending <= self._files.keys():
            return
        live_processes = {int(name) for name in os.listdir("/proc") if name.isdigit()}
        new_processes = live_processes - self._known_processes
        parents = {process: _parent_process(process) for process in new_processes}
        self.processes |= {process for process, _ in pending}
        while children := {p for p in new_processes - self.processes if parents[p] in self.processes}:
            self.processes |= children
        self.processes &= live_processes
        self._known_processes = live_processes
        self._newest_thread = newest_thread
        threads = {(process, thread) for process in self.processes for thread in _thread_numbers(process)}
        for thread in self._files.keys() - threads:
            for file in self._files.pop(thread):
                os.close(file)
        for process, thread in sorted(threads - self._files.keys()):
            with contextlib.suppress(OSError):
                folder = f"/proc/{process}/task/{thread}"
                state_file = os.open(f"{folder}/stat", os.O_RDONLY)
                try:
                    run_file = os.open(f"{folder}/{self._run_file}", os.O_RDONLY)
                except OSError:
                    os.close(state_file)
                    raise
                self._files[process, thread] = state_file, run_file

    def _read_run_count(self, thread: ThreadId) -> bytes | None:
        """Return the counters of a waiting thread's runs; None for a running thread."""
        assert sys.platform == "linux"
        try:
            if self._read_state(thread) not in b"SZXTt":
                return None
            return os.pread(self._files[thread][1], 4096, 0)
        except OSError:
            return b""

    def _read_state(self, thread: ThreadId) -> bytes:
        """Return the letter of a thread's state, empty after its end."""
        assert sys.platform == "linux"
        try:
            stat = os.pread(self._files[thread][0], 4096, 0)
        except OSError:
            return b""
        start = stat.rfind(b")") + 2  # behind the program's name
        return stat[start : start + 1]


def _read_file(path: Path) -> bytes:
    """Return the content of a file, empty if there is none."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _parent_process(process: int) -> int:
    """Return the number of a process's parent, 0 if the process has ended."""
    fields = _read_file(Path(f"/proc/{process}/stat")).rpartition(b")")[2].split()
    return int(fields[1]) if fields else 0


def _thread_numbers(process: int) -> list[int]:
    """Return the numbers of the threads of a process."""
    try:
        return [int(name) for name in os.listdir(f"/proc/{process}/task")]
    except OSError:
        return []
