"""`HostRobot`: common part of the robots at the other end of a serial port."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Literal, Self, TypeVar, cast

import serial

from khep_twin.errors import PortError, RobotModelError
from khep_twin.files.paths import StrPath
from khep_twin.host.host_command import HostCommand
from khep_twin.host.line import Line, LineTimes
from khep_twin.robots.model import Dialect, Read, RobotModel

Value = TypeVar("Value")


def open_robot(model: RobotModel, url: StrPath | serial.SerialBase, **options: Any) -> "HostRobot":
    """Open the robot of a model at a port; options are those of the model's host class."""
    host_class = cast(Callable[..., HostRobot], model.load_class("host", HostRobot))
    robot = host_class(url, **options)
    robot.model = model
    return robot


class HostRobot:
    """Robot behind a serial port. Leaving it as a context stops the motors.

    A missing or malformed reply raises an error with the exchange in it, after the line has been
    resynchronized. Reads are repeated first; commands that move the robot are never repeated.

    Args:
        url, timeout, baudrate, retries: See `Khepera`; `baudrate` is by default the usual one of the dialect.

    Attributes:
        model: Model of the robot; the first one with its protocol, if it is unknown.
        burst_length: Number of requests that are sent before the first reply.
        leds: Names of its LEDs.
        name: Name of the port, for messages.
        identity: Reply that identified the robot when its baud rate was searched; empty for a known rate.

    Raises:
        PortError: The port cannot be opened, or its twin is of another kind.
        ValueError: A duration or number is out of range.
    """

    model: RobotModel
    burst_length = 1
    leds: tuple[str, ...] = ()

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float | None = None,
        baudrate: int | Literal["auto"] | None = None,
        *,
        retries: int = 1,
    ) -> None:
        if timeout is not None and not 0 <= timeout < math.inf:
            raise ValueError(f"timeout = {timeout}; expected a finite number from 0")
        try:
            self._line = Line(url, timeout, baudrate or self.dialect.baud, retries, self.dialect)
        except PortError as error:
            raise error.with_traceback(None) from None  # a short traceback: it ends at this line
        self.name: str = self._line.port.name
        self.identity = self._line.port.identity

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the motors and close the port.

        Raises:
            PortError: The stop or an earlier exchange failed; the message reports whether the motors stopped.
        """
        if not self.port.is_open:
            return
        is_stopped, outcome = self._line.halt()
        if isinstance(error, PortError):
            raise type(error)(f"{error}; {outcome}") from error
        if not is_stopped and error is None:
            raise PortError(f"{self.name}: {outcome}")
        if not is_stopped and error is not None:
            error.add_note(f"{self.name}: {outcome}")

    def hold(self) -> None:
        """Stop the motors from another thread, and refuse later commands that move.

        Raises:
            PortError: The motors could not be stopped.
        """
        self._line.hold()

    def close(self) -> None:
        """Stop the motors, if the robot still answers, and close the port."""
        if self.port.is_open:
            self._line.halt()

    @property
    def dialect(self) -> Dialect:
        """Protocol of the robot."""
        return self.model.dialect

    @property
    def port(self) -> serial.Serial:
        """Port of pyserial."""
        return self._line.port.serial_port

    def listen(self, listener: Callable[[str, str], None] | None) -> Callable[[str, str], None] | None:
        """Call `listener` with each later request and its reply; None for no listener.

        Returns:
            The previous listener.
        """
        previous_listener, self._line.listener = self._line.listener, listener
        return previous_listener

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, otherwise of the wall clock, times a server's speed."""
        return self._line.port.time

    @property
    def clock_speed(self) -> float:
        """Simulated seconds per second of a server's wall time, as in `ServedPort`; 1 for a robot."""
        return self._line.port.clock_speed

    @property
    def line_times(self) -> LineTimes:
        """Times of all exchanges so far."""
        return self._line.times

    def check_clock(self, subject: str) -> None:
        """Refuse something that needs the port's time, which a server with the wire clock has not.

        Raises:
            PortError: The robot's time does not pass while the host waits, or at an unknown speed.
        """
        self._line.port.check_clock(subject)

    def check_model(self) -> None:
        """Refuse a robot of another kind, by its reply to the first probe, for example B.

        Raises:
            PortError: The robot is of another kind.
        """
        self._line.check_model()

    def sleep(self, duration: float) -> None:
        """Wait for a duration [s] in the port's time.

        Raises:
            PortError: The port is that of a server with `--clock wire` or `--speed max`.
        """
        self._line.sleep(duration)

    def stop(self) -> None:
        """Stop the wheels, and a program on the robot that drives."""
        for request in self.dialect.stop_requests:
            self._run(HostCommand(request, partial(self._check_answer, request), repeatable=True))

    def set_setpoints(self, left: int, right: int) -> None:
        """Set the speeds of the wheels [register], as controllers of episodes do."""
        request = self.dialect.drive(left, right)
        check = partial(self._check_answer, request)
        self._run(HostCommand(request, check, repeatable=request in self.dialect.stop_requests))

    def read_channels(self, *names: str) -> dict[str, list[int]]:
        """Return the registers that can be read of channels of the model's log, by name, from one burst.

        Raises:
            KeyError: The model has no request for a channel.
        """
        reads = {name: self.dialect.reads[name] for name in names}
        requests = dict.fromkeys(map(_request_of, reads.values()))
        replies = dict(zip(requests, self._run_all(list(map(self._read_command, requests))), strict=True))
        return {name: [replies[_request_of(read)][i] for i in read.values] for name, read in reads.items()}

    def read_registers(self, registers: Sequence[int]) -> list[int]:
        """Return registers of the model, for example those of `Interface.proximity`, one request at a time.

        Raises:
            RobotModelError: No request reads one of them.
        """
        values: dict[int, int] = {}
        for register in registers:
            if register in values:
                continue
            if (read := self.dialect.read_of(register)) is None:
                raise RobotModelError(f"model {self.model.name}: no request reads register {register}")
            reply = self._run(self._read_command(_request_of(read)))
            values |= zip(read.registers, [reply[index] for index in read.values], strict=True)
        return [values[register] for register in registers]

    def read_panel(self) -> dict[str, list[int]]:
        """Return the values of a panel: "proximity" and "ambient" [counts], "speed" [register]."""
        return self.read_channels("proximity", "ambient", "speed")

    def supply_voltage(self) -> float | None:
        """Return the voltage of the supply [V]; None if the robot does not report it."""
        return None

    def light_leds(self, are_lit: Sequence[bool]) -> None:
        """Switch the LEDs of `leds` on or off."""

    def reset_position(self) -> None:
        """Set the position counters to 0.

        Raises:
            RobotModelError: The model has no request for it.
        """
        raise RobotModelError(f"model {self.model.name}: no request resets the position counters")

    def ask(self, request: str) -> str:
        """Send any request, once, and return the reply, or a tool's first line, by their texts.

        The text is that of a line without its ending, or the hexadecimal digits of a binary frame.

        The rest of a tool's output is read and discarded; it ends at a pause of the timeout.

        Raises:
            PortTimeout: No complete reply arrived within the timeout.
            PortError: The port failed or disappeared.
            StoppedError: The line would move a robot after `hold`.
            ValueError: The request is not one line, or not one frame.
        """
        return self._line.ask(request)

    def _check_answer(self, request: str, reply: str) -> None:
        if not self.dialect.framing.answers(request, reply):
            raise ValueError("expected a reply to this command")

    def _read_command(self, request: tuple[str, int]) -> HostCommand[Sequence[int]]:
        text, n_values = request

        def read(reply: str) -> Sequence[int]:
            self._check_answer(text, reply)
            if len(values := self.dialect.framing.values(reply)) != n_values:
                raise ValueError(f"expected {n_values} values")
            return values

        return HostCommand(text, read, repeatable=True)

    def _run(self, command: HostCommand[Value]) -> Value:
        return self._line.execute([command])[0]

    def _run_all(self, commands: Sequence[HostCommand[Value]]) -> list[Value]:
        """Run commands in bursts; return their values."""
        starts = range(0, len(commands), self.burst_length)
        bursts = (commands[start : start + self.burst_length] for start in starts)
        return [value for burst in bursts for value in self._line.execute(burst)]


def _request_of(read: Read) -> tuple[str, int]:
    """Return a request, and the number of values in its reply."""
    return read.request, read.n_values
