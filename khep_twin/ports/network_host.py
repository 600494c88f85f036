"""The host at a network port, with the bytes received from it and waiting for it.

Network hosts call `recv` once and take the result for a whole reply. Bytes are therefore held back until
their line is complete and sent in one piece, at the time at which its last byte has arrived. Replies of
several lines, such as the banner, are sent line by line, a line without an end after a short silence.

TCP reports when a host will send no more, not whether it still reads: a closed connection looks like a
half-closed one until something is sent to it. A host that has finished sending therefore stays until it has
been answered, or until another one connects.
"""

import socket
import time

from khep_twin.board.uart import LineSettings
from khep_twin.ports.negotiation import Negotiator

QUEUE_LIMIT = 4096
"""Most bytes of replies that wait for a host that does not read; the rest is dropped and counted."""

ANSWERS_LIMIT = 4 * QUEUE_LIMIT
"""Most bytes of any kind that wait for it; one that never reads its answers is disconnected."""

WAITING_LIMIT = 16384
"""Bytes behind which a host's leaving cannot be detected; with so many waiting it is replaced by the next."""

LAST_LIMIT = 4096
"""Most bytes of a host that has left that are carried out: the size of a PC's serial buffer."""

LONGEST_LINE = 512
"""Bytes that are held back at most; the camera's 64 values are shorter."""

SILENCE = 0.1
"""Wall time after the last byte at which an unfinished line is sent all the same [s]."""

_OF_BROWSERS = (b"GET ", b"HEAD ", b"POST ", b"OPTIONS ", b"\x16\x03")
"""Beginnings of what a browser sends: requests of HTTP that a page may send anywhere, and TLS.

Any page can have its browser send a request here, with commands for the robot in it, a line each.
"""

_MOST_RETRANSMISSIONS = 7
"""Retransmissions, for half a minute, before a host is taken to have vanished.

The system alone tries for a quarter of an hour.
"""


class NetworkHost:
    """One host at a network port; it negotiates settings by RFC 2217 where the line's speed is given [baud].

    Attributes:
        address: Address of the host.
        lost: True if its connection is lost: reset, broken, or closed for a fault.
        fault: Reason why it was closed; empty if it was not.
        dropped: Number of bytes that it did not take in time.
    """

    def __init__(self, client: socket.socket, address: str, baud: int | None) -> None:
        self.address = address
        self.lost = False
        self.fault = ""
        self.dropped = 0
        self._client = client
        client.setblocking(False)
        self._finished = False
        self._ahead = bytearray()  # as it came, with negotiations
        self._beginning = b""  # of all that it has sent
        self._line = bytearray()
        self._heard = 0.0
        self._waiting: bytearray = bytearray()
        self._negotiator = None if baud is None else Negotiator(baud, self._waiting.extend)

    @property
    def descriptor(self) -> int | None:
        """Descriptor that becomes readable when it sends or leaves; None when it has finished sending."""
        return None if self._finished else self._client.fileno()

    @property
    def done(self) -> bool:
        """True if it has finished sending, and nothing from it or for it waits here."""
        return self._finished and not (self._ahead or self._line or self._waiting)

    def settings(self) -> LineSettings | None:
        """Return its line settings; None without RFC 2217."""
        return None if self._negotiator is None else self._negotiator.settings()

    def look(self) -> None:
        """Send the bytes that wait for it; check whether its connection is lost."""
        if self._line and time.monotonic() - self._heard > SILENCE:
            self._release(len(self._line))
        self._flush()
        failed = bool(self._client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        self.lost = self.lost or failed or _retransmissions(self._client) >= _MOST_RETRANSMISSIONS

    def stays(self) -> bool:
        """Return whether it keeps the port when another host connects: it still sends, and not too much."""
        self._read(WAITING_LIMIT)
        return not self.lost and not self._finished and not self.overfull

    @property
    def overfull(self) -> bool:
        """True if so many of its bytes wait here that its leaving could not be detected."""
        return len(self._ahead) >= WAITING_LIMIT

    def take(self, limit: int) -> bytes:
        """Return what it has sent, at most `limit` bytes."""
        self._read(limit)
        data = bytes(self._ahead[:limit])
        del self._ahead[:limit]
        if self._negotiator is None or self.fault:
            return b"" if self.fault else data
        data = self._negotiator.received(data)
        self.fault = self._negotiator.fault
        if not self.fault and len(self._waiting) > ANSWERS_LIMIT:
            self.fault = f"{len(self._waiting)} bytes wait to be read; expected a host that reads its answers"
        if self.fault:
            self.lost = True
        self._flush()
        return data

    def write(self, data: bytes) -> None:
        """Send whole lines; what it leaves no room for is dropped and counted."""
        self._line += data
        self._heard = time.monotonic()
        is_long = len(self._line) >= LONGEST_LINE
        self._release(len(self._line) if is_long else self._line.rfind(b"\n") + 1)

    def close(self) -> None:
        """End the connection."""
        self._client.close()

    def _release(self, count: int) -> None:
        """Send so many of the bytes that are held back, in one piece."""
        # What the system takes at once waits for no one, however much it is.
        while count and (room := QUEUE_LIMIT - len(self._waiting)) > 0:
            taken = bytes(self._line[: min(count, room)])
            del self._line[: len(taken)]
            count -= len(taken)
            self._waiting += taken if self._negotiator is None else self._negotiator.escaped(taken)
            self._flush()
        self.dropped += count
        del self._line[:count]

    def _read(self, limit: int) -> None:
        """Read until so many bytes are here, or all that have come."""
        while len(self._ahead) < limit and not self._finished:
            try:
                data = self._client.recv(limit - len(self._ahead))
            except BlockingIOError:
                return
            except OSError:  # reset, timed out, or the network is down
                self.lost = True
                return
            self._ahead += data
            self._finished = not data
            if len(self._beginning) < max(map(len, _OF_BROWSERS)):
                self._beginning += data
                if self._beginning.startswith(_OF_BROWSERS) and not self.fault:
                    begin = self._beginning[:8]
                    self.fault = f"it begins with {begin}, as a browser does; expected a robot's host"
                    self.lost = self._finished = True

    def _flush(self) -> None:
        if self._waiting:
            try:
                del self._waiting[: self._client.send(self._waiting)]
            except BlockingIOError:
                pass  # it leaves no room yet
            except OSError:
                self.lost = True
                self._waiting.clear()


def _retransmissions(client: socket.socket) -> int:
    """Return how often the packet in flight was sent again; 0 where the system does not report it."""
    option = getattr(socket, "TCP_INFO", None)
    # The third byte of Linux's struct tcp_info.
    return 0 if option is None else client.getsockopt(socket.IPPROTO_TCP, option, 3)[2]
