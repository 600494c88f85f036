"""Opening of a robot's port, with a search for its baud rate."""

import errno
import os
import re
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from urllib.parse import quote

import serial

from khep_twin.errors import PORT_FAILURES, PortError, PortInUse, PortTimeout
from khep_twin.ports.service_registry import served_ports
from khep_twin.process.invocation import command
from khep_twin.robots.registry import installed_families

BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
"""Baud rates of the robots' running modes, in the order of the search (appendix E; manual II)."""

PORT_IDS = (1, 2, 3, 4)
"""Numbers of ports in the Khepera Toolbox, on the command line and in programs."""

VARIABLE = "KHEP_PORT_"
"""Prefix of the environment variable of a port, before the port's number."""

_REPLY_TIMEOUT_S = 0.3
"""Wait for a reply at each baud rate [s]; the reply to B takes 0.03 s at 9600 baud."""


def resolve_port(port: str) -> str:
    """Return the port that the environment assigns to a number, "1" to "4"; any other port unchanged.

    Raises:
        PortError: The environment has no port for the number.
    """
    if port not in map(str, PORT_IDS):
        return port
    if not (assigned_port := os.environ.get(f"{VARIABLE}{port}")):
        raise PortError(
            f"port {port}: no port is chosen for this number; expected {VARIABLE}{port}=/dev/ttyUSB0 in the "
            "environment, or a port such as /dev/ttyUSB0 in its place"
        )
    return assigned_port


def open_port(url: str, baudrate: int, timeout: float | None, *, exclusive: bool = False) -> serial.Serial:
    """Open a port of pyserial with the robot's line settings: eight bits, two stop bits.

    Args:
        url: URL of the port.
        baudrate: Baud rate.
        timeout: Timeout of reads and writes [s].
        exclusive: Refuse a port that another program has locked.

    Raises:
        PortInUse: The port is locked.
        PortError: The port cannot be opened.
    """
    # pyserial's RFC 2217 ports have no timeout of writes.
    write_timeout = None if url.startswith("rfc2217:") else timeout or None
    try:
        return serial.serial_for_url(
            url,
            baudrate=baudrate,
            stopbits=serial.STOPBITS_TWO,
            timeout=timeout,
            exclusive=exclusive or None,
            write_timeout=write_timeout,
        )
    # Without the causes, which repeat the message; re.error is a malformed expression of hwgrep://.
    except (*PORT_FAILURES, re.error) as error:
        if isinstance(error, serial.SerialException) and error.errno in (errno.EBUSY, errno.EAGAIN):
            raise PortInUse(f"{url}: in use by a program that has locked it") from None
        raise PortError(*_explain_failure(url, error)) from None


def find_baud_rate(
    port: serial.Serial, name: str, clock: Callable[[], float], rates: Sequence[int] = ()
) -> tuple[int, str]:
    """Set a port to the baud rate at which its robot identifies itself, e.g. by its reply to command B.

    Args:
        port: Open port of pyserial.
        name: Name of the port, for messages.
        clock: Function that returns the port's time [s].
        rates: Baud rates to try, by default `BAUD_RATES`.

    Returns:
        The baud rate, and the text of the reply. A network socket or a twin that is not strict accepts any
        rate, so it is the first.

    Raises:
        PortTimeout: There is no reply at any of the rates.
        PortError: The port failed.
    """
    rates, timeout, first_baudrate = rates or BAUD_RATES, port.timeout, port.baudrate
    refused_rates: list[int] = []
    try:
        port.timeout = _REPLY_TIMEOUT_S
        for baud_rate in rates:
            try:
                port.baudrate = baud_rate
            except ValueError:  # a converter on the network may not support it
                refused_rates.append(baud_rate)
                port.baudrate = first_baudrate
                continue
            if reply := _identify(port, clock):
                port.timeout = timeout
                return baud_rate, reply
        port.timeout = timeout
    except PORT_FAILURES as error:
        raise PortError(f"{name}: the port failed at 'B': {error}") from error
    tried_rates = ", ".join(str(speed) for speed in rates if speed not in refused_rates)
    raise PortTimeout(
        f"{name}: no answer to 'B' at {tried_rates or 'any'} baud; is the robot on, in a serial mode?"
        + (f" The port refuses {', '.join(map(str, refused_rates))} baud" if refused_rates else "")
    )


def _identify(port: serial.Serial, clock: Callable[[], float]) -> str:
    """Return the reply of a robot of any kind to its identification; empty without one."""
    dialects = [model.dialect for model in installed_families().values()]
    # The same bytes identify all models whose messages are lines.
    requests = {dialect.identification: dialect.framing for dialect in dialects}
    for request, framing in requests.items():
        patterns = [dialect.versions_reply for dialect in dialects if dialect.identification == request]
        # A twin in this process warns of a wrong baud rate, but replies.
        with warnings.catch_warnings(record=True) as caught_warnings:
            warnings.simplefilter("always")
            port.reset_input_buffer()
            port.write(request)
            end = clock() + _REPLY_TIMEOUT_S
            while clock() <= end and (data := framing.read(port, clock)):
                text = framing.decode(data)
                # A line may start with noise.
                replies = (text[start:] for start in range(len(text) if framing.is_message(data) else 0))
                for reply in replies:
                    if any(pattern.fullmatch(reply) for pattern in patterns):
                        return "" if caught_warnings else reply
    return ""


def _find_link(name: str) -> str:
    """Find the path of a served twin by the name of its link in the private directory; empty without one."""
    if os.path.dirname(name):
        return ""
    with suppress(PortError):
        return next((port.path for port in served_ports() if os.path.basename(port.path) == name), "")
    return ""


def _explain_failure(url: str, error: Exception) -> tuple[str, str]:
    """Return the reason, and a hint that the command line appends."""
    from khep_twin.files.toml_files import names
    from khep_twin.ports.network import address_fault

    message = str(error)
    if fault := address_fault(url):
        return fault, ""
    if "://" not in url and isinstance(error, serial.SerialException):
        if path := _find_link(url):
            return f"{url}: no such port here; the twin served under this name is at {path}", ""
        if url in names("playpens") or url.endswith((".toml", ".mcap")):
            return f"{url}: no port; expected khep://{quote(url)} for a twin in it", ""
        hint = (
            f"; `{command('ports')}` lists those that are here, `{command('serve')}` makes one, "
            "khep://default needs none"
        )
        # Only the system's reason: pyserial's text repeats it, with the name of the port.
        reason = os.strerror(error.errno) if error.errno else message
        return f"{url}: cannot open this port: {reason}", hint
    return (message if message.startswith(url) else f"{url}: {message}"), ""
