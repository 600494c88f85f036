"""The serial line to a robot: requests, replies and the recovery of an exchange that went wrong.

The robot answers each line with one line, in order. When a reply is missing or malformed, `B` is sent: all
lines before its answer are old, and the last of them is the reply that was waited for. Only then is a
command sent again, and only one that does no harm twice. Where all reads of that kind are unanswered, an
answer may be any one's: the line must have been silent after it, too.
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

from khep_twin.board.protocol import MOVING
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, PortError, PortTimeout, ProtocolError, StoppedError
from khep_twin.files.atomic import resolved
from khep_twin.files.paths import StrPath
from khep_twin.host.commands import HostCommand
from khep_twin.host.opening import SPEEDS, find_speed, numbered, open_port
from khep_twin.signals import clear_at_end

Value = TypeVar("Value")

STOP_WAIT = 0.5
"""Longest wait for the answer to the last command, which stops the motors [s]."""

_REPLY_TIMEOUT_S = 1.0
"""Wait for a reply where a port has no timeout; the robot replies within 10 ms [s]."""

LONGEST_OUTPUT = 10.0
"""Longest wait for the end of a tool's output [s]; `list` takes 2 s at 9600 baud."""


class Dialect(NamedTuple):
    """Protocol of a kind of robots, as far as its line is concerned.

    Attributes:
        robot: Kind of robots.
        host: Class that speaks it.
        versions: Reply to B.
        probes: Reads whose replies resynchronize the line.
        stops: Requests that stop the motors, one after the other.
        moving: Beginnings of requests that move the robot.
    """

    robot: str
    host: str
    versions: re.Pattern[str]
    probes: str
    stops: tuple[str, ...]
    moving: tuple[str, ...]


KHEPERA = Dialect(
    "a Khepera", "Khepera", re.compile(r"b,\d.*"), "BHEK", ("D,0,0",), (*MOVING, "run", "restart")
)
KHEPERA4 = Dialect(
    "a Khepera IV", "Khepera4", re.compile(r"b,[A-P],\d+"), "BERG", ("A,2", "D,0,0"), ("A", "D", "F", "L")
)
"""Dialects. The vehicle of the Khepera IV drives on through a D; its H and K are no reads."""


class Line:
    """The line to one robot.

    Args:
        url: URL of the port, or an open port of pyserial.
        timeout: Longest wait for one try of a reply, and for a write [s], in the port's own time.
        baudrate: Speed of the line; "auto" tries `SPEEDS`.
        retries: Number of times a command that may be repeated is sent again.
        dialect: What the robot speaks.

    Attributes:
        port: Port of pyserial.
        name: Name of the port, for messages.
        listener: Callback that takes each request and its reply, both without their ending, or None.

    Raises:
        PortError: The port cannot be opened, its twin is of another kind, or there is no answer at any speed.
        ValueError: The number of retries is negative or no integer.
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
            url = numbered(os.fspath(url))
        self._url = url if isinstance(url, str) else None
        self._retries, self._dialect, self._told = retries, dialect, ""
        self._unanswered: set[str] = set()
        self.listener: Callable[[str, str], None] | None = None
        self._exchange = threading.RLock()
        self._held = False
        self._stood = threading.Event()
        self.name: str = url if isinstance(url, str) else str(url.name)
        speed = SPEEDS[0] if baudrate == "auto" else baudrate
        # Its stubs declare the members of all ports for this kind only.
        port = open_port(url, speed, timeout) if isinstance(url, str) else cast(serial.Serial, url)
        self.port = port
        # A twin in this process is known before the first exchange.
        model = getattr(port, "robot_model", None)
        if model is not None and (other := KHEPERA4 if model == "khepera4" else KHEPERA) is not dialect:
            port.close()
            raise PortError(f"{self.name}: the robot is {other.robot}{self._wish(other)}")
        if baudrate == "auto":
            try:
                find_speed(self.port, self.name, lambda: self.time)
            except BaseException:
                self.port.close()
                raise
        self._forget = clear_at_end(self._end)

    # Time ----------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, else the wall clock's."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S

    def sleep(self, duration: float) -> None:
        """Wait in the port's own time [s]."""
        if (sleep := getattr(self.port, "sleep", None)) is not None:
            self._give_way()
            with self._exchange:
                sleep(duration)
        else:
            time.sleep(duration)

    # Exchanges -----------------------------------------------------------------------------------------

    def carry_out(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        """Send commands in one burst and return the values of their replies.

        Raises:
            PortTimeout: A reply did not come.
            PortError: The port failed or went away.
            ProtocolError: A reply is not what its command asks for.
            StoppedError: A command would move a robot that must stand still.
        """
        self._give_way()
        with self._exchange:
            return self._carry_out(commands)

    def ask(self, request: str) -> str:
        """Send any line, once, and return the reply, or a tool's first line, both without their ending.

        The rest of a tool's output is read and discarded: its end is the first pause of the timeout.

        Raises:
            PortTimeout: No whole reply came within the timeout.
            PortError: The port failed or went away.
            StoppedError: The line would move a robot that must stand still.
            ValueError: The request is more than one line.
        """
        if not request.isascii() or "\n" in request or "\r" in request:
            raise ValueError(f"request {request!r}; expected one line of ASCII, without its ending")
        replies: list[str] = []
        self._give_way()
        with self._exchange:
            self._ask([request], replies)
            end = self.time + LONGEST_OUTPUT
            # `serial` answers in one line, and speaks at another speed from then on.
            prints = request.lstrip()[:1].islower() and request.split()[0] != "serial"
            while prints and self.time < end and self._read_line(request).endswith(b"\n"):
                pass
        return replies[0]

    def _carry_out(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        requests = [command.request for command in commands]
        tries = 1 + (self._retries if all([command.repeatable for command in commands]) else 0)
        first: PortTimeout | ProtocolError | None = None
        while True:
            replies: list[str] = []
            try:
                self._ask(requests, replies)
                return self._read(commands, replies)
            except (PortTimeout, ProtocolError) as error:
                first = first or error
                tries -= 1
                before = self._settle()
                if before is None:
                    # No robot there, or the probe itself got lost.
                    tries -= 1
                    if tries <= 0:
                        raise first from None
                    continue
                for other in {KHEPERA, KHEPERA4} - {self._dialect}:
                    if other.versions.fullmatch(self._told):
                        raise ProtocolError(f"{first}; {other.robot} answers so{self._wish(other)}") from None
            # What came late is as good, if it is whole.
            with suppress(ProtocolError):
                return self._read(commands, (replies + before)[-len(commands) :])
            if tries <= 0:
                raise first from None

    def _wish(self, other: Dialect) -> str:
        return f"; expected {self._dialect.robot}, or khep_twin.host.{other.host} for this one"

    def _give_way(self) -> None:
        """Let a stop come first that waits for the line: a lock alone may go to the same thread for ever."""
        if self._held:
            self._stood.wait(STOP_WAIT)

    def _ask(self, requests: Sequence[str], replies: list[str]) -> None:
        """Send lines and append the replies, each as it comes."""
        if self._held and (moves := [each for each in requests if self._moves(each)]):
            raise StoppedError(f"{self.name}: {moves[0]!r} is not sent, as the run is to end")
        if self._unanswered and self._settle() is None:
            raise self._silence(requests[0], b"")
        self._unanswered.update([request[:1] for request in requests])
        self._write("\n".join([*requests, ""]).encode("ascii"), requests[0])
        for request in requests:
            line = self._read_line(request)
            if not line.endswith(b"\n"):
                raise self._silence(request, line)
            replies.append(_text(line))
            if self.listener is not None:
                self.listener(request, replies[-1])
        self._unanswered.clear()

    def _read(self, commands: Sequence[HostCommand[Value]], replies: Sequence[str]) -> list[Value]:
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

    def _settle(self) -> list[str] | None:
        """Resynchronize with the robot; return the lines before the answer to a probe, None without one."""
        probes = self._dialect.probes
        probe = next((letter for letter in probes if letter not in self._unanswered), probes[0])
        # Answers to each of them may be to come: the line is in step only once it is silent.
        is_repeated = probe in self._unanswered and self.port.timeout is not None
        self._unanswered.add(probe)
        # The line feed before it ends a command that was broken off.
        self._write(f"\n{probe}\n".encode("ascii"), probe)
        lines: list[str] = []
        before: list[str] | None = None
        end = self.time + (self.port.timeout or _REPLY_TIMEOUT_S)
        while self.time <= end:
            line = self._read_line(probe)
            if not line.endswith(b"\n"):
                break
            text = _text(line)
            if text.startswith(f"{probe.lower()},"):
                before = lines.copy()
                self._told = text if probe == "B" else self._told
                if not is_repeated:
                    break
            lines.append(text)
        else:
            before = None
        if before is not None:
            self._unanswered.clear()
        return before

    def _write(self, data: bytes, request: str) -> None:
        try:
            self.port.write(data)
        except serial.SerialTimeoutException as error:
            raise PortTimeout(
                f"{self.name}: {request!r} could not be sent within {self.port.write_timeout} s: no program "
                "reads at the other end"
            ) from error
        except PORT_FAILURES as error:
            raise self._failed(request, error) from error

    def _read_line(self, request: str) -> bytes:
        try:
            return self.port.read_until(b"\n", None)
        except PORT_FAILURES as error:
            raise self._failed(request, error) from error

    def _silence(self, request: str, line: bytes) -> PortTimeout:
        return PortTimeout(
            f"{self.name}: no reply to {request!r} within {self.port.timeout} s"
            + (f", only {line!r}" if line else "")
            + f"; is the robot on, in a serial mode of {self.port.baudrate} baud?"
        )

    def _failed(self, request: str, error: Exception) -> PortError:
        return PortError(f"{self.name}: the port failed at {request!r}: {error}")

    # The end -------------------------------------------------------------------------------------------

    def hold(self) -> None:
        """Stop the motors after the exchange that another thread is at, and refuse from now on to move.

        Raises:
            PortError: They could not be stopped.
        """
        self._held = True
        try:
            with self._exchange:
                before = self.port.timeout
                self._stop()
                self._set_timeout(before)
        finally:
            self._stood.set()

    def halt(self) -> tuple[bool, str]:
        """Stop the motors as far as that is possible, and close the port.

        It waits for STOP_WAIT on the line; where that fails, it opens the port once more and waits again.

        Returns:
            True if the robot has confirmed the stop, and a text on what was done.
        """
        with self._exchange:
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
            if refusal := self._refuses_again():
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
        """Send the stop of the motors, each request twice if necessary, and wait for the answer."""
        wait = STOP_WAIT / 2
        if self.port.timeout is None or not 0 < self.port.timeout <= wait:
            self._set_timeout(wait)
        for request in self._dialect.stops:
            if not (self._stops_by(request, wait) or self._stops_by(request, wait)):
                raise PortTimeout(f"{self.name}: no reply to {request!r} within {STOP_WAIT} s")

    def _stops_by(self, request: str, wait: float) -> bool:
        """Send a request that stops the motors; return whether it was answered."""
        answer = request[0].lower()
        self._write(f"\n{request}\n".encode("ascii"), request)
        if request[0] in self._unanswered:  # a speed whose answer, to come yet, is the same
            return bool(before := self._settle()) and before[-1] == answer
        end = self.time + wait
        line = b"\n"
        while line.endswith(b"\n") and self.time <= end:
            line = self._read_line(request)
            if _text(line) == answer:
                return True
        return False

    def _moves(self, request: str) -> bool:
        """Return whether a request may move the robot."""
        return request not in self._dialect.stops and request.lstrip().startswith(self._dialect.moving)

    def _set_timeout(self, timeout: float | None) -> None:
        # pyserial negotiates the settings of a port on the network anew for it.
        try:
            self.port.timeout = timeout
        except PORT_FAILURES as error:
            raise self._failed(self._dialect.stops[-1], error) from error

    def _close(self) -> None:
        self._forget()
        with suppress(*PORT_FAILURES):
            self.port.close()

    def _end(self) -> None:
        """Stop the motors of a robot where the process is ended from outside, even amid an exchange."""
        if not hasattr(self.port, "time_ns"):
            with suppress(PortError):
                self._stop()

    def _refuses_again(self) -> str:
        """Return the reason not to open the port once more; empty if it may be opened."""
        if self._url is None or hasattr(self.port, "time_ns"):
            return "this port is not opened again"
        path = Path(self._url)
        if "://" in self._url or not resolved(path).is_relative_to("/dev/pts"):
            return ""
        if sys.platform == "win32":
            return ""
        from khep_twin.ports.link import leads_to_ours

        if not leads_to_ours(path):
            return "a terminal that has gone is not opened again, as its number may be reused by now"
        return ""


def _text(line: bytes) -> str:
    return line.decode("latin-1").rstrip("\r\n")
