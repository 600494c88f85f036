"""Opening of a robot's port, with a search for its speed."""

import errno
import os
import re
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from urllib.parse import quote

import serial

from khep_twin.errors import PORT_FAILURES, PortError, PortInUse, PortTimeout
from khep_twin.invocation import command
from khep_twin.ports.service_registry import served

SPEEDS = (9600, 19200, 38400, 57600, 115200)
"""Speeds of the line in the robots' running modes, in the order tried [baud] (appendix E; manual II)."""

PORT_IDS = (1, 2, 3, 4)
"""Numbers of ports in the Khepera Toolbox, on the command line and in programs."""

VARIABLE = "KHEP_PORT_"
"""Environment variable of a port, without the port's number at its end."""

_LISTEN = 0.3
"""Wait for an answer at each speed that is tried [s]: B is answered within 0.03 s at 9600 baud."""

_VERSIONS = re.compile(rb"b,([0-9][0-9.]*,[0-9][0-9.]*|[A-P],[0-9]+)\r?\n$")
"""Replies to B of a Khepera, and of a Khepera IV."""


def numbered(port: str) -> str:
    """Return the port that a number, "1" to "4", stands for in the environment; any other port as it is.

    Raises:
        PortError: The environment has no port for the number.
    """
    if port not in map(str, PORT_IDS):
        return port
    if not (meant := os.environ.get(f"{VARIABLE}{port}")):
        raise PortError(
            f"port {port}: no port is chosen for this number; expected {VARIABLE}{port}=/dev/ttyUSB0 in the "
            "environment, or a port such as /dev/ttyUSB0 in its place"
        )
    return meant


def open_port(url: str, baudrate: int, timeout: float | None, *, exclusive: bool = False) -> serial.Serial:
    """Open a port of pyserial as the robot's line has it: eight bits, two stop bits.

    Args:
        url: URL of the port.
        baudrate: Speed of the line [baud].
        timeout: Timeout of reads and writes [s].
        exclusive: Refuse a port that another program has locked.

    Raises:
        PortInUse: It is locked.
        PortError: It cannot be opened.
    """
    # Not every kind of port can bound its writes: pyserial's RFC 2217 leaves them to the network.
    bound = None if url.startswith("rfc2217:") else timeout or None
    try:
        return serial.serial_for_url(
            url,
            baudrate=baudrate,
            stopbits=serial.STOPBITS_TWO,
            timeout=timeout,
            exclusive=exclusive or None,
            write_timeout=bound,
        )
    # One error says all; its causes repeat it. An expression of hwgrep:// may be malformed.
    except (*PORT_FAILURES, re.error) as error:
        if isinstance(error, serial.SerialException) and error.errno in (errno.EBUSY, errno.EAGAIN):
            raise PortInUse(f"{url}: in use by a program that has locked it") from None
        raise PortError(*_why_not_opened(url, error)) from None


def find_speed(port: serial.Serial, name: str, now: Callable[[], float]) -> int:
    """Set a port to the speed at which its robot answers command B.

    Args:
        port: Open port of pyserial.
        name: Name of the port, for messages.
        now: Function that returns the port's own time [s].

    Returns:
        The speed [baud]. A network socket or a twin that is not strict accepts any, and keeps the first.

    Raises:
        PortTimeout: There is no answer at any of `SPEEDS`.
        PortError: The port failed.
    """
    before, first = port.timeout, port.baudrate
    refused: list[int] = []
    try:
        port.timeout = _LISTEN
        for speed in SPEEDS:
            try:
                port.baudrate = speed
            except ValueError:  # a converter on the network may have no such speed
                refused.append(speed)
                port.baudrate = first
                continue
            if _answers(port, now):
                port.timeout = before
                return speed
        port.timeout = before
    except PORT_FAILURES as error:
        raise PortError(f"{name}: the port failed at 'B': {error}") from error
    tried = _listed(speed for speed in SPEEDS if speed not in refused)
    raise PortTimeout(
        f"{name}: no answer to 'B' at {tried or 'any'} baud; is the robot on, in a serial mode?"
        + (f" The port refuses {_listed(refused)} baud" if refused else "")
    )


def _listed(speeds: Iterable[int]) -> str:
    return ", ".join(map(str, speeds))


def _answers(port: serial.Serial, now: Callable[[], float]) -> bool:
    # A twin in this process warns of a wrong speed and understands all the same.
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        port.reset_input_buffer()
        # The line feed before it ends what an attempt at another speed has begun.
        port.write(b"\nB\n")
        end = now() + _LISTEN
        answered = False
        while not answered and now() <= end and (line := port.read_until(b"\n", None)):
            answered = _VERSIONS.search(line) is not None
    return answered and not noticed


def _link_of(name: str) -> str:
    """Find the path of a served twin whose link in the private directory has this name; empty without one."""
    if os.path.dirname(name):
        return ""
    with suppress(PortError):
        return next((path for path, _ in served() if os.path.basename(path) == name), "")
    return ""


def _why_not_opened(url: str, error: Exception) -> tuple[str, str]:
    """Return the reason, and what to add to it on the command line."""
    from khep_twin.files.toml_files import names
    from khep_twin.ports.network import address_fault

    text = str(error)
    if fault := address_fault(url):
        return fault, ""
    if "://" not in url and isinstance(error, serial.SerialException):
        if path := _link_of(url):
            return f"{url}: no such port here; the twin served under this name is at {path}", ""
        if url in names("playpens") or url.endswith((".toml", ".mcap")):
            return f"{url}: no port; expected khep://{quote(url)} for a twin in it", ""
        hint = (
            f"; `{command('ports')}` lists those that are here, `{command('serve')}` makes one, "
            "khep://default needs none"
        )
        return f"{url}: cannot open this port: {_reason(error)}", hint
    return (text if text.startswith(url) else f"{url}: {text}"), ""


def _reason(error: serial.SerialException) -> str:
    """Return the system's reason alone; pyserial's own text has it twice, with the name of the port."""
    return os.strerror(error.errno) if error.errno else str(error)
