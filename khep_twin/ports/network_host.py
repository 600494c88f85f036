"""Host at a network port, with buffers of the bytes from it and for it.

Network hosts often call `recv` once and take the result as the complete reply. Bytes are therefore held
until their line is complete or a twin's reply ends, and sent together. Replies of several lines, such as the
banner, are sent line by line; other bytes without a line end are sent after a short silence.

TCP reports when a host will send no more, not whether it still reads: a closed connection looks like a
half-closed one until bytes are sent to it. A host that has finished sending therefore stays connected until
it has been answered, or until another one connects.
"""

import socket
import time

from khep_twin.board.uart import LineSettings
from khep_twin.ports.negotiation import Negotiator

QUEUE_LIMIT = 4096
"""Most reply bytes in the buffer for a host that does not read; more are dropped and counted."""

ANSWERS_LIMIT = 4 * QUEUE_LIMIT
"""Most bytes of replies and negotiation answers in the buffer; beyond them the host is disconnected."""

WAITING_LIMIT = 16384
"""Unread bytes behind which the end of a connection cannot be detected; the next host replaces this one."""

LAST_LIMIT = 4096
"""Most last bytes of a host that has left; the size of a PC's serial buffer."""

LONGEST_LINE = 512
"""Most bytes that are held until their line is complete; the camera's 64 values are shorter."""

SILENCE_S = 0.1
"""Wall time after the last byte at which an unfinished line is sent [s]."""

_BROWSER_PREFIXES = (b"GET ", b"HEAD ", b"POST ", b"OPTIONS ", b"\x16\x03")
"""First bytes of HTTP requests and TLS: any web page can make a browser send commands for the robot here."""

_MAX_RETRANSMISSIONS = 7
"""Retransmissions, in half a minute, after which a host counts as lost; the system tries for 15 minutes."""


class NetworkHost:
    """One host at a network port; with a baud rate of the line it negotiates settings by RFC 2217.

    Attributes:
        address: Address of the host.
        is_lost: True if its connection is lost: reset, broken, or closed for a fault.
        fault: Reason for closing it; empty without one.
        dropped: Number of reply bytes that were dropped because it did not read them in time.
    """

    def __init__(self, client: socket.socket, address: str, baud: int | None) -> None:
        self.address = address
        self.is_lost = False
        self.fault = ""
        self.dropped = 0
        self._client = client
        client.setblocking(False)
        self._has_finished = False
        self._input = bytearray()  # raw, with negotiations
        self._first_bytes = b""  # of the connection
        self._held_reply = bytearray()
        self._last_write_s = 0.0
        self._output: bytearray = bytearray()
        self._negotiator = None if baud is None else Negotiator(baud, self._output.extend)

    @property
    def descriptor(self) -> int | None:
        """Descriptor that becomes readable when it sends or leaves; None once it has finished sending."""
        return None if self._has_finished else self._client.fileno()

    @property
    def is_done(self) -> bool:
        """True if it has finished sending and all buffers are empty."""
        return self._has_finished and not (self._input or self._held_reply or self._output)

    def settings(self) -> LineSettings | None:
        """Return its line settings; None without RFC 2217."""
        return None if self._negotiator is None else self._negotiator.settings()

    def update(self) -> None:
        """Send buffered bytes, and check whether the connection is lost."""
        if self._held_reply and time.monotonic() - self._last_write_s > SILENCE_S:
            self._send_held(len(self._held_reply))
        self._flush()
        has_error = bool(self._client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        self.is_lost = self.is_lost or has_error or _retransmissions(self._client) >= _MAX_RETRANSMISSIONS

    def keeps_port(self) -> bool:
        """Return whether it keeps the port when another host connects: it is connected and not overfull."""
        self._read(WAITING_LIMIT)
        return not self.is_lost and not self._has_finished and not self.is_overfull

    @property
    def is_overfull(self) -> bool:
        """True if it has so many unread bytes that the end of its connection cannot be detected."""
        return len(self._input) >= WAITING_LIMIT

    def receive(self, limit: int) -> bytes:
        """Return bytes that it has sent, at most `limit`."""
        self._read(limit)
        data = bytes(self._input[:limit])
        del self._input[:limit]
        if self._negotiator is None or self.fault:
            return b"" if self.fault else data
        data = self._negotiator.decode(data)
        self.fault = self._negotiator.fault
        if not self.fault and len(self._output) > ANSWERS_LIMIT:
            self.fault = f"{len(self._output)} bytes wait to be read; expected a host that reads its answers"
        if self.fault:
            self.is_lost = True
        self._flush()
        return data

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Send complete lines, at an end all bytes; those without room are dropped and counted."""
        self._held_reply += data
        self._last_write_s = time.monotonic()
        is_whole = is_end or len(self._held_reply) >= LONGEST_LINE
        self._send_held(len(self._held_reply) if is_whole else self._held_reply.rfind(b"\n") + 1)

    def close(self) -> None:
        """End the connection."""
        self._client.close()

    def _send_held(self, count: int) -> None:
        """Send `count` of the held bytes together."""
        # Bytes that the system accepts now need no room in the buffer, however many they are.
        while count and (free_bytes := QUEUE_LIMIT - len(self._output)) > 0:
            chunk = bytes(self._held_reply[: min(count, free_bytes)])
            del self._held_reply[: len(chunk)]
            count -= len(chunk)
            self._output += chunk if self._negotiator is None else self._negotiator.encode(chunk)
            self._flush()
        self.dropped += count
        del self._held_reply[:count]

    def _read(self, limit: int) -> None:
        """Read until `limit` bytes are buffered, or no more have arrived."""
        while len(self._input) < limit and not self._has_finished:
            try:
                data = self._client.recv(limit - len(self._input))
            except BlockingIOError:
                return
            except OSError:  # reset, timed out, or the network is down
                self.is_lost = True
                return
            self._input += data
            self._has_finished = not data
            if len(self._first_bytes) < max(map(len, _BROWSER_PREFIXES)):
                self._first_bytes += data
                if self._first_bytes.startswith(_BROWSER_PREFIXES) and not self.fault:
                    shown_bytes = self._first_bytes[:8]
                    self.fault = f"it begins with {shown_bytes}, as a browser does; expected a robot's host"
                    self.is_lost = self._has_finished = True

    def _flush(self) -> None:
        if self._output:
            try:
                del self._output[: self._client.send(self._output)]
            except BlockingIOError:
                pass  # no room yet
            except OSError:
                self.is_lost = True
                self._output.clear()


def _retransmissions(client: socket.socket) -> int:
    """Return the retransmissions of the packet in flight; 0 if the system does not report them."""
    option = getattr(socket, "TCP_INFO", None)
    # The third byte of Linux's struct tcp_info.
    return 0 if option is None else client.getsockopt(socket.IPPROTO_TCP, option, 3)[2]
