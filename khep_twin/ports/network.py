"""TCP servers as host ports: with plain bytes, or with RFC 2217, which also transmits line settings.

One host is connected at a time, as on a cable; a second one is refused and reported. The next host replaces
one that has left or finished sending immediately.
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

_SILENCE_S, _PROBE_S, _N_PROBES = 10, 5, 3
"""Silence after which a host is probed [s], interval of probes [s], and probes until it counts as lost."""


class TcpPort:
    """A `HostPort` that is a TCP server for one host at a time.

    Args:
        host: Name or address to listen at.
        port: Port number; 0 for any free one.
        rfc2217: Negotiate line settings.
        baud: Baud rate of the robot's line.

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
        # Connections inherit these options. Unread bytes of a host wait here; beyond the limit, at the host.
        self._server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * WAITING_LIMIT)
        _enable_keepalive(self._server)
        address = f"[{host}]" if ":" in host else host
        scheme = "rfc2217" if rfc2217 else "socket"
        self.path = f"{scheme}://{address}:{self._server.getsockname()[1]}"

    @property
    def occupied(self) -> bool:
        """True if a host is connected."""
        return self._host is not None

    @property
    def dropped(self) -> int:
        """Number of reply bytes that were dropped because no host read them in time."""
        return self._dropped + (0 if self._host is None else self._host.dropped)

    def descriptors(self, has_room: bool) -> Sequence[int]:
        """Return the descriptors that are readable when a host connects, leaves or, if `has_room`, writes."""
        host = self._host.descriptor if self._host is not None and has_room else None
        return [self._server.fileno(), *([] if host is None else [host])]

    def set_baud(self, baud: int) -> None:
        """Set the baud rate of the robot's line, the first value of the next host's negotiation."""
        self._baud = self._baud and baud

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; None without RFC 2217."""
        return None if self._host is None else self._host.settings()

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        """Return the host's bytes and changes among hosts; at most one host replaces another per call."""
        notices: list[str] = []
        last_data = None
        if self._host is not None:
            self._host.update()
            if self._host.is_lost or (is_answered and self._host.is_done):
                last_data = self._disconnect(notices)
        for _ in range(_BACKLOG):
            connection = self._accept(notices)
            if connection is None:
                break
            client, address = connection
            if self._host is not None and self._host.keeps_port():
                client.close()
                notices.append(f"a second host, {address}, was refused: the port is taken")
                continue
            if self._host is not None:
                if self._host.is_overfull:
                    notices.append(
                        f"a host, {self._host.address}, gave way to the next, {address}: "
                        f"{WAITING_LIMIT} bytes or more of it were waiting"
                    )
                last_data = self._disconnect(notices)
            self._host = NetworkHost(client, address, self._baud)
            break
        data = b"" if self._host is None else self._host.receive(limit)
        return Received(data, last_data is not None, last_data or b"", self._notice_limit.admit(notices))

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Send complete replies to the host; bytes without room are dropped and counted."""
        if self._host is not None:
            self._host.write(data, is_end)

    def close(self) -> None:
        """End the connection and stop listening."""
        if self._host is not None:
            self._host.close()
            self._host = None
        self._server.close()

    def _accept(self, notices: list[str]) -> tuple[socket.socket, str] | None:
        """Accept a waiting host; return its socket and address, None without one."""
        try:
            client, address = self._server.accept()
        except BlockingIOError:
            return None
        except OSError as error:  # it has left again, or no descriptor is free
            notices.append(f"a host could not be let in: {error.strerror}")
            return None
        return client, address[0]

    def _disconnect(self, notices: list[str]) -> bytes:
        """End the connection of a host that has left; return its last bytes."""
        host, self._host = self._host, None
        if host is None:
            return b""
        last_data = host.receive(LAST_LIMIT)
        if host.fault:
            notices.append(f"a host, {host.address}, was cut off: {host.fault}")
        self._dropped += host.dropped
        host.close()
        return last_data


def address_fault(url: str) -> str:
    """Return the error in the address of a pyserial network URL; empty for a valid one or another URL."""
    scheme, _, location = url.partition("://")
    if scheme in ("socket", "rfc2217"):
        try:
            parse_address(re.split("[/?]", location)[0])
        except PortError:
            return f"{url}: expected {scheme}://HOST:PORT, such as {scheme}://127.0.0.1:5000"
    return ""


def parse_address(address: str) -> tuple[str, int]:
    """Split HOST:PORT; the host of `:PORT` is this machine only.

    Raises:
        PortError: The address has another form.
    """
    host, colon, port = address.rpartition(":")
    if not colon or not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65535:
        raise PortError(f"{address}: expected HOST:PORT, such as 127.0.0.1:5000, or port 0 for any free one")
    return host.strip("[]") or "127.0.0.1", int(port)


def listening_address(
    address: str, action: str, *, allow_remote: bool, option: str = "--allow-remote"
) -> tuple[str, int]:
    """Split HOST:PORT of a server, which by default only this machine may reach.

    Args:
        address: Address as typed.
        action: Action that other machines could perform there, for the error message.
        allow_remote: Allow connections from other machines.
        option: Option that allows them, for the error message.

    Raises:
        PortError: The address has another form, or other machines could reach the address.
    """
    host, port = parse_address(address)
    if not is_loopback(host) and not allow_remote:
        raise PortError(
            f"{address}: other machines could {action} from there; expected 127.0.0.1:{port}, or {option} if "
            "that is wanted"
        )
    return host, port


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _enable_keepalive(server: socket.socket) -> None:
    """Let the system detect a host that vanished without closing, such as one with its cable pulled out."""
    server.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("IDLE", _SILENCE_S), ("INTVL", _PROBE_S), ("CNT", _N_PROBES)):
        if option := getattr(socket, f"TCP_KEEP{name}", None):
            server.setsockopt(socket.IPPROTO_TCP, option, value)
