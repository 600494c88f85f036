"""Broken builds of the host library, of network ports, and of the robot behind them."""

import socket
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from unittest.mock import PropertyMock, patch

from checks.simulate.mutants import Mutant, nothing, replaced
from khep_twin import firmware
from khep_twin.board.kernel import LEFT, set_speed
from khep_twin.board.protocol import reply
from khep_twin.errors import PortTimeout
from khep_twin.host import commands
from khep_twin.host.commands import HostCommand
from khep_twin.host.final_stop import FinalStop
from khep_twin.host.resynchronization import Resynchronization
from khep_twin.host.robot_port import RobotPort
from khep_twin.ports import network, network_host
from khep_twin.ports.network_host import NetworkHost

_set_position, _position, _accept = commands.set_position, commands.position(), network.TcpPort._accept


def _set_position_again(left: int, right: int) -> HostCommand[None]:
    return replace(_set_position(left, right), repeatable=True)


def _resynchronize_early(resynchronization: Resynchronization, end: float = 0.0) -> list[str]:
    """Ask again without waiting for replies that may still come."""
    resynchronization.unanswered.clear()
    return []


def _swapped_position() -> HostCommand[commands.Positions]:
    return replace(_position, read=lambda text: commands.Positions(*_position.read(text)[::-1]))


def _accept_refused_bytes(port: network.TcpPort, notices: list[str]) -> tuple[socket.socket, str] | None:
    accepted = _accept(port, notices)
    if accepted is not None and port._host is not None:
        accepted[0].settimeout(0.01)
        with suppress(OSError):
            port._host._input += accepted[0].recv(100)
    return accepted


def _connections_kept() -> AbstractContextManager[object]:
    clients: list[object] = []
    return patch.object(NetworkHost, "close", lambda host: clients.append(host._client))


def _send_held_in_part(host: NetworkHost, count: int) -> None:
    """Drop the bytes beyond the queue before the system was asked to take them."""
    host._output += host._held_reply[: min(count, network_host.QUEUE_LIMIT - len(host._output))]
    del host._held_reply[:count]
    host._flush()


_read_position = firmware._COMMANDS["H"]


def _position_ahead(robot: firmware.Firmware) -> bytes:
    left, right = map(int, _read_position(robot).decode().split(",")[1:])
    return reply("H", left, right + 20)


def _drive_one_wheel(robot: firmware.Firmware, left: int, _: int) -> bytes:
    set_speed(robot.register_view, LEFT, left)
    return reply("D")


MUTANTS: dict[str, Mutant] = {
    "leaving does not stop the motors": Mutant("tcp", "motors", replaced(FinalStop, stop=nothing)),
    "a host ended from outside does not stop the motors": Mutant(
        "tcp", "motors", replaced(FinalStop, stop_at_exit=nothing)
    ),
    "a command that sets counters is repeated": Mutant(
        "lockstep", "counters", replaced(commands, set_position=_set_position_again)
    ),
    "an old reply is taken for a new one": Mutant(
        "lockstep", "replies", replaced(Resynchronization, resynchronize=_resynchronize_early)
    ),
    "left and right are swapped": Mutant(
        "lockstep", "replies", replaced(commands, position=_swapped_position)
    ),
    "an error does not name its port": Mutant(
        "tcp",
        "errors",
        replaced(
            RobotPort,
            timeout_error=lambda port, request, line, start: PortTimeout(f"no reply to {request!r}"),
        ),
    ),
    "a refused host's bytes are taken": Mutant(
        "tcp", "replies", replaced(network.TcpPort, _accept=_accept_refused_bytes)
    ),
    "a host that has finished is never let go": Mutant(
        "tcp", "leftovers", replaced(NetworkHost, is_done=PropertyMock(return_value=False))
    ),
    "a browser is let in": Mutant(
        "tcp", "replies", replaced(network_host, _BROWSER_PREFIXES=(b"no request",))
    ),
    "connections are never closed": Mutant("tcp", "leftovers", _connections_kept),
    "a host that has vanished keeps the port": Mutant(
        "tcp", "answers", replaced(network_host, _retransmissions=lambda client: 0), 600
    ),
    "answers to a burst are cut": Mutant(
        "tcp", "answers", replaced(NetworkHost, _send_held=_send_held_in_part)
    ),
    "negotiation is not answered": Mutant(
        "rfc2217", "answers", replaced(network_host.Negotiator, write=nothing)
    ),
    "counters are ahead of the wheels": Mutant(
        "tcp", "counters", lambda: patch.dict(firmware._COMMANDS, H=_position_ahead)
    ),
    "a speed sets one wheel": Mutant(
        "lockstep", "speeds", lambda: patch.dict(firmware._COMMANDS, D=_drive_one_wheel)
    ),
}
