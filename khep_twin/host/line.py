"""The serial line to a robot: requests, replies and the recovery of an exchange that went wrong.

The robot replies to each request once, in order. A missing or malformed reply is followed by a
`Resynchronization`; only then is a command repeated, if it is repeatable.
"""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Literal, NamedTuple, TypeVar

import serial

from khep_twin.errors import PortError, PortTimeout, ProtocolError, StoppedError
from khep_twin.files.paths import StrPath
from khep_twin.host.commands import HostCommand
from khep_twin.host.final_stop import STOP_WAIT, FinalStop, StopResult
from khep_twin.host.resynchronization import Resynchronization
from khep_twin.host.robot_port import RobotPort
from khep_twin.robots.model import Dialect, RobotModel
from khep_twin.robots.registry import find_model, find_other_model
from khep_twin.units import BITS_PER_BYTE

Value = TypeVar("Value")
E = TypeVar("E", PortError, ProtocolError)

LONGEST_OUTPUT = 10.0
"""Longest wait for the end of a tool's output [s]; `list` takes 2 s at 9600 baud."""


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
        port: Port of the robot.
        times: Times of all exchanges so far.
        listener: Callback for the texts of each request and its reply, or None.

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
        dialect: Dialect,
    ) -> None:
        if not (retries >= 0 and float(retries).is_integer()):
            raise ValueError(f"retries={retries!r}; expected an integer from 0")
        self._retries = retries
        self._dialect = dialect
        self._missing_reply = "", b""
        self.listener: Callable[[str, str], None] | None = None
        self.times = LineTimes(0.0, 0.0)
        self._lock = threading.RLock()
        self._stop_request, self._stop_done = threading.Event(), threading.Event()
        self.port = RobotPort(url, timeout, baudrate, retries, dialect.framing)
        # The model of a twin in this process is known before the first exchange.
        model = self.port.model
        if model is not None and (other := find_model(model)).dialect is not dialect:
            self.port.serial_port.close()
            raise self._port_error(other)
        if baudrate == "auto":
            self.port.find_baud_rate()
        self._resynchronization = Resynchronization(self.port, dialect.probes, self._stop_request)
        self._final_stop = FinalStop(self.port, dialect.stop_requests, self._resynchronization)

    def sleep(self, duration: float) -> None:
        """Wait for a duration [s] in the port's time.

        Raises:
            PortError: The port's server has no clock for waits.
        """
        self.port.check_clock(f"a wait of {duration:.3g} s")
        if (sleep := getattr(self.port.serial_port, "sleep", None)) is not None:
            self._yield_to_stop()
            with self._lock:
                sleep(duration)
        else:
            time.sleep(duration / self.port.clock_speed)

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
            start = self.port.time
            values = self._execute(commands)
            self.times = self.times._replace(exchanges=self.times.exchanges + self.port.time - start)
            return values

    def ask(self, request: str) -> str:
        """Send any request, once, and return the reply, or a tool's first line: `HostRobot.ask`."""
        request = self.port.framing.decode(self.port.framing.encode(request))
        self._yield_to_stop()
        with self._lock:
            (reply,) = self._execute([HostCommand(request, str)])
            end = self.port.timeout_time + LONGEST_OUTPUT
            # `serial` replies with one line, and then changes the baud rate.
            has_output = not self.port.framing.has_one_reply(request) and request.split()[0] != "serial"
            while has_output and self.port.timeout_time < end:
                has_output = self.port.read_reply(request)[0] is not None
        return reply

    def _execute(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        requests = [command.request for command in commands]
        tries = 1 + (self._retries if all([command.repeatable for command in commands]) else 0)
        first_error: PortTimeout | ProtocolError | None = None
        self._prepare(requests)
        start = self.port.timeout_time
        while True:
            replies: list[str] = []
            try:
                self._exchange(requests, replies)
                return self._parse_replies(commands, replies)
            except (PortTimeout, ProtocolError) as error:
                first_error = first_error or error
                tries -= 1
                late_replies = self._await_late_replies(first_error, start)
            # Late replies are valid if they are complete.
            with suppress(ProtocolError):
                values = self._parse_replies(commands, (replies + late_replies)[-len(commands) :])
                if isinstance(first_error, PortTimeout):
                    self._resynchronization.report_delay(requests[0], self.port.timeout_time - start)
                return values
            if tries <= 0:
                raise first_error from None

    def _await_late_replies(self, error: PortTimeout | ProtocolError, start: float) -> list[str]:
        """Return the late replies after the error of an exchange; raise the error at a silent robot."""
        late_replies = self._resynchronization.resynchronize(start + self.port.silence_limit)
        if late_replies is None and isinstance(error, PortTimeout):
            raise self.port.timeout_error(*self._missing_reply, start) from None
        if late_replies is None:
            raise error from None
        if other := find_other_model(self._dialect, self._resynchronization.versions_reply):
            text = f"{error}; {other.dialect.robot_name} answers so"
            raise self._model_error(ProtocolError, text, other) from None
        return late_replies

    def check_model(self) -> None:
        """Raise a PortError if the robot identifies itself as one of another kind."""
        if self.port.model is not None:  # checked at the opening
            return
        with suppress(PortTimeout, ProtocolError):
            if other := find_other_model(self._dialect, self.ask(self._dialect.probes[0])):
                raise self._port_error(other)

    def _port_error(self, other: RobotModel) -> PortError:
        text = f"{self.port.name}: the robot is {other.dialect.robot_name}"
        return self._model_error(PortError, text, other)

    def _model_error(self, kind: type[E], text: str, other: RobotModel) -> E:
        """Return an error about a robot of another kind; programs see the class for it in the traceback."""
        error = kind(text, key="model", value=other.family, expected=self._dialect.robot_name)
        error.add_note(f"{other.dialect.host_class} is the class for {other.dialect.robot_name}")
        return error

    def _yield_to_stop(self) -> None:
        """Wait for a pending stop, as a lock alone could be taken by the same thread for ever."""
        if self._stop_request.is_set():
            self._stop_done.wait(STOP_WAIT)

    def _prepare(self, requests: Sequence[str]) -> None:
        """Refuse requests that move after `hold`, and resynchronize a line with pending replies."""
        if self._stop_request.is_set():
            framing = self.port.framing
            texts = [framing.decode(framing.encode(request)) for request in requests]
            if moving_requests := [*filter(self._dialect.may_move, texts)]:
                raise StoppedError(
                    f"{self.port.name}: {moving_requests[0]!r} is not sent, as the run is to end"
                )
        if self._resynchronization.unanswered:
            start = self.port.timeout_time
            if self._resynchronization.resynchronize(start + self.port.silence_limit) is None:
                raise self.port.timeout_error(requests[0], b"", start)

    def _exchange(self, requests: Sequence[str], replies: list[str]) -> None:
        """Send requests and append each reply when it arrives."""
        framing = self.port.framing
        self._resynchronization.unanswered.update([framing.command(request) for request in requests])
        self._missing_reply = requests[0], b""
        self.port.send(requests)
        for request in requests:
            reply, data = self.port.read_reply(request)
            if reply is None:
                self._missing_reply = request, data
                raise self.port.timeout_error(request, data, self.port.timeout_time)
            replies.append(reply)
            bits = (len(framing.encode(request)) + len(data)) * BITS_PER_BYTE
            self.times = self.times._replace(bytes=self.times.bytes + bits / self.port.serial_port.baudrate)
            if self.listener is not None:
                self.listener(request, reply)
        self._resynchronization.unanswered.clear()

    def _parse_replies(self, commands: Sequence[HostCommand[Value]], replies: Sequence[str]) -> list[Value]:
        """Return the values of replies, one for each command."""
        if len(replies) != len(commands):
            raise ProtocolError(f"{self.port.name}: {len(commands)} commands got {len(replies)} replies")
        values: list[Value] = []
        for command, reply in zip(commands, replies, strict=True):
            try:
                values.append(command.read(reply))
            except ValueError as error:
                raise ProtocolError(
                    f"{self.port.name}: {command.request!r} was answered {reply!r}; {error}"
                ) from None
        return values

    def hold(self) -> None:
        """Stop the motors after another thread's exchange, and refuse later commands that move.

        Raises:
            PortError: The motors could not be stopped.
        """
        self._stop_request.set()
        try:
            with self._lock:
                self._final_stop.hold()
        finally:
            self._stop_done.set()

    def halt(self) -> StopResult:
        """Try to stop the motors, and close the port.

        A reply may take as long as that to a command. After a failure it reopens the port once, if possible,
        and tries again.
        """
        with self._lock:
            return self._final_stop.halt()
