"""The devices of a Khepera IV, on a socket, for programs that were compiled for it.

The preload library `assets/khepera4/shim.c` answers the device nodes of a program and asks here, on a line
for each thread. A question is three 32-bit numbers (question, number, length) and its content, an answer a
result (minus an error number where it failed), a length, a 64-bit value, and its content, all little-endian:

    1 TRANSFER   number of messages; each address, flags (bit 0: it reads) and length, 16 bits, then content
    2 GPIO_SET   pin; its value, 32 bits
    3 GPIO_GET   pin; the value is its level
    4 NOW        the value is the simulated time [ns]
    5 SLEEP      time to wait [ns], 64 bits
    6 HELLO      number of the thread, as the kernel counts; without an answer

One thread runs at a time: a question is answered while all threads of the program and of its children wait,
for an answer or for something else: a lock, another thread, a key, whatever the kernel calls sleeping. The
thread of the lowest number is first. A wait ends when no other question is left, the shortest first, and the
time of it has passed. So a run repeats. A question for the time costs `ASKED_NS`: a program that waits in a
loop ends. Where a thread computes for longer than `PATIENCE_S`, the others go on.
"""

import errno
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

from khep_twin.khepera4.machine import READS, Machine

ASKED_NS = 1_000
"""Simulated time that a question for the time takes [ns] (assumed)."""

MOST_BYTES = 1 << 20
"""Longest content of a question; what asks for more is no preload library, and loses its line."""

PATIENCE_S = 0.05
"""Real time for which one thread may compute while others have asked [s] (assumed)."""

_FAMILY: Any = getattr(socket, "AF_UNIX", None)  # which Windows lacks
_QUESTION, _MESSAGE, _ANSWER = struct.Struct("<III"), struct.Struct("<HHH"), struct.Struct("<iIq")


class Question(IntEnum):
    """Kinds of questions."""

    TRANSFER = 1
    GPIO_SET = 2
    GPIO_GET = 3
    NOW = 4
    SLEEP = 5
    HELLO = 6


class DeviceServer:
    """The socket of a machine, for the programs that run on it.

    Args:
        machine: Machine.
        path: Path of the socket, which must not be there.
        clock: Function that returns the time [ns] where it passes by itself; None for simulated time.
    """

    def __init__(self, machine: Machine, path: Path, clock: Callable[[], int] | None = None) -> None:
        self._machine, self._clock = machine, clock
        self._socket = socket.socket(_FAMILY, socket.SOCK_STREAM)
        self._socket.bind(str(path))
        self._socket.listen(64)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._lines: dict[socket.socket, _Line] = {}

    def close(self) -> None:
        """Close the socket and all lines."""
        for line in [*self._lines]:
            self._end(line)
        self._selector.close()
        self._socket.close()

    def serve(self, process: int, is_over: Callable[[], bool]) -> None:
        """Answer a process and its children until a function tells that it is over."""
        since = time.monotonic()
        while not is_over():
            asked = [line for line in self._lines.values() if line.kind]
            if self._listen(0.0 if asked else 0.02) or not asked:
                since = time.monotonic()
                continue
            if not (_all_wait(process) or time.monotonic() - since > PATIENCE_S):
                self._listen(0.0001)
            elif not self._listen(0.0):
                self._answer_first(asked)
                since = time.monotonic()

    def _listen(self, seconds: float) -> bool:
        """Take what comes within a time [s]; return whether there was anything."""
        events = self._selector.select(seconds)
        for key, _ in events:
            if key.fileobj is self._socket:
                line, _ = self._socket.accept()
                self._lines[line] = _Line(line)
                self._selector.register(line, selectors.EVENT_READ)
            elif isinstance(key.fileobj, socket.socket) and not self._hear(self._lines[key.fileobj]):
                self._end(key.fileobj)
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
        if kind == Question.HELLO:
            line.thread = number
            return True
        line.kind, line.number, line.content = kind, number, content
        if kind == Question.SLEEP:
            line.wake_ns = self._machine.time_ns + max(int.from_bytes(content, "little", signed=True), 0)
        return True

    def _answer_first(self, asked: list["_Line"]) -> None:
        """Answer the question whose turn it is."""
        line = min(asked, key=lambda line: (line.kind == Question.SLEEP, line.wake_ns, line.thread))
        result, value, told = 0, 0, b""
        try:
            result, value, told = self._answer(line)
        except OSError as error:
            result = -(error.errno or errno.EIO)
        line.kind, line.wake_ns = 0, 0
        try:
            line.socket.sendall(_ANSWER.pack(result, len(told), value) + told)
        except OSError:  # the program has ended meanwhile
            self._end(line.socket)

    def _answer(self, line: "_Line") -> tuple[int, int, bytes]:
        """Return result, value and content of an answer."""
        machine, kind = self._machine, line.kind
        if self._clock is not None:
            machine.advance_to(self._clock())
        elif kind == Question.SLEEP:
            machine.advance_to(line.wake_ns)
        elif kind == Question.NOW:
            machine.advance_to(machine.time_ns + ASKED_NS)
        if kind == Question.TRANSFER:
            return line.number, 0, machine.transfer(_messages(line.number, line.content))
        if kind == Question.GPIO_SET:
            machine.set_pin(line.number, int.from_bytes(line.content, "little"))
        elif kind == Question.GPIO_GET:
            return 0, machine.pin(line.number), b""
        elif kind not in (Question.NOW, Question.SLEEP):
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
    thread: int = 0
    kind: int = 0
    number: int = 0
    content: bytes = b""
    wake_ns: int = 0


def _all_wait(process: int) -> bool:
    """Return whether all threads of a process and of its children wait, by the kernel's word."""
    try:
        for task in Path(f"/proc/{process}/task").iterdir():
            if (task / "stat").read_text().rpartition(")")[2].split()[0] not in "SZX":
                return False
            children = task / "children"  # which not every kernel tells
            if children.exists() and not all(_all_wait(int(each)) for each in children.read_text().split()):
                return False
    except OSError:  # one has just ended
        return False
    return True


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
