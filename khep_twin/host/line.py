"""The serial line to a robot: requests, replies and the recovery of an exchange that went wrong.

The robot replies to each line with one line, in order. After a missing or malformed reply a probe is sent:
the first of the reads `B`, `H`, `E`, `K` (Khepera IV: `B`, `E`, `R`, `G`) without a pending reply. All lines
before its reply are late, and the last of them is the expected reply. Only then is a command repeated, if it
is repeatable. If replies to all four are pending, the line must also be silent after the reply.
"""

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar, cast

import serial

from khep_twin.board.protocol import MOTION_COMMANDS
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, PortError, PortTimeout, ProtocolError, StoppedError
from khep_twin.files.atomic import resolve
from khep_twin.files.paths import StrPath
from khep_twin.host.commands import HostCommand
from khep_twin.host.opening import BAUD_RATES, find_baud_rate, open_port, resolve_port
from khep_twin.signals import register_cleanup

Value = TypeVar("Value")

STOP_WAIT = 0.5
"""Longest wait for the reply to the final command, which stops the motors [s]."""

_REPLY_TIMEOUT_S = 1.0
"""Wait for a reply on a port without a timeout [s]; the robot replies within 10 ms."""

LONGEST_OUTPUT = 10.0
"""Longest wait for the end of a tool's output [s]; `list` takes 2 s at 9600 baud."""


class Dialect(NamedTuple):
    """Protocol of a kind of robot, as the line needs it.

    Attributes:
        robot_name: Kind of robot, for messages.
        host_class: Name of the host class for it.
        versions_reply: Pattern of the reply to B.
        probe_letters: Reads that resynchronize the line.
        stop_requests: Requests that stop the motors, one after the other.
        moving: Prefixes of requests that move the robot.
    """

    robot_name: str
    host_class: str
    versions_reply: re.Pattern[str]
    probe_letters: str
    stop_requests: tuple[str, ...]
    moving: tuple[str, ...]


KHEPERA = Dialect(
    "a Khepera", "Khepera", re.compile(r"b,\d.*"), "BHEK", ("D,0,0",), (*MOTION_COMMANDS, "run", "restart")
)
KHEPERA4 = Dialect(
    "a Khepera IV", "Khepera4", re.compile(r"b,[A-P],\d+"), "BERG", ("A,2", "D,0,0"), ("A", "D", "F", "L")
)
"""Dialects. On the Khepera IV D does not stop the Braitenberg vehicle, and H and K are not reads."""

DIALECTS = {"khepera1": KHEPERA, "khepera2": KHEPERA, "khepera4": KHEPERA4}
"""Dialects by model of the robot."""


class Line:
    """The line to one robot.

    Args:
        url: URL of the port, or an open port of pyserial.
        timeout: Longest wait for one try of a reply, and for a write [s], in the port's time.
        baudrate: Baud rate; "auto" tries `BAUD_RATES`.
        retries: Number of repetitions of a repeatable command.
        dialect: Protocol of the robot.

    Attributes:
        port: Port of pyserial.
        name: Name of the port, for messages.
        listener: Callback for each request and its reply, without line endings, or None.

    Raises:
        PortError: The port cannot be opened, its twin is of another kind, or there is no reply at any baud
        rate. ValueError: The number of retries is negative or not an integer.
    """

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float | None,
        baudrate: int | Literal["auto"],
        retries: int,
        dialect: Dialect = KHEPERA,
    ) -> None:
        if not (retries >= 0 and float(retries).is_integer()):
            raise ValueError(f"retries={retries!r}; expected an integer from 0")
        if isinstance(url, str | os.PathLike):
            url = resolve_port(os.fspath(url))
        self._url = url if isinstance(url, str) else None
        self._retries = retries
        self._dialect = dialect
        self._versions_reply = ""
        self._unanswered_letters: set[str] = set()
        self.listener: Callable[[str, str], None] | None = None
        self._lock = threading.RLock()
        self._refuses_motion = False
        self._stop_done = threading.Event()
        self.name: str = url if isinstance(url, str) else str(url.name)
        first_baudrate = BAUD_RATES[0] if baudrate == "auto" else baudrate
        # The stubs of pyserial declare the members of all ports only for `Serial`.
        port = open_port(url, first_baudrate, timeout) if isinstance(url, str) else cast(serial.Serial, url)
        self.port = port
        # The model of a twin in this process is known before the first exchange.
        model = getattr(port, "robot_model", None)
        if model is not None and (other := DIALECTS[model]) is not dialect:
            port.close()
            raise PortError(f"{self.name}: the robot is {other.robot_name}{self._expected_host(other)}")
        if baudrate == "auto":
            try:
                find_baud_rate(self.port, self.name, lambda: self.time)
            except BaseException:
                self.port.close()
                raise
        self._unregister = register_cleanup(self._stop_at_exit)

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, otherwise of the wall clock."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S

    def sleep(self, duration: float) -> None:
        """Wait for a duration [s] in the port's time."""
        if (sleep := getattr(self.port, "sleep", None)) is not None:
            self._yield_to_stop()
            with self._lock:
                sleep(duration)
        else:
            time.sleep(duration)

    def execute(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        """Send commands in one burst and return the values of their replies.

        Raises:
            PortTimeout: A reply is missing.
            PortError: The port failed or disappeared.
            ProtocolError: A reply does not match its command.
            StoppedError: A command would move the robot after `hold`.
        """
        self._yield_to_stop()
        with self._lock:
            return self._execute(commands)

    def ask(self, request: str) -> str:
        """Send any line, once, and return the reply, or a tool's first line: `HostRobot.ask`."""
        if not request.isascii() or "\n" in request or "\r" in request:
            raise ValueError(f"request {request!r}; expected one line of ASCII, without its ending")
        replies: list[str] = []
        self._yield_to_stop()
        with self._lock:
            self._exchange([request], replies)
            end = self.time + LONGEST_OUTPUT
            # `serial` replies with one line, and then changes the baud rate.
            has_output = request.lstrip()[:1].islower() and request.split()[0] != "serial"
            while has_output and self.time < end and self._read_line(request).endswith(b"\n"):
                pass
        return replies[0]

    def _execute(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        requests = [command.request for command in commands]
        tries = 1 + (self._retries if all([command.repeatable for command in commands]) else 0)
        first_error: PortTimeout | ProtocolError | None = None
        while True:
            replies: list[str] = []
            try:
                self._exchange(requests, replies)
                return self._parse_replies(commands, replies)
            except (PortTimeout, ProtocolError) as error:
                first_error = first_error or error
                tries -= 1
                late_replies = self._resynchronize()
                if late_replies is None:
                    # There is no robot, or the probe was lost.
                    tries -= 1
                    if tries <= 0:
                        raise first_error from None
                    continue
                for other in {KHEPERA, KHEPERA4} - {self._dialect}:
                    if other.versions_reply.fullmatch(self._versions_reply):
                        raise ProtocolError(
                            f"{first_error}; {other.robot_name} answers so{self._expected_host(other)}"
                        ) from None
            # Late replies are valid if they are complete.
            with suppress(ProtocolError):
                return self._parse_replies(commands, (replies + late_replies)[-len(commands) :])
            if tries <= 0:
                raise first_error from None

    def _expected_host(self, other: Dialect) -> str:
        return f"; expected {self._dialect.robot_name}, or khep_twin.host.{other.host_class} for this one"

    def _yield_to_stop(self) -> None:
        """Wait for a pending stop, as a lock alone could be taken by the same thread for ever."""
        if self._refuses_motion:
            self._stop_done.wait(STOP_WAIT)

    def _exchange(self, requests: Sequence[str], replies: list[str]) -> None:
        """Send lines and append each reply when it arrives."""
        moving_requests = [request for request in requests if self._may_move(request)]
        if self._refuses_motion and moving_requests:
            raise StoppedError(f"{self.name}: {moving_requests[0]!r} is not sent, as the run is to end")
        if self._unanswered_letters and self._resynchronize() is None:
            raise self._timeout_error(requests[0], b"")
        self._unanswered_letters.update([request[:1] for request in requests])
        self._write("\n".join([*requests, ""]).encode("ascii"), requests[0])
        for request in requests:
            line = self._read_line(request)
            if not line.endswith(b"\n"):
                raise self._timeout_error(request, line)
            replies.append(_decode_line(line))
            if self.listener is not None:
                self.listener(request, replies[-1])
        self._unanswered_letters.clear()

    def _parse_replies(self, commands: Sequence[HostCommand[Value]], replies: Sequence[str]) -> list[Value]:
        """Return the values of replies, one for each command."""
        if len(replies) != len(commands):
            raise ProtocolError(f"{self.name}: {len(commands)} commands got {len(replies)} replies")
        values: list[Value] = []
        for command, reply in zip(commands, replies, strict=True):
            try:
                values.append(command.read(reply))
            except ValueError as error:
                raise ProtocolError(
                    f"{self.name}: {command.request!r} was answered {reply!r}; {error}"
                ) from None
        return values

    def _resynchronize(self) -> list[str] | None:
        """Send a probe to resynchronize the line; return the lines before its reply, None without a reply."""
        probes = self._dialect.probe_letters
        probe = next((letter for letter in probes if letter not in self._unanswered_letters), probes[0])
        # If replies to several probes are pending, the line is synchronized only when it is silent.
        is_ambiguous = probe in self._unanswered_letters and self.port.timeout is not None
        self._unanswered_letters.add(probe)
        # The leading line feed ends an interrupted command.
        self._write(f"\n{probe}\n".encode("ascii"), probe)
        lines: list[str] = []
        late_replies: list[str] | None = None
        end = self.time + (self.port.timeout or _REPLY_TIMEOUT_S)
        while self.time <= end:
            line = self._read_line(probe)
            if not line.endswith(b"\n"):
                break
            text = _decode_line(line)
            if text.startswith(f"{probe.lower()},"):
                late_replies = lines.copy()
                self._versions_reply = text if probe == "B" else self._versions_reply
                if not is_ambiguous:
                    break
            lines.append(text)
        else:
            late_replies = None
        if late_replies is not None:
            self._unanswered_letters.clear()
        return late_replies

    def _write(self, data: bytes, request: str) -> None:
        try:
            self.port.write(data)
        except serial.SerialTimeoutException as error:
            raise PortTimeout(
                f"{self.name}: {request!r} could not be sent within {self.port.write_timeout} s: no program "
                "reads at the other end"
            ) from error
        except PORT_FAILURES as error:
            raise self._port_error(request, error) from error

    def _read_line(self, request: str) -> bytes:
        try:
            return self.port.read_until(b"\n", None)
        except PORT_FAILURES as error:
            raise self._port_error(request, error) from error

    def _timeout_error(self, request: str, line: bytes) -> PortTimeout:
        return PortTimeout(
            f"{self.name}: no reply to {request!r} within {self.port.timeout} s"
            + (f", only {line!r}" if line else "")
            + f"; is the robot on, in a serial mode of {self.port.baudrate} baud?"
        )

    def _port_error(self, request: str, error: Exception) -> PortError:
        return PortError(f"{self.name}: the port failed at {request!r}: {error}")

    def hold(self) -> None:
        """Stop the motors after another thread's exchange, and refuse later commands that move.

        Raises:
            PortError: The motors could not be stopped.
        """
        self._refuses_motion = True
        try:
            with self._lock:
                timeout = self.port.timeout
                self._stop()
                self._set_timeout(timeout)
        finally:
            self._stop_done.set()

    def halt(self) -> tuple[bool, str]:
        """Try to stop the motors, and close the port.

        A reply may take `STOP_WAIT`. After a failure it reopens the port once, if possible, and tries again.

        Returns:
            Whether the robot has confirmed the stop, and a description of the outcome.
        """
        with self._lock:
            return self._halt()

    def _halt(self) -> tuple[bool, str]:
        try:
            try:
                self._stop()
                return True, "the motors were stopped"
            except PortError as error:
                reason = str(error).removeprefix(f"{self.name}: ")
            finally:
                self._close()
            if refusal := self._reopening_refusal():
                return False, f"the motors may still run: {reason}; {refusal}"
            try:
                self.port = open_port(str(self._url), self.port.baudrate, STOP_WAIT)
                self._stop()
            except PortError as error:
                reason = str(error).removeprefix(f"{self.name}: ")
                return False, f"the motors may still run: opening the port again failed: {reason}"
            return True, "the port was opened again and the motors were stopped"
        finally:
            self._close()

    def _stop(self) -> None:
        """Send the requests that stop the motors, each up to twice, until they are confirmed."""
        wait = STOP_WAIT / 2
        if self.port.timeout is None or not 0 < self.port.timeout <= wait:
            self._set_timeout(wait)
        for request in self._dialect.stop_requests:
            if not (self._confirms_stop(request, wait) or self._confirms_stop(request, wait)):
                raise PortTimeout(f"{self.name}: no reply to {request!r} within {STOP_WAIT} s")

    def _confirms_stop(self, request: str, wait: float) -> bool:
        """Send a request that stops the motors; return whether the robot confirms it."""
        reply = request[0].lower()
        self._write(f"\n{request}\n".encode("ascii"), request)
        if request[0] in self._unanswered_letters:  # a pending reply to a speed command looks the same
            return bool(late_replies := self._resynchronize()) and late_replies[-1] == reply
        end = self.time + wait
        line = b"\n"
        while line.endswith(b"\n") and self.time <= end:
            line = self._read_line(request)
            if _decode_line(line) == reply:
                return True
        return False

    def _may_move(self, request: str) -> bool:
        """Return whether a request may move the robot."""
        is_stop = request in self._dialect.stop_requests
        return not is_stop and request.lstrip().startswith(self._dialect.moving)

    def _set_timeout(self, timeout: float | None) -> None:
        # pyserial renegotiates the settings of a network port for it.
        try:
            self.port.timeout = timeout
        except PORT_FAILURES as error:
            raise self._port_error(self._dialect.stop_requests[-1], error) from error

    def _close(self) -> None:
        self._unregister()
        with suppress(*PORT_FAILURES):
            self.port.close()

    def _stop_at_exit(self) -> None:
        """Stop the motors of a robot when a signal ends the process, even during an exchange."""
        if not hasattr(self.port, "time_ns"):
            with suppress(PortError):
                self._stop()

    def _reopening_refusal(self) -> str:
        """Return the reason not to reopen the port; empty if it may be reopened."""
        if self._url is None or hasattr(self.port, "time_ns"):
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


def _decode_line(line: bytes) -> str:
    return line.decode("latin-1").rstrip("\r\n")
