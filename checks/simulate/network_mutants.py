"""Broken builds of the host library, of network ports, and of the robot behind them."""

import socket
from contextlib import AbstractContextManager
from dataclasses import replace
from unittest.mock import PropertyMock, patch

from checks.simulate.mutants import Mutant
from khep_twin import firmware
from khep_twin.board.kernel import LEFT, set_speed
from khep_twin.board.protocol import reply
from khep_twin.errors import PortTimeout
from khep_twin.host import commands
from khep_twin.host.line import Line
from khep_twin.ports import network, network_host
from khep_twin.ports.network_host import NetworkHost


def _moves_repeated() -> AbstractContextManager[object]:
    sound = commands.set_position
    return patch.object(
        commands, "set_position", lambda left, right: replace(sound(left, right), repeatable=True)
    )


def _old_replies() -> AbstractContextManager[object]:
    """Ask again without waiting for what may still come."""

    def settle(line: Line) -> list[str]:
        line._unanswered.clear()
        return []

    return patch.object(Line, "_settle", settle)


def _swapped_values() -> AbstractContextManager[object]:
    sound = commands.position()
    swapped = replace(sound, read=lambda text: commands.Positions(*sound.read(text)[::-1]))
    return patch.object(commands, "position", lambda: swapped)


def _numbers(text: str) -> list[int]:
    return [int(each) for each in text.split(",")[1:]]


def _refused_bytes_taken() -> AbstractContextManager[object]:
    sound = network.TcpPort._accept

    def accept(port: network.TcpPort, notices: list[str]) -> tuple[socket.socket, str] | None:
        came = sound(port, notices)
        if came is not None and port._host is not None:
            came[0].settimeout(0.01)
            try:
                port._host._ahead += came[0].recv(100)
            except OSError:
                pass
        return came

    return patch.object(network.TcpPort, "_accept", accept)


def _connections_kept() -> AbstractContextManager[object]:
    kept: list[object] = []
    return patch.object(NetworkHost, "close", lambda host: kept.append(host._client))


def _bursts_cut() -> AbstractContextManager[object]:
    """Drop what is beyond the queue before the system was asked to take it."""

    def release(host: NetworkHost, count: int) -> None:
        host._waiting += host._line[: min(count, network_host.QUEUE_LIMIT - len(host._waiting))]
        del host._line[:count]
        host._flush()

    return patch.object(NetworkHost, "_release", release)


def _counters_ahead() -> AbstractContextManager[object]:
    sound = firmware._COMMANDS["H"]

    def read_position(robot: firmware.Firmware) -> bytes:
        left, right = _numbers(sound(robot).decode())
        return reply("H", left, right + 20)

    return patch.dict(firmware._COMMANDS, H=read_position)


def _one_wheel() -> AbstractContextManager[object]:
    def drive(robot: firmware.Firmware, left: int, right: int) -> bytes:
        set_speed(robot.register_view, LEFT, left)
        return reply("D")

    return patch.dict(firmware._COMMANDS, D=drive)


MUTANTS: dict[str, Mutant] = {
    "leaving does not stop the motors": Mutant(
        "tcp", "motors", lambda: patch.object(Line, "_stop", lambda line: None)
    ),
    "a host ended from outside does not stop the motors": Mutant(
        "tcp", "motors", lambda: patch.object(Line, "_end", lambda line: None)
    ),
    "a command that sets counters is repeated": Mutant("lockstep", "counters", _moves_repeated),
    "an old reply is taken for a new one": Mutant("lockstep", "replies", _old_replies),
    "left and right are swapped": Mutant("lockstep", "replies", _swapped_values),
    "an error does not name its port": Mutant(
        "tcp",
        "errors",
        lambda: patch.object(
            Line, "_silence", lambda line, request, data: PortTimeout(f"no reply to {request!r}")
        ),
    ),
    "a refused host's bytes are taken": Mutant("tcp", "replies", _refused_bytes_taken),
    "a host that has finished is never let go": Mutant(
        "tcp", "leftovers", lambda: patch.object(NetworkHost, "done", PropertyMock(return_value=False))
    ),
    "a browser is let in": Mutant(
        "tcp", "replies", lambda: patch.object(NetworkHost, "_refuse_browsers", lambda host: None)
    ),
    "connections are never closed": Mutant("tcp", "leftovers", _connections_kept),
    "a host that has vanished keeps the port": Mutant(
        "tcp", "answers", lambda: patch.multiple(network_host, _retransmissions=lambda client: 0), 600
    ),
    "answers to a burst are cut": Mutant("tcp", "answers", _bursts_cut),
    "negotiation is not answered": Mutant(
        "rfc2217",
        "answers",
        lambda: patch.object(network_host.Negotiator, "write", lambda negotiator, data: None),
    ),
    "counters are ahead of the wheels": Mutant("tcp", "counters", _counters_ahead),
    "a speed sets one wheel": Mutant("lockstep", "speeds", _one_wheel),
}
