"""`khep-twin serve`, and other commands that serve, in separate processes."""

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import pytest
import serial
from forked import Forked

import stand_ins.served

LISTS_PORTS = (
    *(sys.executable, "-c"),
    "from serial.tools import list_ports; list_ports.comports = lambda: []\n"
    "from khep_twin.cli.app import main; main()",
    "ports",
)
"""`khep-twin ports` on a machine without serial ports, whatever is plugged into this one."""


@dataclass(frozen=True)
class Dialect:
    """Requests that tell a robot's replies to one host from those to another.

    Attributes:
        playpen: Playpen of the robot.
        mode: Running mode of a relay to it.
        version: Reply to B.
        exchanges: Function from a number to requests and their replies, which differ for neighbours.
    """

    playpen: str
    mode: str
    version: bytes
    exchanges: Callable[[int], list[tuple[bytes, bytes]]]


KHEPERA = Dialect(
    "default",
    "1",
    b"b,5.02,5.01\r\n",
    lambda number: [(b"G,%d,7\n" % number, b"g\r\n"), (b"H\n", b"h,%d,7\r\n" % number)],
)
_LETTERS = b"DHIJLPU"
"""Commands of a Khepera IV whose reply is their letter; it drops commands that come with another one."""

KHEPERA4 = Dialect(
    "arena4",
    "9",
    b"b,B,0\r\n",
    lambda number: [(b"%c\n" % _LETTERS[number % 7], b"%c\r\n" % _LETTERS.lower()[number % 7])],
)
DIALECTS = KHEPERA, KHEPERA4
"""Robots of the checks of served lines."""


def robots(variable: str, kinds: Sequence[object]) -> list[object]:
    """Return pairs of a kind and a robot for `parametrize`, each robot with each kind.

    The suite runs the first kind with a Khepera and the others with a Khepera IV; a night, which sets the
    variable, runs all.
    """
    is_night = variable in os.environ
    return [
        pytest.param(kind, robot, marks=() if is_night or is_suite else pytest.mark.long)
        for number, kind in enumerate(kinds)
        for robot in DIALECTS
        for is_suite in [(robot is KHEPERA) == (number == 0)]
    ]


def served(
    *arguments: str,
    command: str = "serve",
    program: Sequence[str] = ("-m", "khep_twin"),
    pass_fds: tuple[int, ...] = (),
) -> AbstractContextManager[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, or another one, and what a host opens, its first line."""
    return stand_ins.served.served(command, *arguments, program=program, start=Forked, pass_fds=pass_fds)


def stop(process: "subprocess.Popen[str]", how: signal.Signals = signal.SIGTERM) -> tuple[int, str]:
    """Ends it; returns its exit code and what it said."""
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors


def ask(port: serial.SerialBase, request: bytes) -> bytes:
    """Writes a request to a port of pyserial; returns the line that answers it."""
    port.write(request)
    return port.readline()


def answer(host: int, request: bytes, expected: bytes, timeout: float) -> bytes:
    """Return a host's reply at a descriptor: as many bytes as expected, or fewer after the time-out [s]."""
    os.write(host, request)
    reply, end = b"", time.monotonic() + timeout
    while len(reply) < len(expected) and select.select([host], [], [], max(end - time.monotonic(), 0))[0]:
        reply += os.read(host, 4096)
    return reply


def exchange(path: str, request: bytes, expected: bytes, timeout: float = 1.0) -> bytes:
    """Return the reply to a plain host, which opens a terminal, sends a request, and closes it."""
    host = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        return answer(host, request, expected, timeout)
    finally:
        os.close(host)


def connected(url: str, timeout: float = 20.0) -> socket.socket:
    """A connection to a port of the network, by its URL."""
    host, _, number = url.partition("://")[2].rpartition(":")
    return socket.create_connection((host, int(number)), timeout=timeout)


def all_of(host: socket.socket) -> bytes:
    """Return all bytes until the other end closes."""
    got = b""
    while chunk := host.recv(1000):
        got += chunk
    return got
