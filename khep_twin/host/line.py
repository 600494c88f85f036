"""The serial line to a robot: requests, replies and the recovery of an exchange that went wrong.

The robot replies to each line with one line, in order. After a missing or malformed reply a probe is sent:
the first of the reads `B`, `H`, `E`, `K` (Khepera IV: `B`, `E`, `R`, `G`) without a pending reply. All lines
before its reply are late, and the last of them is the expected reply. Only then is a command repeated, if it
is repeatable. If replies to all four are pending, the line must also be silent after the reply.

A machine that is busy replies late. Without a reply to the probe, the next one is sent until the line has
been silent for long enough, and a late reply is reported once.
"""

import math
import os
import re
import sys
import threading
import time
import warnings
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
from khep_twin.ports.service_registry import served_speed
from khep_twin.signals import register_cleanup
from khep_twin.units import BITS_PER_BYTE

Value = TypeVar("Value")
E = TypeVar("E", PortError, ProtocolError)

STOP_WAIT = 0.5
"""Longest wait for the reply to the final command, which stops the motors [s]."""

_REPLY_TIMEOUT_S = 1.0
"""Wait for a reply on a port without a timeout [s]; the robot replies within 10 ms."""

_REPLY_WAIT_S, _SILENCE_S = 0.5, 5.0
"""Default wait for a reply, and for the first reply of a silent robot [s]."""

_PROBE_READS = 1, 2, 4, 8
"""Number of the port's timeouts for which each of consecutive probes waits."""

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


class LineTimes(NamedTuple):
    """Times of all exchanges so far.

    Attributes:
        exchanges: Duration from the commands to their replies, in the port's time [s].
        bytes: Time of their bytes at the line's baud rate [s].
    """

    exchanges: float
    bytes: float


class Line:
    """The line to one robot.

    Args:
        url: URL of the port, or an open port of pyserial.
        timeout: Longest wait for a silent robot [s], in the port's time: half of it for a reply, half for a
            probe; None for 0.5 s for a reply and 5 s in all, divided by a server's `--speed` below 1.
        baudrate: Baud rate; "auto" tries `BAUD_RATES`.
        retries: Number of repetitions of a repeatable command.
        dialect: Protocol of the robot.

    Attributes:
        port: Port of pyserial.
        name: Name of the port, for messages.
        clock_speed: Simulated seconds per second of wall time, as in `ServedPort`.
        times: Times of all exchanges so far.
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
        self._missing_reply = "", b""
        self.listener: Callable[[str, str], None] | None = None
        self._lock = threading.RLock()
        self._refuses_motion = False
        self._stop_done = threading.Event()
        self.name: str = url if isinstance(url, str) else str(url.name)
        is_simulated = hasattr(url, "time_ns") or self.name.startswith("khep://")
        self.clock_speed = 1.0 if is_simulated else served_speed(self.name)
        self.times = LineTimes(0.0, 0.0)
        if timeout is None:
            slowness = 1 / self.clock_speed if 0 < self.clock_speed < 1 else 1.0
            reply_wait, self._silence_limit = _REPLY_WAIT_S * slowness, _SILENCE_S * slowness
        else:
            reply_wait = timeout / 2
            self._silence_limit = reply_wait * (1 + max(retries, 1))
        self._has_reported_delay = False
        first_baudrate = BAUD_RATES[0] if baudrate == "auto" else baudrate
        # The stubs of pyserial declare the members of all ports only for `Serial`.
        port = (
            open_port(url, first_baudrate, reply_wait) if isinstance(url, str) else cast(serial.Serial, url)
        )
        self.port = port
        # The model of a twin in this process is known before the first exchange.
        model = getattr(port, "robot_model", None)
        if model is not None and (other := DIALECTS[model]) is not dialect:
            port.close()
            raise self._other_robot(PortError, f"{self.name}: the robot is {other.robot_name}", other)
        if baudrate == "auto":
            try:
                find_baud_rate(self.port, self.name, lambda: self._port_time)
            except BaseException:
                self.port.close()
                raise
        self._unregister = register_cleanup(self._stop_at_exit)

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, otherwise of the wall clock, times a server's speed."""
        return self._port_time * (self.clock_speed if self.has_clock else 1.0)

    @property
    def has_clock(self) -> bool:
        """True if the robot's time passes while the host waits, at a known speed."""
        return 0 < self.clock_speed < math.inf

    @property
    def _port_time(self) -> float:
        """Time of the port's timeouts [s]."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S

    def sleep(self, duration: float) -> None:
        """Wait for a duration [s] in the port's time.

        Raises:
            PortError: The port's server has no clock for waits.
        """
        self.check_clock(f"a wait of {duration:.3g} s")
        if (sleep := getattr(self.port, "sleep", None)) is not None:
            self._yield_to_stop()
            with self._lock:
                sleep(duration)
        else:
            time.sleep(duration / self.clock_speed)

    def check_clock(self, subject: str) -> None:
        """Raise a PortError about a subject that needs the time of a port whose server has no such clock."""
        if not self.has_clock:
            option = "--speed max" if self.clock_speed else "--clock wire"
            raise PortError(
                f"{self.name}: {subject} at a server with {option}, where waits have no simulated time; "
                "expected khep://, or a server with --clock real and a --speed"
            )

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
            start = self.time
            values = self._execute(commands)
            self.times = self.times._replace(exchanges=self.times.exchanges + self.time - start)
            return values

    def ask(self, request: str) -> str:
        """Send any line, once, and return the reply, or a tool's first line: `HostRobot.ask`."""
        if not request.isascii() or "\n" in request or "\r" in request:
            raise ValueError(f"request {request!r}; expected one line of ASCII, without its ending")
        self._yield_to_stop()
        with self._lock:
            (reply,) = self._execute([HostCommand(request, str)])
            end = self._port_time + LONGEST_OUTPUT
            # `serial` replies with one line, and then changes the baud rate.
            has_output = request.lstrip()[:1].islower() and request.split()[0] != "serial"
            while has_output and self._port_time < end and self._read_line(request).endswith(b"\n"):
                pass
        return reply

    def _execute(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        requests = [command.request for command in commands]
        tries = 1 + (self._retries if all([command.repeatable for command in commands]) else 0)
        first_error: PortTimeout | ProtocolError | None = None
        self._prepare(requests)
        start = self._port_time
        while True:
            replies: list[str] = []
            try:
                self._exchange(requests, replies)
                return self._parse_replies(commands, replies)
            except (PortTimeout, ProtocolError) as error:
                first_error = first_error or error
                tries -= 1
                late_replies = self._resynchronize(start + self._silence_limit)
                if late_replies is None and isinstance(first_error, PortTimeout):
                    raise self._timeout_error(*self._missing_reply, start) from None
                if late_replies is None:
                    raise first_error from None
                if other := self._other_dialect(self._versions_reply):
                    text = f"{first_error}; {other.robot_name} answers so"
                    raise self._other_robot(ProtocolError, text, other) from None
            # Late replies are valid if they are complete.
            with suppress(ProtocolError):
                values = self._parse_replies(commands, (replies + late_replies)[-len(commands) :])
                if isinstance(first_error, PortTimeout):
                    self._report_delay(requests[0], self._port_time - start)
                return values
            if tries <= 0:
                raise first_error from None

    def check_model(self) -> None:
        """Raise a PortError if the robot replies to B as one of another kind."""
        if hasattr(self.port, "robot_model"):  # checked at the opening
            return
        with suppress(PortTimeout, ProtocolError):
            if other := self._other_dialect(self.ask("B")):
                raise self._other_robot(PortError, f"{self.name}: the robot is {other.robot_name}", other)

    def _other_dialect(self, versions_reply: str) -> Dialect | None:
        """Return the dialect of a reply to B if it is another one."""
        others = {KHEPERA, KHEPERA4} - {self._dialect}
        return next((other for other in others if other.versions_reply.fullmatch(versions_reply)), None)

    def _other_robot(self, kind: type[E], text: str, other: Dialect) -> E:
        """Return an error about a robot of another kind; programs see the class for it in the traceback."""
        error = kind(text, key="model", value=other.host_class.lower(), expected=self._dialect.robot_name)
        error.add_note(f"khep_twin.host.{other.host_class} is the class for {other.robot_name}")
        return error

    def _report_delay(self, request: str, delay: float) -> None:
        """Warn, once, of a reply that came late."""
        # A twin in this process is late only by a fault.
        if not (self._has_reported_delay or hasattr(self.port, "robot_model")):
            self._has_reported_delay = True
            warnings.warn(
                f"{self.name}: the reply to {request!r} took {delay:.1f} s; expected at most "
                f"{self.port.timeout:.2g} s: the twin's machine or the line is busy",
                stacklevel=5,
            )

    def _yield_to_stop(self) -> None:
        """Wait for a pending stop, as a lock alone could be taken by the same thread for ever."""
        if self._refuses_motion:
            self._stop_done.wait(STOP_WAIT)

    def _prepare(self, requests: Sequence[str]) -> None:
        """Refuse requests that move after `hold`, and resynchronize a line with pending replies."""
        moving_requests = [request for request in requests if self._may_move(request)]
        if self._refuses_motion and moving_requests:
            raise StoppedError(f"{self.name}: {moving_requests[0]!r} is not sent, as the run is to end")
        if self._unanswered_letters:
            start = self._port_time
            if self._resynchronize(start + self._silence_limit) is None:
                raise self._timeout_error(requests[0], b"", start)

    def _exchange(self, requests: Sequence[str], replies: list[str]) -> None:
        """Send lines and append each reply when it arrives."""
        self._unanswered_letters.update([request[:1] for request in requests])
        self._missing_reply = requests[0], b""
        self._write("\n".join([*requests, ""]).encode("ascii"), requests[0])
        for request in requests:
            line = self._read_line(request)
            if not line.endswith(b"\n"):
                self._missing_reply = request, line
                raise self._timeout_error(request, line, self._port_time)
            replies.append(_decode_line(line))
            # A request ends in a line feed, a reply in two bytes.
            bits = (len(request) + 1 + len(replies[-1]) + 2) * BITS_PER_BYTE
            self.times = self.times._replace(bytes=self.times.bytes + bits / self.port.baudrate)
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

    def _resynchronize(self, end: float = 0.0) -> list[str] | None:
        """Send probes until one synchronizes the line, the first in any case, others before `end`.

        Returns:
            The lines before the reply to the first probe; None without a reply.
        """
        lines: list[str] = []
        is_answered: bool | None = False
        fresh_letters = {*self._dialect.probe_letters} - self._unanswered_letters
        for n_reads in _PROBE_READS:
            is_answered = self._probe(lines, n_reads, end)
            if is_answered or is_answered is None or self._port_time >= end or self._refuses_motion:
                break
        if not is_answered:
            return None
        self._unanswered_letters.clear()
        # Without a probe of a fresh letter, no line is certainly a late reply.
        heads = tuple(f"{letter.lower()}," for letter in fresh_letters)
        return lines[: next((index for index, text in enumerate(lines) if text.startswith(heads)), 0)]

    def _probe(self, lines: list[str], n_reads: int, end: float) -> bool | None:
        """Send a probe, and append the lines up to its reply.

        Args:
            lines: Lines of this recovery.
            n_reads: Number of silent reads after which the probe has no reply.
            end: Time of the last silent read, if there are several [s].

        Returns:
            Whether the line is synchronized; None if it is never silent.
        """
        probes = self._dialect.probe_letters
        probe = next((letter for letter in probes if letter not in self._unanswered_letters), probes[0])
        # If replies to several probes are pending, the line is synchronized only when it is silent.
        is_ambiguous = probe in self._unanswered_letters and self.port.timeout is not None
        self._unanswered_letters.add(probe)
        # The leading line feed ends an interrupted command.
        self._write(f"\n{probe}\n".encode("ascii"), probe)
        chatter_s = self.port.timeout or _REPLY_TIMEOUT_S
        chatter_end = self._port_time + chatter_s
        is_answered = False
        while self._port_time <= chatter_end:
            line = self._read_line(probe)
            if line.endswith(b"\n"):
                lines.append(text := _decode_line(line))
                if text.startswith(f"{probe.lower()},"):
                    is_answered = True
                    self._versions_reply = text if probe == "B" else self._versions_reply
                    if not is_ambiguous:
                        return True
                continue
            n_reads -= 1
            if is_answered or n_reads <= 0 or self._port_time >= end or self._refuses_motion:
                return is_answered
            chatter_end = self._port_time + chatter_s
        return None

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

    def _timeout_error(self, request: str, line: bytes, start: float) -> PortTimeout:
        """Return the error for a missing reply, or a part of it, that was awaited since `start`."""
        duration = max(self._port_time - start, self.port.timeout or 0.0)
        return PortTimeout(
            f"{self.name}: no reply to {request!r} within {duration:.2g} s"
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

        A reply may take as long as that to a command. After a failure it reopens the port once, if possible,
        and tries again.

        Returns:
            Whether the robot has confirmed the stop, and a description of the outcome.
        """
        with self._lock:
            return self._halt()

    def _halt(self) -> tuple[bool, str]:
        # A line that has just been silent is not waited for again.
        limit = STOP_WAIT if self._unanswered_letters else max(STOP_WAIT, self._silence_limit)
        try:
            try:
                self._stop(limit)
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

    def _stop(self, limit: float = STOP_WAIT) -> None:
        """Send the requests that stop the motors, each for up to `limit` [s], until they are confirmed."""
        wait = STOP_WAIT / 2
        if self.port.timeout is None or not 0 < self.port.timeout <= wait:
            self._set_timeout(wait)
        for request in self._dialect.stop_requests:
            if not any(self._confirms_stop(request, wait) for _ in range(round(limit / wait))):
                raise PortTimeout(f"{self.name}: no reply to {request!r} within {limit:.2g} s")

    def _confirms_stop(self, request: str, wait: float) -> bool:
        """Send a request that stops the motors; return whether the robot confirms it."""
        reply = request[0].lower()
        self._write(f"\n{request}\n".encode("ascii"), request)
        if request[0] in self._unanswered_letters:  # a pending reply to a speed command looks the same
            return bool(late_replies := self._resynchronize()) and late_replies[-1] == reply
        end = self._port_time + wait
        line = b"\n"
        while line.endswith(b"\n") and self._port_time <= end:
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
