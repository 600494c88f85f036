"""TCP connections as the far end of a serial cable: plain bytes, or RFC 2217 with its settings of the line.

One host at a time, as on a cable: a second one is refused and told of. RFC 2217's negotiation is pyserial's
own, over a port object that only remembers what the host has set.

Hosts of the network call `recv` once and take what they get for a whole reply. So bytes are held back until
their line is complete and leave in one piece, at the time at which its last byte has arrived. Replies of
several lines, such as the banner, leave line by line. A line whose end never comes leaves after a moment's
silence.
"""

# pyserial's server half of RFC 2217 is not typed.
# pyright: reportUnknownMemberType=false, reportArgumentType=false

import ipaddress
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import serial
from serial.rfc2217 import PortManager

from khep_twin.errors import PortError
from khep_twin.ports.cable import Received
from khep_twin.uart import LineSettings

QUEUE_LIMIT = 4096
"""Most bytes that wait for a host that does not read; the rest is dropped and counted."""

LONGEST_LINE = 512
"""Bytes that are held back at most; the camera's 64 values are shorter."""

SILENCE = 0.1
"""Wall time after the last byte at which a line that has not ended leaves all the same [s]."""

_BACKLOG = 8


class TcpPort:
    """A `Cable`: a TCP server for one host at a time.

    Args:
        host: name or address to listen at.
        port: its number; 0 for any free one.
        rfc2217: whether settings of the line are negotiated.
        baud: speed of the robot's line.

    Attributes:
        path: URL that pyserial opens.
        dropped: bytes that no host took in time.

    Raises:
        PortError: nothing can listen there.
    """

    def __init__(self, host: str, port: int, *, rfc2217: bool = False, baud: int = 9600) -> None:
        self.dropped = 0
        self._baud = baud
        self._rfc2217 = rfc2217
        self._client: socket.socket | None = None
        self._line = bytearray()
        self._heard = 0.0
        self._waiting = bytearray()
        self._negotiator: _Negotiator | None = None
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._server = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise PortError(f"{host}:{port}: cannot listen here: {reason}") from error
        self._server.setblocking(False)
        shown = f"[{host}]" if ":" in host else host
        scheme = "rfc2217" if rfc2217 else "socket"
        self.path = f"{scheme}://{shown}:{self._server.getsockname()[1]}"

    @property
    def occupied(self) -> bool:
        """Whether a host is connected."""
        return self._client is not None

    def descriptors(self, room: bool) -> Sequence[int]:
        """What becomes readable when a host comes, goes or, if there is room for it, writes."""
        client = [] if self._client is None or not room else [self._client.fileno()]
        return [self._server.fileno(), *client]

    def settings(self) -> LineSettings | None:
        """How the host has set its end; None without RFC 2217."""
        return None if self._negotiator is None else self._negotiator.settings()

    def receive(self, limit: int) -> Received:
        """Take what the host has sent, at most `limit` bytes; the rest goes with its connection."""
        if self._line and time.monotonic() - self._heard > SILENCE:
            self._release(len(self._line))
        left = self._client is not None and self._has_left(self._client)
        if left:
            self._hang_up()
        notices: list[str] = []
        with suppress(BlockingIOError):
            while True:
                client, address = self._server.accept()
                if self._client is None:
                    self._take(client)
                else:
                    client.close()
                    notices.append(f"a second host, {address[0]}, was refused: the port is taken")
        return Received(self._read(limit), left, notices=notices)

    def write(self, data: bytes) -> None:
        """Send whole lines to the host; what it leaves no room for is dropped and counted."""
        if self._client is None:
            return
        self._line += data
        self._heard = time.monotonic()
        is_long = len(self._line) >= LONGEST_LINE
        self._release(len(self._line) if is_long else self._line.rfind(b"\n") + 1)

    def close(self) -> None:
        """Ends the connection and listens no more."""
        self._hang_up()
        self._server.close()

    def _release(self, count: int) -> None:
        """Send so many of the bytes that are held back, in one piece."""
        room = max(QUEUE_LIMIT - len(self._waiting), 0)
        self.dropped += max(count - room, 0)
        taken = bytes(self._line[: min(count, room)])
        del self._line[:count]
        self._waiting += taken if self._negotiator is None else self._negotiator.escaped(taken)
        self._flush()

    def _read(self, limit: int) -> bytes:
        if self._client is None or not limit:
            return b""
        try:
            data = self._client.recv(limit)
        except (BlockingIOError, ConnectionError):
            return b""
        if self._negotiator is not None:
            data = self._negotiator.received(data)
            self._flush()
        return data

    def _take(self, client: socket.socket) -> None:
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        if self._rfc2217:
            self._negotiator = _Negotiator(self._baud, self._waiting.extend)
            self._flush()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = self._negotiator = None
        self._line.clear()
        self._waiting.clear()

    def _flush(self) -> None:
        if self._client is not None and self._waiting:
            try:
                del self._waiting[: self._client.send(self._waiting)]
            except (BlockingIOError, ConnectionError):
                pass  # there is no room yet, or `look` will find that it has left

    @staticmethod
    def _has_left(client: socket.socket) -> bool:
        """Whether the host has closed its end and everything that it sent was read."""
        try:
            return client.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False
        except ConnectionError:
            return True


class _Negotiator:
    """pyserial's server half of RFC 2217, over a port that only remembers its settings."""

    def __init__(self, baud: int, send: Callable[[bytes], None]) -> None:
        self._line = _Line(baud)
        self._send = send
        self._manager = PortManager(self._line, self)

    def write(self, data: bytes) -> None:
        """Sends an answer of the negotiation; called by pyserial."""
        self._send(bytes(data))

    def settings(self) -> LineSettings:
        """What the host has set."""
        return LineSettings(int(self._line.baudrate), 2 if self._line.stopbits > 1 else 1)

    def received(self, data: bytes) -> bytes:
        """The host's bytes without the negotiation in between."""
        return b"".join(self._manager.filter(data))

    def escaped(self, data: bytes) -> bytes:
        """Bytes for the host as they must go over the connection."""
        return b"".join(self._manager.escape(data))


class _Line:
    """Settings of a line as pyserial's server wants to find them; the robot has no modem lines."""

    def __init__(self, baud: int) -> None:
        self.baudrate = baud
        self.bytesize = serial.EIGHTBITS
        self.parity = serial.PARITY_NONE
        self.stopbits: Any = serial.STOPBITS_TWO
        self.rtscts = self.xonxoff = self.break_condition = False
        self.rts = self.dtr = self.cts = self.dsr = self.cd = True
        self.ri = False

    def reset_input_buffer(self) -> None:
        """Nothing waits here."""

    def reset_output_buffer(self) -> None:
        """Nothing waits here."""


def parse_address(text: str) -> tuple[str, int]:
    """HOST:PORT in words; the host of `:PORT` is this machine only.

    Raises:
        PortError: it is written in another way.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise PortError(f"{text}: right is HOST:PORT, such as 127.0.0.1:5000, or port 0 for any free one")
    return host.strip("[]") or "127.0.0.1", int(port)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
