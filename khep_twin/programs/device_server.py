"""Sockets that answer the device nodes of robots, for programs that were compiled for them.

The preload library `assets/shim*.c`, which is loaded into a program before the C library, sends
device calls and waits of the program to this server, on a connection for each thread. A request is three
32-bit numbers (kind, number, length) and its content. A reply is a result (minus an error number after a
failure), a length, a 64-bit value and its content. All are little-endian:

    1 TRANSFER   bus << 16 | number of messages; each address, flags (bit 0: read), length, 16 bits, content
    2 GPIO_SET   pin; its value, 32 bits
    3 GPIO_GET   pin; the value is its level
    4 NOW        the value is the simulated time [ns]
    5 SLEEP      0 and a duration, or 1 and an end time [ns], `NEVER_NS` for none; 2 is added if it also waits
                 for another program. Then a futex address whose WAKE also ends it, 0 for none, and the number
                 of its last WAKE, 64 bits each. The value is the remaining time [ns], below 0 if it took
                 longer; the result is 1 after a WAKE
    6 HELLO      number of the thread in the kernel
    7 CANCEL     ends the SLEEP of its connection, unless that has its reply; no further reply
    8 WAKE       threads to wake, 0 for all; futex address and number of this WAKE, 64 bits each; no reply
    9 EXEC       path of a program that the process starts

`scheduler` decides which request is served next.
"""

import contextlib
import errno
import os
import selectors
import socket
import struct
import sys
from collections.abc import Callable, Collection, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

from khep_twin.programs.computer import READ_FLAG, Machine
from khep_twin.programs.scheduler import NEVER_NS, TIME_REQUEST_NS, Scheduler, ThreadConnection
from khep_twin.programs.thread_watch import ThreadWatch

MAX_BYTES = 1 << 20
"""Longest content of a request; a client that sends more is no preload library, and is disconnected."""

_RECEIVE_TIMEOUT_S = 2.0
"""Longest wait for the rest of a request [s]; the preload library sends it in one piece."""

_SOCKET_FAMILY: Any = getattr(socket, "AF_UNIX", None)  # which Windows lacks
_PEER_CREDENTIALS = getattr(socket, "SO_PEERCRED", 17)
_REQUEST, _I2C_HEADER, _REPLY = struct.Struct("<III"), struct.Struct("<HHH"), struct.Struct("<iIq")
_SLEEP, _WAKE = struct.Struct("<qQQ"), struct.Struct("<QQ")


Request = IntEnum("Request", "TRANSFER GPIO_SET GPIO_GET NOW SLEEP HELLO CANCEL WAKE EXEC")
"""Kinds of requests, from 1."""

_ABSOLUTE, _EXTERNAL = 1, 2  # in the number of a SLEEP
_CONTENT_SIZES = {Request.SLEEP: _SLEEP.size, Request.WAKE: _WAKE.size}


class DeviceServer:
    """The sockets of machines, for the programs that run on them.

    Args:
        machines: Machines, which share one time.
        paths: Path of each machine's socket, which must not exist.
        clock: Function that returns real time [ns]; None for simulated time.
        on_wall_clock: Function that is called when simulated time first passes with the wall clock.
        on_start: Function that is called when a process starts another program, with the index of its
            machine, its number and the program's path.

    Attributes:
        clients: Numbers of all processes that have connected.
    """

    def __init__(
        self,
        machines: Sequence[Machine],
        paths: Sequence[Path],
        clock: Callable[[], int] | None = None,
        on_wall_clock: Callable[[], None] = lambda: None,
        on_start: Callable[[int, int, str], None] = lambda robot, process, path: None,
    ) -> None:
        self._machines = machines
        self._clock = clock
        self._on_start = on_start
        self.clients: set[int] = set()
        self._selector = selectors.DefaultSelector()
        self._listeners: dict[socket.socket, int] = {}
        for index, path in enumerate(paths):
            listener = socket.socket(_SOCKET_FAMILY, socket.SOCK_STREAM)
            listener.bind(str(path))
            listener.listen(64)
            self._listeners[listener] = index
            self._selector.register(listener, selectors.EVENT_READ)
        self._connections: dict[socket.socket, ThreadConnection] = {}
        self._scheduler = Scheduler(
            machines[0], self._connections.values(), clock, self._poll, self._reply, on_wall_clock
        )

    def close(self) -> None:
        """Close all sockets."""
        for peer in [*self._connections]:
            self._disconnect(peer)
        self._selector.close()
        for listener in self._listeners:
            listener.close()

    def serve(
        self, processes: Collection[int], should_stop: Callable[[], bool], end_ns: int = NEVER_NS
    ) -> set[int]:
        """Serve processes and their children until a function returns True, or until a time [ns].

        Returns:
            Numbers of the processes that still exist.
        """
        with contextlib.closing(ThreadWatch(processes)) as watch:
            self._scheduler.run(watch, should_stop, end_ns)
        return watch.processes

    def _poll(self, timeout: float) -> bool:
        """Receive requests until a time-out [s]; return whether anything arrived."""
        events = self._selector.select(timeout)
        if events:
            self._scheduler.pass_wall_time()  # before requests that are due at once
        for key, _ in events:
            ready_socket = key.fileobj
            if not isinstance(ready_socket, socket.socket):
                continue
            if ready_socket in self._listeners:
                peer, _ = ready_socket.accept()
                peer.settimeout(_RECEIVE_TIMEOUT_S)
                credentials = peer.getsockopt(socket.SOL_SOCKET, _PEER_CREDENTIALS, 4)
                process = int.from_bytes(credentials, sys.byteorder)
                self.clients.add(process)
                self._connections[peer] = ThreadConnection(peer, self._listeners[ready_socket], process)
                self._selector.register(peer, selectors.EVENT_READ)
            elif not self._receive(self._connections[ready_socket]):
                self._disconnect(ready_socket)
        return bool(events)

    def _receive(self, connection: ThreadConnection) -> bool:
        """Receive a request; return False at the end of the connection."""
        header = _receive_bytes(connection.socket, _REQUEST.size)
        if header is None:
            return False
        kind, number, length = _REQUEST.unpack(header)
        content = _receive_bytes(connection.socket, length) if length <= MAX_BYTES else None
        if content is None or length != _CONTENT_SIZES.get(kind, length):
            return False
        now_ns = self._machines[0].time_ns
        if kind == Request.CANCEL:
            connection.due_ns = now_ns
            return True
        if kind == Request.WAKE:
            futex_address, wake_number = _WAKE.unpack(content)
            self._scheduler.wake((connection.process, futex_address), number, wake_number)
            return True
        if kind == Request.HELLO:
            connection.thread = number
        connection.kind, connection.number, connection.content = kind, number, content
        connection.is_pending = True
        connection.is_sleeping = kind == Request.SLEEP
        connection.is_external = False
        connection.due_ns = now_ns
        connection.ticket = 0
        if connection.is_sleeping:
            sleep_ns, futex_address, last_wake = _SLEEP.unpack(content)
            connection.is_external = bool(number & _EXTERNAL)
            end_ns = sleep_ns if number & _ABSOLUTE else now_ns + sleep_ns
            self._scheduler.sleep(connection, end_ns, futex_address, last_wake)
        return True

    def _reply(self, connection: ThreadConnection) -> None:
        """Execute a request and reply to it."""
        try:
            try:
                result, value, content = self._execute(connection)
            except OSError as error:
                result, value, content = -(error.errno or errno.EIO), 0, b""
            connection.is_pending = connection.is_sleeping = False
            connection.socket.sendall(_REPLY.pack(result, len(content), value) + content)
        except (OSError, struct.error):  # the program has ended meanwhile, or this is no preload library
            self._disconnect(connection.socket)

    def _execute(self, connection: ThreadConnection) -> tuple[int, int, bytes]:
        """Execute a request; return result, value and content of the reply."""
        machine = self._machines[connection.robot]
        kind, number, content = connection.kind, connection.number, connection.content
        if self._clock is not None:
            machine.advance_to(self._clock())
        elif kind == Request.SLEEP:
            machine.advance_to(connection.due_ns)
        elif kind in (Request.NOW, Request.GPIO_SET, Request.GPIO_GET):
            machine.advance_to(machine.time_ns + TIME_REQUEST_NS)
        if kind == Request.TRANSFER:
            bus, count = divmod(number, 1 << 16)
            byte_ns = machine.computer.byte_ns if self._clock is None else 0
            return count, 0, machine.transfer(bus, _parse_i2c_messages(count, content), byte_ns)
        if kind == Request.GPIO_SET:
            machine.set_pin(number, int.from_bytes(content, "little"))
        elif kind == Request.GPIO_GET:
            return 0, machine.pin(number), b""
        elif kind == Request.EXEC:
            self._on_start(connection.robot, connection.process, os.fsdecode(content))
        elif kind == Request.SLEEP:
            return int(connection.is_woken), connection.end_ns - machine.time_ns, b""
        elif kind not in (Request.NOW, Request.HELLO):
            raise OSError(errno.ENOSYS, f"request {kind}; expected one of {[*Request]}")
        return 0, machine.time_ns, b""

    def _disconnect(self, peer: socket.socket) -> None:
        if self._connections.pop(peer, None) is not None:
            self._selector.unregister(peer)
            peer.close()


def _receive_bytes(peer: socket.socket, count: int) -> bytes | None:
    """Return a number of bytes; None at the end of the stream."""
    content = b""
    while len(content) < count:
        try:
            chunk = peer.recv(count - len(content))
        except OSError:
            return None
        if not chunk:
            return None
        content += chunk
    return content


def _parse_i2c_messages(count: int, content: bytes) -> list[tuple[int, int, bytes]]:
    """Return address, flags and content of I2C messages."""
    messages: list[tuple[int, int, bytes]] = []
    offset = 0
    for _ in range(count):
        address, flags, length = _I2C_HEADER.unpack_from(content, offset)
        offset += _I2C_HEADER.size
        is_read = flags & READ_FLAG
        messages.append((address, flags, bytes(length) if is_read else content[offset : offset + length]))
        offset += 0 if is_read else length
    return messages
