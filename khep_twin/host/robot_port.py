"""Port of a robot: its bytes, its clock, its waits and its errors."""

import math
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal, cast

import serial

from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, PortError, PortTimeout
from khep_twin.files.atomic import resolve
from khep_twin.files.paths import StrPath
from khep_twin.host.opening import BAUD_RATES, find_baud_rate, open_port, resolve_port
from khep_twin.ports.service_registry import served_speed
from khep_twin.robots.framing import Framing

_REPLY_WAIT_S, _SILENCE_S = 0.5, 5.0
"""Default wait for a reply, and for the first reply of a silent robot [s]."""


class RobotPort:
    """Port of one robot, open from its creation.

    Args:
        url, timeout, baudrate, retries: See `Line`; "auto" opens the port at the first of `BAUD_RATES`.
        framing: Ends of the messages.

    Attributes:
        serial_port: Port of pyserial.
        framing: Ends of the messages.
        identity: Reply to the identification that was sent to find the baud rate; empty without one.
        name: Name of the port, for messages.
        clock_speed: Simulated seconds per second of wall time, as in `ServedPort`.
        silence_limit: Longest wait for a silent robot [s], in the port's time.

    Raises:
        PortError: The port cannot be opened.
    """

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float | None,
        baudrate: int | Literal["auto"],
        retries: int,
        framing: Framing,
    ) -> None:
        self.framing, self.identity = framing, ""
        if isinstance(url, str | os.PathLike):
            url = resolve_port(os.fspath(url))
        self._url = url if isinstance(url, str) else None
        self.name: str = url if isinstance(url, str) else str(url.name)
        is_simulated = hasattr(url, "time_ns") or self.name.startswith("khep://")
        self.clock_speed = 1.0 if is_simulated else served_speed(self.name)
        if timeout is None:
            slowness = 1 / self.clock_speed if 0 < self.clock_speed < 1 else 1.0
            reply_wait, self.silence_limit = _REPLY_WAIT_S * slowness, _SILENCE_S * slowness
        else:
            reply_wait = timeout / 2
            self.silence_limit = reply_wait * (1 + max(retries, 1))
        first_baudrate = BAUD_RATES[0] if baudrate == "auto" else baudrate
        # The stubs of pyserial declare the members of all ports only for `Serial`.
        self.serial_port = (
            open_port(url, first_baudrate, reply_wait) if isinstance(url, str) else cast(serial.Serial, url)
        )

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, otherwise of the wall clock, times a server's speed."""
        return self.timeout_time * (self.clock_speed if self.has_clock else 1.0)

    @property
    def has_clock(self) -> bool:
        """True if the robot's time passes while the host waits, at a known speed."""
        return 0 < self.clock_speed < math.inf

    @property
    def timeout_time(self) -> float:
        """Time of the port's timeouts [s]."""
        time_ns = getattr(self.serial_port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S

    @property
    def model(self) -> str | None:
        """Model of a twin in this process; None for a robot at any other port."""
        return getattr(self.serial_port, "robot_model", None)

    def check_clock(self, subject: str) -> None:
        """Raise a PortError about a subject that needs the port's time, if the server has no clock."""
        if not self.has_clock:
            option = "--speed max" if self.clock_speed else "--clock wire"
            raise PortError(
                f"{self.name}: {subject} at a server with {option}, where waits have no simulated time; "
                "expected khep://, or a server with --clock real and a --speed"
            )

    def find_baud_rate(self) -> None:
        """Set the baud rate at which the robot replies; close the port without one."""
        try:
            _, self.identity = find_baud_rate(self.serial_port, self.name, lambda: self.timeout_time)
        except BaseException:
            self.serial_port.close()
            raise

    def send(self, requests: Sequence[str], *, resync: bool = False) -> None:
        """Send requests, after the end of an unfinished one if `resync`; errors name the first request."""
        data, request = b"".join(map(self.framing.encode, requests)), requests[0]
        try:
            self.serial_port.write(self.framing.resync * resync + data)
        except serial.SerialTimeoutException as error:
            raise PortTimeout(
                f"{self.name}: {request!r} could not be sent within {self.serial_port.write_timeout} s: no "
                "program reads at the other end"
            ) from error
        except PORT_FAILURES as error:
            raise self._port_error(request, error) from error

    def read_reply(self, request: str) -> tuple[str | None, bytes]:
        """Read a reply up to its end, or to the timeout; errors name the request.

        Returns:
            Its text, None if it is incomplete; and its bytes.
        """
        try:
            data = self.framing.read(self.serial_port, lambda: self.timeout_time)
            return self.framing.decode(data) if self.framing.is_message(data) else None, data
        except PORT_FAILURES as error:
            raise self._port_error(request, error) from error

    def set_timeout(self, timeout: float | None, request: str) -> None:
        """Set the timeout of reads [s]; errors name the request."""
        # pyserial renegotiates the settings of a network port for it.
        try:
            self.serial_port.timeout = timeout
        except PORT_FAILURES as error:
            raise self._port_error(request, error) from error

    def close(self) -> None:
        """Close the port, even one that has failed."""
        with suppress(*PORT_FAILURES):
            self.serial_port.close()

    def reopen(self, timeout: float) -> None:
        """Open the port again, with a timeout of reads and writes [s]."""
        self.serial_port = open_port(str(self._url), self.serial_port.baudrate, timeout)

    def reopening_refusal(self) -> str:
        """Return the reason not to reopen the port; empty if it may be reopened."""
        if self._url is None or hasattr(self.serial_port, "time_ns"):
            return "this port is not opened again"
        path = Path(self._url)
        if "://" in self._url or not resolve(path).is_relative_to("/dev/pts"):
            return ""
        if sys.platform == "win32":
            return ""
        from khep_twin.ports.link import is_live_link

        if not is_live_link(path):
            return "a terminal that has gone is not opened again, as its number may be reused by now"
        return ""

    def timeout_error(self, request: str, line: bytes, start: float) -> PortTimeout:
        """Return the error for a missing reply, or a part of it, that was awaited since `start`."""
        duration = max(self.timeout_time - start, self.serial_port.timeout or 0.0)
        return PortTimeout(
            f"{self.name}: no reply to {request!r} within {duration:.2g} s"
            + (f", only {self.framing.decode(line)!r}" if line else "")
            + f"; is the robot on, in a serial mode of {self.serial_port.baudrate} baud?"
        )

    def _port_error(self, request: str, error: Exception) -> PortError:
        return PortError(f"{self.name}: the port failed at {request!r}: {error}")
