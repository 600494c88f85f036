"""Simulated TCP on one machine: listening, connections, and cables that are pulled.

A connection is two streams of bytes. A segment arrives some time after it was sent, in order, whole or split,
and is appended to the unread bytes. Buffers are bounded. As on Linux, a socket that is closed with unread
bytes resets its connection, as does one that is closed and gets more; earlier bytes can still be read.
"""

import errno
import os
import socket
import struct
from collections.abc import Callable
from itertools import count

from checks.simulate.faults import Faults
from checks.simulate.kernel import NS_PER_S, Kernel, OpenFile

BUFFER = 65_536
"""Bytes that each end of a connection buffers, unless a program asks for another number (assumed)."""

_TRANSIT_NS = 20_000, 200_000
"""Shortest and longest usual time of a segment on its way [ns] (assumed)."""

_FIRST_RETRANSMISSION_NS = NS_PER_S // 5
"""Time to the first retransmission; each further one takes twice as long (Linux)."""

_MOST_RETRANSMISSIONS = 15
"""Retransmissions after which a connection is given up (Linux's tcp_retries2)."""

_SYN_RETRY_NS = NS_PER_S
"""Time after which a connection that found no room is asked for again [ns] (Linux)."""

_MOST_SPLIT, _MOST_LATE = 0.05, 0.01
"""Highest probabilities that a segment is split, and that it is late."""

_FIN = b""


class Network:
    """The sockets of one simulation.

    Attributes:
        listeners: Listening sockets by port number.
        spoil: Function that returns the bytes that a bad converter makes of a segment; it gets the name of
            the connection and whether they go to the server. None for a cable without errors.
    """

    def __init__(self, kernel: Kernel, faults: Faults) -> None:
        self.kernel, self.faults = kernel, faults
        self.listeners: dict[int, TcpFile] = {}
        self.spoil: Callable[[str, bool, bytes], bytes] | None = None
        self._numbers = count(32_768)

    def free_port(self) -> int:
        """Return the number of a port that nothing listens at."""
        return next(number for number in self._numbers if number not in self.listeners)

    def cut(self, client: "TcpFile", duration_ns: int | None = None) -> None:
        """Pull the cable of a connection: nothing arrives, for a while or for ever."""
        ways = [client.way, *([] if client.peer is None else [client.peer.way])]
        if client.peer is None or any(way.is_cut for way in ways):
            return
        for way in ways:
            way.is_cut = True
            way.sender.watch_silence()
        if duration_ns is not None:
            self.kernel.at(self.kernel.now_ns + duration_ns, lambda: [way.mend() for way in ways])


class _Way:
    """One direction of a connection.

    Attributes:
        waiting: Bytes that the sender's program has written and that found no room yet.
        in_flight: Number of bytes that were sent and have not arrived.
        is_cut: True if nothing arrives.
        lost: Segments to be sent again.
        lost_ns: Time of the first of them [ns].
    """

    def __init__(self, network: Network, name: str, to_server: bool, sender: "TcpFile") -> None:
        self._network, self._name, self._to_server = network, name, to_server
        self._kernel = network.kernel
        self._rng = sender.rng
        self.sender, self.receiver = sender, sender
        self.waiting = bytearray()
        self.in_flight = 0
        self.ends = False
        self._has_ended = False
        self.is_cut = False
        self.lost: list[bytes] = []
        self.lost_ns = 0
        self._last_ns = 0

    @property
    def unacknowledged(self) -> int:
        """Number of bytes that take room at the sender."""
        return len(self.waiting) + self.in_flight

    def push(self) -> None:
        """Send as much as the receiver has room for."""
        while self.waiting and (room := self.receiver.room - self.in_flight) > 0:
            data = bytes(self.waiting[:room])
            del self.waiting[:room]
            self._send(data)
        if self.ends and not self.waiting and not self._has_ended:
            self._has_ended = True
            self._segment(_FIN)

    def _send(self, data: bytes) -> None:
        if self._network.spoil is not None and not (
            data := self._network.spoil(self._name, self._to_server, data)
        ):
            return
        faults = self._network.faults
        if len(data) > 1 and faults.happens("split", self._name, _MOST_SPLIT):
            at = faults.drawn("split", self._name).randrange(1, len(data))
            self._segment(data[:at])
            data = data[at:]
        self._segment(data)

    def _segment(self, data: bytes) -> None:
        delay_ns = self._rng.randrange(*_TRANSIT_NS)
        faults = self._network.faults
        if faults.happens("late-segment", self._name, _MOST_LATE):
            delay_ns += round(10 ** faults.drawn("late-segment", self._name).uniform(6, 9.3))
        self._last_ns = max(self._last_ns + 1, self._kernel.now_ns + delay_ns)
        self.in_flight += len(data)
        self._kernel.at(self._last_ns, lambda: self._arrive(data))

    def _arrive(self, data: bytes) -> None:
        if self.is_cut:
            if not self.lost:
                self.lost_ns = self._kernel.now_ns
            self.lost.append(data)
            return
        self.in_flight -= len(data)
        self.receiver.arrived(data)
        if data:
            self.sender.changed()

    def reset(self) -> None:
        """Reset the receiver; a reset that is lost is not sent again."""
        self.waiting.clear()
        self._last_ns = max(self._last_ns + 1, self._kernel.now_ns + self._rng.randrange(*_TRANSIT_NS))
        self._kernel.at(self._last_ns, lambda: None if self.is_cut else self.receiver.was_reset())

    def mend(self) -> None:
        """Put the cable back: lost segments arrive with the next retransmission."""
        self.is_cut = False
        if self.lost:
            wait_ns = _FIRST_RETRANSMISSION_NS * (2 ** (self.retransmissions + 1) - 1)
            lost, self.lost = self.lost, []
            due_ns = self._last_ns = max(self.lost_ns + wait_ns, self._last_ns + 1, self._kernel.now_ns)
            for data in lost:
                self._kernel.at(due_ns, lambda data=data: self._arrive(data))

    @property
    def retransmissions(self) -> int:
        """Number of times the first segment that was lost has been sent again."""
        if not self.lost:
            return 0
        periods = (self._kernel.now_ns - self.lost_ns) // _FIRST_RETRANSMISSION_NS
        return min((periods + 1).bit_length() - 1, _MOST_RETRANSMISSIONS)


class TcpFile(OpenFile):
    """One TCP socket in the kernel.

    Attributes:
        port: Local port number; 0 before it has one.
        peer: Other end of its connection; None without one.
        way: Direction in which it sends.
        incoming: Bytes that have arrived and were not read.
        has_ended: True if the other end sends no more.
        is_shut: True if it sends no more.
        is_gone: True if its connection is over.
        error: Number of the error that the next call reports; 0 for none.
        options: Values of its options, by level and number.
        backlog: Number of connections that may wait to be accepted; -1 if it does not listen.
    """

    def __init__(self, network: Network, name: str) -> None:
        super().__init__(network.kernel)
        self.network, self.name = network, name
        self.rng = network.kernel.current.rng if network.kernel.current else network.kernel.processes[0].rng
        self.address, self.port = "127.0.0.1", 0
        self.peer: TcpFile | None = None
        self.incoming = bytearray()
        self.has_ended = self.is_shut = self.is_deaf = self.is_gone = self.is_closed = False
        self.is_connecting = False
        self.error = 0
        self.options: dict[tuple[int, int], int | bytes] = {}
        self.backlog = -1
        self.queue: list[TcpFile] = []
        self.way = _Way(network, name, True, self)
        self.heard_ns = 0

    # Asked by the kernel -------------------------------------------------------------------------------

    def readable(self) -> bool:
        """Return whether a read, or an accept, returns immediately."""
        if self.backlog >= 0:
            return bool(self.queue)
        return bool(
            self.incoming or self.has_ended or self.is_deaf or self.error or self.is_gone or self._is_new
        )

    def writable(self) -> bool:
        """Return whether a write returns immediately; a third of the buffer must be free."""
        if self.error or self.is_gone or self.is_shut or self._is_new:
            return self.backlog < 0
        return not self.is_connecting and 3 * self.way.unacknowledged <= 2 * self.limit(socket.SO_SNDBUF)

    def hung_up(self) -> bool:
        """Return whether both directions have ended."""
        return self.backlog < 0 and (self.is_gone or self._is_new or (self.has_ended and self.is_shut))

    @property
    def _is_new(self) -> bool:
        return self.peer is None and not self.is_connecting and self.backlog < 0

    @property
    def room(self) -> int:
        """Number of bytes that may still arrive."""
        return self.limit(socket.SO_RCVBUF) - len(self.incoming)

    def limit(self, option: int) -> int:
        """Return the size of a buffer [bytes]."""
        value = self.options.get((socket.SOL_SOCKET, option), BUFFER)
        assert isinstance(value, int)
        return value

    # Calls of its program ------------------------------------------------------------------------------

    def raise_error(self) -> None:
        """Raise the error that is to be reported, once."""
        if number := self.take_error():
            raise OSError(number, os.strerror(number))

    def take_error(self) -> int:
        """Return the number of the error that is to be reported, once."""
        number, self.error = self.error, 0
        return number

    def read(self, limit: int) -> bytes:
        """Take bytes that have arrived."""
        if not self.incoming:
            self.raise_error()
            if self._is_new:
                raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
            if not self.readable():
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            return b""
        data = bytes(self.incoming[:limit])
        del self.incoming[:limit]
        if self.peer is not None:
            self.peer.way.push()
        return data

    def write(self, data: bytes) -> int:
        """Take bytes to send."""
        self.raise_error()
        if self.is_shut or self.is_gone or self.peer is None:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        room = self.limit(socket.SO_SNDBUF) - self.way.unacknowledged
        if room <= 0:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self.way.waiting += data[:room]
        self.way.push()
        return min(len(data), room)

    def shut(self, how: int) -> None:
        """Shut down one direction or both."""
        if self.peer is None or self.is_gone:
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
        if how in (socket.SHUT_RD, socket.SHUT_RDWR):
            self.is_deaf = True
        if how in (socket.SHUT_WR, socket.SHUT_RDWR) and not self.is_shut:
            self.is_shut = self.way.ends = True
            self.way.push()
        self.changed()

    def closed(self) -> None:
        """Release it: end the connection, or reset it if bytes were not read."""
        self.is_closed = True
        if self.backlog >= 0:
            self.network.listeners.pop(self.port, None)
            for connection in self.queue:
                connection.closed_with_reset()
            return
        linger = self.options.get((socket.SOL_SOCKET, socket.SO_LINGER), b"")
        hard = isinstance(linger, bytes) and len(linger) == 8 and struct.unpack("ii", linger) == (1, 0)
        if self.peer is None or self.is_gone:
            self.is_gone = True
        elif self.incoming or hard:
            self.closed_with_reset()
        elif not self.is_shut:
            self.is_shut = self.way.ends = True
            self.way.push()

    def closed_with_reset(self) -> None:
        """Reset the connection."""
        self.is_closed = self.is_gone = True
        self.incoming.clear()
        self.way.reset()

    # Arrivals ------------------------------------------------------------------------------------------

    def arrived(self, data: bytes) -> None:
        """Receive a segment, or the end of the other end's stream."""
        self.heard_ns = self.kernel.now_ns
        if self.is_gone or (data and (self.is_closed or (self.is_deaf and self.is_shut))):
            self.is_gone = True
            self.way.reset()
            return
        if data:
            self.incoming += data
        else:
            self.has_ended = True
            self.is_gone = self.is_gone or (self.is_closed and self.is_shut)
        self.changed()

    def was_reset(self, number: int = errno.ECONNRESET) -> None:
        """Take a reset, or an error in its place."""
        if not self.is_gone:
            self.error = errno.EPIPE if self.has_ended and number == errno.ECONNRESET else number
            self.is_gone, self.is_connecting = True, False
            self.way.waiting.clear()
            self.changed()

    def watch_silence(self) -> None:
        """Report an end that has vanished: by keepalive, or as nothing that is sent to it is acknowledged."""
        if not self.way.is_cut or self.is_gone:
            return
        if self.way.retransmissions >= _MOST_RETRANSMISSIONS:
            self.was_reset(errno.ETIMEDOUT)
            return
        now_ns, wait_ns = self.kernel.now_ns, NS_PER_S
        if self.options.get((socket.SOL_SOCKET, socket.SO_KEEPALIVE)) and not self.way.lost:
            idle, interval, probes = (
                int(self.options.get((socket.IPPROTO_TCP, option), value))
                for option, value in (
                    (socket.TCP_KEEPIDLE, 7200),
                    (socket.TCP_KEEPINTVL, 75),
                    (socket.TCP_KEEPCNT, 9),
                )
            )
            if now_ns >= self.heard_ns + (idle + interval * probes) * NS_PER_S:
                self.was_reset(errno.ETIMEDOUT)
                return
        self.kernel.at(now_ns + wait_ns, self.watch_silence)

    # Connections ---------------------------------------------------------------------------------------

    def connect(self, port: int) -> None:
        """Ask for a connection to a port; the answer comes some time later."""
        self.is_connecting = True
        self.port = self.port or self.network.free_port()
        self._ask(port)

    def _ask(self, port: int) -> None:
        self.kernel.at(
            self.kernel.now_ns + self.rng.randrange(*_TRANSIT_NS), lambda: self._deliver_request(port)
        )

    def _deliver_request(self, port: int) -> None:
        """Reach the other machine."""
        if self.is_closed or not self.is_connecting:
            return
        now_ns, listener = self.kernel.now_ns, self.network.listeners.get(port)
        if listener is None:
            self.kernel.at(now_ns + self.rng.randrange(*_TRANSIT_NS), self._refused)
        elif len(listener.queue) > listener.backlog:
            self.kernel.at(now_ns + _SYN_RETRY_NS, lambda: self._ask(port))
        else:
            end = TcpFile(self.network, self.name)
            end.rng, end.port, end.address = listener.rng, port, listener.address
            end.options = dict(listener.options)
            end.way = _Way(self.network, self.name, False, end)
            end.peer, self.peer = self, end
            end.way.receiver, self.way.receiver = self, end
            end.heard_ns = self.heard_ns = now_ns
            listener.queue.append(end)
            listener.changed()
            self.kernel.at(now_ns + self.rng.randrange(*_TRANSIT_NS), self._accepted)

    def _refused(self) -> None:
        self.error, self.is_connecting = errno.ECONNREFUSED, False
        self.changed()

    def _accepted(self) -> None:
        if self.is_connecting:
            self.is_connecting = False
            self.changed()
