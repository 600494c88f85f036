"""`khep-twin serve`, and other commands that serve, in separate processes."""

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager

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
