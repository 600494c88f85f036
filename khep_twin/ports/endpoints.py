"""Host ports of a served twin by the command's options: pseudo-terminals or TCP servers."""

import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager

from khep_twin.errors import PortError
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.network import TcpPort, listening_address

_NO_TERMINALS = (
    "this system has no pseudo-terminals; expected --tcp 127.0.0.1:5000, which hosts open as "
    "socket://127.0.0.1:5000, or --rfc2217 127.0.0.1:5000"
)


class NoTerminalsError(PortError):
    """The system has no pseudo-terminals."""


@contextmanager
def open_endpoints(
    bauds: Mapping[int, int], *, link: str | None, tcp: str | None, rfc2217: str | None, allow_remote: bool
) -> Generator[Sequence[HostPort], None, None]:
    """Open one host port for each robot: pseudo-terminals, or TCP servers at consecutive port numbers.

    Args:
        bauds: Baud rate of each robot's line by the robot's number.
        link: Path of the link to the pseudo-terminal, as typed.
        tcp: HOST:PORT to serve plain bytes at instead.
        rfc2217: HOST:PORT to serve RFC 2217 at instead.
        allow_remote: Allow connections from other machines.

    Links of several robots end in the robot's number: khepera0, khepera1 …

    Raises:
        PortError: A port cannot be opened, or more than one kind is requested.
    """
    options = [option for option in (link, tcp, rfc2217) if option is not None]
    if len(options) > 1:
        raise PortError("--link, --tcp and --rfc2217 are one cable each; expected one of them")
    address = rfc2217 if tcp is None else tcp
    with ExitStack() as stack:
        host_ports: list[HostPort] = []
        host_port: HostPort
        for offset, (robot, baud) in enumerate(bauds.items()):
            if address is None:
                link_path = link if link is None or len(bauds) == 1 else f"{link}{robot}"
                host_port = open_terminal(link_path, baud)
            else:
                host, port = listening_address(address, "drive the robot", allow_remote=allow_remote)
                port += offset if port else 0
                host_port = TcpPort(host, port, rfc2217=rfc2217 is not None, baud=baud)
            host_ports.append(stack.enter_context(closing(host_port)))
        yield host_ports


def open_terminal(link: str | None, baud: int) -> HostPort:
    """Open a pseudo-terminal with a link as typed, and a baud rate that applies until a host sets another.

    Raises:
        PortError: The system has no pseudo-terminals or no free one, or the link cannot be made.
    """
    if sys.platform == "win32":
        raise NoTerminalsError(_NO_TERMINALS)
    try:
        from khep_twin.ports.pty import PtyPort
    except ImportError:
        raise NoTerminalsError(_NO_TERMINALS) from None
    return PtyPort(link, baud)


def open_any_port(baud: int) -> HostPort:
    """Open a pseudo-terminal; on a system without them, a TCP port that only this machine can reach."""
    try:
        return open_terminal(None, baud)
    except NoTerminalsError:
        return TcpPort("127.0.0.1", 0, rfc2217=False, baud=baud)
