"""TCP connections as the far end of a serial cable: plain bytes, or RFC 2217 with its line settings.

One host at a time, as on a cable: a second one is refused and reported. A host that has left, or has
finished sending, is replaced by the next one at once.
"""

import ipaddress
import re
import socket
from collections.abc import Sequence

from khep_twin.board.uart import LineSettings
from khep_twin.errors import PortError
from khep_twin.ports.host_port import NoticeLimit, Received
from khep_twin.ports.network_host import LAST_LIMIT, WAITING_LIMIT, NetworkHost

_BACKLOG = 8

_SILENT_S, _PROBE_S, _PROBES = 10, 5, 3
"""Silence after which a host is probed [s], interval of probes [s], and probes until it counts as lost."""


class TcpPort:
    """A `HostPort` that is a TCP server for one host at a time.

    Args:
        host: Name or address to listen at.
        port: Port number; 0 for any free one.
        rfc2217: Negotiate line settings.
        baud: Speed of the robot's line [baud].

    Attributes:
        path: URL that pyserial opens.

    Raises:
        PortError: The address cannot be listened at.
    """

    def __init__(self, host: str, port: int, *, rfc2217: bool = False, baud: int = 9600) -> None:
        self._baud = baud if rfc2217 else None
        self._host: NetworkHost | None = None
        self._dropped = 0
        self._notice_limit = NoticeLimit()
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._server = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        except (OSError, OverflowError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise PortError(f"{host}:{port}: cannot listen here: {reason}") from error
        self._server.setblocking(False)
        # Connections inherit these. What a host has sent waits here or, beyond that, at the host.
        self._server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * WAITING_LIMIT)
        _ask_silent_hosts(self._server)
        shown = f"[{host}]" if ":" in host else host
        scheme = "rfc2217" if rfc2217 else "socket"
        self.path = f"{scheme}://{shown}:{self._server.getsockname()[1]}"

    @property
    def occupied(self) -> bool:
        """True if a host is connected."""
        return self._host is not None

    @property
    def dropped(self) -> int:
        """Number of bytes that no host took in time."""
        return self._dropped + (0 if self._host is None else self._host.dropped)

    def descriptors(self, room: bool) -> Sequence[int]:
        """Return the descriptors that become readable when a host comes, goes or, if `room`, writes."""
        host = self._host.descriptor if self._host is not None and room else None
        return [self._server.fileno(), *([] if host is None else [host])]

    def set_baud(self, baud: int) -> None:
        """Take the speed of the robot's line, from which the next host's negotiation begins [baud]."""
        self._baud = self._baud and baud

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; None without RFC 2217."""
        return None if self._host is None else self._host.settings()

    def receive(self, limit: int, answered: bool = False) -> Received:
        """Take what the host has sent, and news about hosts; at most one host follows another in a call."""
        notices: list[str] = []
        last = None
        if self._host is not None:
            self._host.look()
            if self._host.lost or (answered and self._host.done):
                last = self._disconnect(notices)
        for _ in range(_BACKLOG):
            came = self._accept(notices)
            if came is None:
                break
            client, address = came
            if self._host is not None and self._host.stays():
                client.close()
                notices.append(f"a second host, {address}, was refused: the port is taken")
                continue
            if self._host is not None:
                if self._host.overfull:
                    notices.append(
                        f"a host, {self._host.address}, gave way to the next, {address}: "
                        f"{WAITING_LIMIT} bytes or more of it were waiting"
                    )
                last = self._disconnect(notices)
            self._host = NetworkHost(client, address, self._baud)
            break
        data = b"" if self._host is None else self._host.take(limit)
        return Received(data, last is not None, last or b"", self._notice_limit.admit(notices))

    def write(self, data: bytes) -> None:
        """Send whole lines to the host; what it leaves no room for is dropped and counted."""
        if self._host is not None:
            self._host.write(data)

    def close(self) -> None:
        """End the connection and stop listening."""
        if self._host is not None:
            self._host.close()
            self._host = None
        self._server.close()

    def _accept(self, notices: list[str]) -> tuple[socket.socket, str] | None:
        try:
            client, address = self._server.accept()
        except BlockingIOError:
            return None
        except OSError as error:  # it has left again, or there is no descriptor to spare
            notices.append(f"a host could not be let in: {error.strerror}")
            return None
        return client, address[0]

    def _disconnect(self, notices: list[str]) -> bytes:
        """End the connection of a host that has left; return what it had still sent."""
        host, self._host = self._host, None
        if host is None:
            return b""
        last = host.take(LAST_LIMIT)
        if host.fault:
            notices.append(f"a host, {host.address}, was cut off: {host.fault}")
        self._dropped += host.dropped
        host.close()
        return last


def address_fault(url: str) -> str:
    """Return the fault of the address in a URL of pyserial's network ports; empty for none or another URL."""
    kind, _, rest = url.partition("://")
    if kind in ("socket", "rfc2217"):
        try:
            parse_address(re.split("[/?]", rest)[0])
        except PortError:
            return f"{url}: expected {kind}://HOST:PORT, such as {kind}://127.0.0.1:5000"
    return ""


def parse_address(text: str) -> tuple[str, int]:
    """Split HOST:PORT; the host of `:PORT` is this machine only.

    Raises:
        PortError: The text has another form.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65535:
        raise PortError(f"{text}: expected HOST:PORT, such as 127.0.0.1:5000, or port 0 for any free one")
    return host.strip("[]") or "127.0.0.1", int(port)


def listening_address(
    text: str, act: str, *, allow_remote: bool, option: str = "--allow-remote"
) -> tuple[str, int]:
    """Split HOST:PORT of a server, which by default only this machine may reach.

    Args:
        text: Address as typed.
        act: What other machines could do there, for the error.
        allow_remote: Allow connections from other machines.
        option: Option that allows them, for the error.

    Raises:
        PortError: The text has another form, or other machines could reach the address.
    """
    host, port = parse_address(text)
    if not is_loopback(host) and not allow_remote:
        raise PortError(
            f"{text}: other machines could {act} from there; expected 127.0.0.1:{port}, or {option} if that "
            "is wanted"
        )
    return host, port


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _ask_silent_hosts(server: socket.socket) -> None:
    """Let the system detect a host that vanished without closing, as by a cable pulled out."""
    server.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("IDLE", _SILENT_S), ("INTVL", _PROBE_S), ("CNT", _PROBES)):
        if option := getattr(socket, f"TCP_KEEP{name}", None):
            server.setsockopt(socket.IPPROTO_TCP, option, value)
