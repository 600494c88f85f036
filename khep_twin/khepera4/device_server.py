"""The devices of Khepera IVs, on a socket each, for programs that were compiled for them.

The preload library `assets/khepera4/shim*.c` answers the device nodes of a program and asks here, on a line
for each thread. A question is three 32-bit numbers (question, number, length) and its content, an answer a
result (minus an error number where it failed), a length, a 64-bit value, and its content, all little-endian:

    1 TRANSFER   number of messages; each address, flags (bit 0: it reads) and length, 16 bits, then content
    2 GPIO_SET   pin; its value, 32 bits
    3 GPIO_GET   pin; the value is its level
    4 NOW        the value is the simulated time [ns]
    5 SLEEP      0, then time to wait [ns], 64 bits, or 1, then the time at which to end, `NEVER_NS` for none;
                 the value is what is left of it [ns], below 0 where it took longer. Then the place whose WAKE
                 ends it, too, and the last of its wakes that was seen, 64 bits each; the result is 1 for such
    6 HELLO      number of the thread, as the kernel counts
    7 CANCEL     ends the wait of its line now, unless that has been answered; without an answer of its own
    8 WAKE       how many of those who wait for a place in this process, 0 for all; the place and the number
                 of this wake, 64 bits each; without an answer

One thread runs at a time: a question is answered while all threads of all programs and their children wait,
for an answer or for something else: a lock, another thread, a key, whatever the kernel calls sleeping. A new
thread and a new process say HELLO before anything else, so they, too, begin when it is their turn. A wait is
due at its end or wake, all else when it is asked. What is due first is answered, of several the question of
the first robot and its thread with the lowest number, then those that wait for a place, the longest first,
and the time until then has passed. So a run repeats. A question for the time costs `ASKED_NS`: a program that
waits in a loop ends. A thread that computes for longer than `PATIENCE_S` no longer holds up the others: from
then on their time passes as fast as it computes. Where all wait without a limit, for a key or for another
computer, time passes with the wall clock after `OUTSIDE_S`; where one computes and none asks, after `BUSY_S`.
"""

import contextlib
import errno
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from pathlib import Path
from typing import Any

from khep_twin.khepera4.machine import BYTE_NS, READS, Machine

ASKED_NS = 10_000
"""Simulated time that a question for the time takes [ns], with what is around it in a loop (assumed)."""

MOST_BYTES = 1 << 20
"""Longest content of a question; what asks for more is no preload library, and loses its line."""

PATIENCE_S = 0.05
"""Processor time for which threads may compute while others have asked [s] (assumed)."""

OUTSIDE_S = 0.2
"""Time of the wall clock after which programs that wait without any limit wait for the outside, a key or
another computer: from then on simulated time passes as the wall clock does [s] (assumed)."""

BUSY_S = 10.0
"""Time of the wall clock after which programs that compute and ask nothing may go on for ever: from then on
simulated time passes as the wall clock does, too [s] (assumed)."""

_WHOLE_S = 2.0
"""Time in which a question is whole that has begun [s]; the preload library sends it at once."""

_LOOK_S = 0.02
"""Time of the wall clock between two looks at such programs [s]."""

NEVER_NS = (1 << 63) - 1
"""End of a wait that has none [ns]."""

STRIDE_NS = 1_000_000_000
"""Longest simulated time that passes before the program is looked at again: it may have ended [ns]."""

_FAMILY: Any = getattr(socket, "AF_UNIX", None)  # which Windows lacks
_PEER = getattr(socket, "SO_PEERCRED", 17)
_QUESTION, _MESSAGE, _ANSWER = struct.Struct("<III"), struct.Struct("<HHH"), struct.Struct("<iIq")
_SLEEP, _WAKE = struct.Struct("<qQQ"), struct.Struct("<QQ")


class Question(IntEnum):
    """Kinds of questions."""

    TRANSFER = 1
    GPIO_SET = 2
    GPIO_GET = 3
    NOW = 4
    SLEEP = 5
    HELLO = 6
    CANCEL = 7
    WAKE = 8


_LENGTHS = {Question.SLEEP: _SLEEP.size, Question.WAKE: _WAKE.size}


class DeviceServer:
    """The sockets of machines, for the programs that run on them.

    Args:
        machines: Machines, which share one time.
        paths: Path of the socket of each, which must not be there.
        clock: Function that returns the time [ns] where it passes by itself; None for simulated time.
    """

    def __init__(
        self, machines: Sequence[Machine], paths: Sequence[Path], clock: Callable[[], int] | None = None
    ) -> None:
        self._machines, self._machine, self._clock = machines, machines[0], clock
        self._selector = selectors.DefaultSelector()
        self._sockets: dict[socket.socket, int] = {}
        for index, path in enumerate(paths):
            own = socket.socket(_FAMILY, socket.SOCK_STREAM)
            own.bind(str(path))
            own.listen(64)
            self._sockets[own] = index
            self._selector.register(own, selectors.EVENT_READ)
        self._lines: dict[socket.socket, _Line] = {}
        self._turn, self._until_ns = 0, NEVER_NS  # of the last wait; end of the run
        self._wakes: dict[tuple[int, int], int] = {}  # the last of each process and place

    def close(self) -> None:
        """Close the sockets and all lines."""
        for line in [*self._lines]:
            self._end(line)
        self._selector.close()
        for own in self._sockets:
            own.close()

    def serve(
        self, processes: Collection[int], is_over: Callable[[], bool], until_ns: int = NEVER_NS
    ) -> set[int]:
        """Answer processes and their children until a function tells that it is over, or to a time [ns].

        Returns:
            Numbers of the processes that were there at last.
        """
        threads, self._until_ns = _Threads(processes), until_ns
        try:
            self._serve(threads, lambda: self._machine.time_ns >= until_ns or is_over())
        finally:
            threads.close()
        return threads.processes

    def _serve(self, threads: "_Threads", is_over: Callable[[], bool]) -> None:
        assert sys.platform == "linux"
        begun_ns, begun_cpu_ns = 0, -1  # of a thread that computes; -1 while all wait
        idle, waited = 0, True  # looks at programs that wait without a limit, or ask nothing
        while not is_over():
            asked = [line for line in self._lines.values() if line.kind]
            if min((line.due_ns for line in asked), default=NEVER_NS) == NEVER_NS:
                if self._listen(_LOOK_S):
                    idle = 0
                elif self._clock is not None:
                    self._machine.advance_to(self._clock())
                else:
                    waits = threads.all_wait(self._lines.values())
                    idle = idle + 1 if waits == waited else 0
                    waited = waits
                    if idle * _LOOK_S > (OUTSIDE_S if waits else BUSY_S):
                        self._machine.advance_to(self._machine.time_ns + round(_LOOK_S * 1e9))
                continue
            idle = 0
            if self._clock is not None or threads.all_wait(self._lines.values()):
                if self._listen(0.0):
                    continue
                begun_cpu_ns = -1
            else:
                if begun_cpu_ns < 0:
                    begun_ns, begun_cpu_ns = self._machine.time_ns, threads.cpu_ns()
                spent_ns = threads.cpu_ns() - begun_cpu_ns
                if spent_ns < PATIENCE_S * 1e9 or min(line.due_ns for line in asked) > begun_ns + spent_ns:
                    self._listen(0.0001)
                    continue
            self._answer_first(asked)
            os.sched_yield()  # to the thread that has its answer, which mostly asks again
            self._listen(0.0)

    def _listen(self, seconds: float) -> bool:
        """Take what comes within a time [s]; return whether there was anything."""
        events = self._selector.select(seconds)
        for key, _ in events:
            ready = key.fileobj
            if not isinstance(ready, socket.socket):
                continue
            if ready in self._sockets:
                line, _ = ready.accept()
                line.settimeout(_WHOLE_S)
                self._lines[line] = _Line(line, self._sockets[ready], _peer(line))
                self._selector.register(line, selectors.EVENT_READ)
            elif not self._hear(self._lines[ready]):
                self._end(ready)
        return bool(events)

    def _hear(self, line: "_Line") -> bool:
        """Take a question of a line; return False at its end."""
        head = _received(line.socket, _QUESTION.size)
        if head is None:
            return False
        kind, number, length = _QUESTION.unpack(head)
        content = _received(line.socket, length) if length <= MOST_BYTES else None
        if content is None:
            return False
        now_ns = self._machine.time_ns
        if length != _LENGTHS.get(kind, length):
            return False
        if kind == Question.CANCEL:
            line.due_ns = now_ns
            return True
        if kind == Question.WAKE:
            self._wake(line.process, number, *_WAKE.unpack(content))
            return True
        if kind == Question.HELLO:
            line.thread = number
        line.kind, line.number, line.content, line.due_ns, line.turn = kind, number, content, now_ns, 0
        if kind == Question.SLEEP:
            ns, line.place, seen = _SLEEP.unpack(content)
            line.wake_ns, line.woken = ns if number else now_ns + ns, False
            line.due_ns = max(line.wake_ns, now_ns)
            self._turn += 1
            line.turn = self._turn if line.place else 0
            if line.place and seen < self._wakes.get((line.process, line.place), 0):
                line.due_ns, line.woken = now_ns, True
        return True

    def _wake(self, process: int, count: int, place: int, wake: int) -> None:
        """Wake the first of those who wait for a place, so many or all."""
        self._wakes[process, place] = wake
        waiting = [
            line
            for line in self._lines.values()
            if line.kind == Question.SLEEP
            and (line.process, line.place, line.woken) == (process, place, False)
        ]
        for line in sorted(waiting, key=lambda line: line.turn)[: count or None]:
            line.due_ns, line.woken = self._machine.time_ns, True

    def _answer_first(self, asked: list["_Line"]) -> None:
        """Answer the question whose turn it is."""
        line = min(asked, key=lambda line: (line.due_ns, line.turn, line.robot, line.thread))
        next_ns = min(self._machine.time_ns + STRIDE_NS, self._until_ns)
        if self._clock is None and line.due_ns > next_ns:
            self._machine.advance_to(next_ns)
            return
        result, value, told = 0, 0, b""
        try:
            try:
                result, value, told = self._answer(line)
            except OSError as error:
                result = -(error.errno or errno.EIO)
            line.kind = 0
            line.socket.sendall(_ANSWER.pack(result, len(told), value) + told)
        except (OSError, struct.error):  # the program has ended meanwhile, or this is no preload library
            self._end(line.socket)

    def _answer(self, line: "_Line") -> tuple[int, int, bytes]:
        """Return result, value and content of an answer."""
        machine, kind = self._machines[line.robot], line.kind
        if self._clock is not None:
            machine.advance_to(self._clock())
        elif kind == Question.SLEEP:
            machine.advance_to(line.due_ns)
        elif kind == Question.NOW:
            machine.advance_to(machine.time_ns + ASKED_NS)
        if kind == Question.TRANSFER:
            return (
                line.number,
                0,
                machine.transfer(_messages(line.number, line.content), BYTE_NS if self._clock is None else 0),
            )
        if kind == Question.GPIO_SET:
            machine.set_pin(line.number, int.from_bytes(line.content, "little"))
        elif kind == Question.GPIO_GET:
            return 0, machine.pin(line.number), b""
        elif kind == Question.SLEEP:
            return int(line.woken), line.wake_ns - machine.time_ns, b""
        elif kind not in (Question.NOW, Question.HELLO):
            raise OSError(errno.ENOSYS, f"question {kind}; expected one of {[*Question]}")
        return 0, machine.time_ns, b""

    def _end(self, line: socket.socket) -> None:
        if self._lines.pop(line, None) is not None:
            self._selector.unregister(line)
            line.close()


@dataclass(slots=True)
class _Line:
    """Line of a thread, and its open question; kind 0 for none."""

    socket: socket.socket
    robot: int
    process: int
    thread: int = 0
    kind: int = 0
    number: int = 0
    content: bytes = b""
    wake_ns: int = 0
    place: int = 0
    turn: int = 0
    woken: bool = False
    due_ns: int = 0


class _Threads:
    """The threads of processes and of those that they have begun, as the kernel sees them.

    Args:
        processes: Numbers of the processes.

    Attributes:
        processes: Numbers of all that are known.
    """

    def __init__(self, processes: Collection[int]) -> None:
        self.processes, self._seen = {*processes}, {*processes}
        self._files: dict[tuple[int, int], tuple[int, int]] = {}
        self._newest: bytes = b""
        # The fastest file that changes whenever a thread runs; some kernels count nothing in it.
        counted = _content(Path("/proc/thread-self/schedstat")).split()
        self._turns = "schedstat" if any(map(int, counted)) else "status"
        self._load = os.open("/proc/loadavg", os.O_RDONLY)

    def close(self) -> None:
        """Close the files of the kernel."""
        for file in (self._load, *chain(*self._files.values())):
            os.close(file)

    def all_wait(self, lines: Collection[_Line]) -> bool:
        """Return whether all wait, those with an open question among them.

        Two looks with the same count of switches between threads: all were waiting at once between them.
        """
        asked = [line for line in lines if line.kind]
        self._find({(line.process, line.thread) for line in asked})
        if len(asked) == len(lines) == len(self._files) == 1:
            return True
        surely = {
            line.thread for line in asked if line.kind != Question.SLEEP
        }  # which a signal does not wake
        looked = [key for key in self._files if key[1] not in surely]
        first: list[bytes] = []
        for key in looked:
            if (seen := self._waits(key)) is None:
                return False
            first.append(seen)
        return first == [self._waits(key) for key in looked]

    def cpu_ns(self) -> int:
        """Return the processor time that they have had [ns]."""
        assert sys.platform == "linux"
        found = 0
        for process in self.processes:
            with contextlib.suppress(OSError):  # one that has ended
                found += time.clock_gettime_ns(~process << 3 | 2)  # as clock_getcpuclockid of the C library
        return found

    def _find(self, known: set[tuple[int, int]]) -> None:
        """Find new threads, those with a line among them, and new processes, whose parents are known."""
        assert sys.platform == "linux"
        newest = os.pread(self._load, 256, 0).rpartition(b" ")[2]  # the number of the newest thread
        if newest == self._newest and known <= self._files.keys():
            return
        there = {int(name) for name in os.listdir("/proc") if name.isdigit()}
        new = there - self._seen
        parents = {each: _parent(each) for each in new}
        self.processes |= {process for process, _ in known}
        while more := {each for each in new - self.processes if parents[each] in self.processes}:
            self.processes |= more
        self.processes &= there
        self._seen, self._newest = there, newest
        tasks = {(process, task) for process in self.processes for task in _tasks(process)}
        for key in self._files.keys() - tasks:
            for file in self._files.pop(key):
                os.close(file)
        for process, task in sorted(tasks - self._files.keys()):
            with contextlib.suppress(OSError):
                state = os.open(f"/proc/{process}/task/{task}/stat", os.O_RDONLY)
                try:
                    turns = os.open(f"/proc/{process}/task/{task}/{self._turns}", os.O_RDONLY)
                except OSError:
                    os.close(state)
                    raise
                self._files[process, task] = state, turns

    def _waits(self, key: tuple[int, int]) -> bytes | None:
        """Return how long and how often a thread that waits has run, None of one that runs."""
        assert sys.platform == "linux"
        state, turns = self._files[key]
        try:
            told = os.pread(state, 4096, 0)
            place = told.rfind(b")") + 2
            return os.pread(turns, 4096, 0) if told[place : place + 1] in b"SZXT" else None
        except OSError:
            return b""


def _content(path: Path) -> bytes:
    """Return the content of a file, nothing where there is none."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _parent(process: int) -> int:
    """Return the number of the process that began one, 0 where that has ended."""
    told = _content(Path(f"/proc/{process}/stat")).rpartition(b")")[2].split()
    return int(told[1]) if told else 0


def _tasks(process: int) -> list[int]:
    """Return the numbers of the threads of a process."""
    try:
        return [int(name) for name in os.listdir(f"/proc/{process}/task")]
    except OSError:
        return []


def _peer(line: socket.socket) -> int:
    """Return the number of the process that opened a line."""
    return int.from_bytes(line.getsockopt(socket.SOL_SOCKET, _PEER, 4), sys.byteorder)


def _received(line: socket.socket, count: int) -> bytes | None:
    """Return so many bytes; None where the line has ended."""
    found = b""
    while len(found) < count:
        try:
            part = line.recv(count - len(found))
        except OSError:
            return None
        if not part:
            return None
        found += part
    return found


def _messages(count: int, content: bytes) -> list[tuple[int, int, bytes]]:
    """Return address, flags and content of messages."""
    found: list[tuple[int, int, bytes]] = []
    at = 0
    for _ in range(count):
        address, flags, length = _MESSAGE.unpack_from(content, at)
        at += _MESSAGE.size
        reads = flags & READS
        found.append((address, flags, bytes(length) if reads else content[at : at + length]))
        at += 0 if reads else length
    return found
