"""`HostRobot`: common part of the robots at the other end of a serial port, whatever they speak."""

import math
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self, TypeVar

import serial

from khep_twin.errors import PortError
from khep_twin.files.paths import StrPath
from khep_twin.host.host_command import HostCommand
from khep_twin.host.line import KHEPERA, Dialect, Line

A = TypeVar("A")


class HostRobot:
    """Robot behind a serial port. Leaving it as a context stops the motors.

    A missing or malformed reply raises an error with the exchange in it, after the line has been
    resynchronized. Reads are repeated once before; commands that move the robot are never sent twice.

    Args:
        url: URL of the port, or an open port of pyserial, which keeps its own timeout.
        timeout: Longest wait for a robot that is silent [s], in the port's own time; half of it for a reply,
            half to find out whether a robot is there.
        baudrate: Speed of the line.
        retries: Number of repetitions of a read.
        dialect: What the robot speaks.

    Attributes:
        name: Name of the port, for messages.

    Raises:
        PortError: The port cannot be opened, or its twin is of another kind.
        ValueError: A duration or number is out of range.
    """

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float,
        baudrate: int | Literal["auto"],
        retries: int,
        dialect: Dialect = KHEPERA,
    ) -> None:
        if not 0 <= timeout < math.inf:
            raise ValueError(f"timeout = {timeout}; expected a finite number from 0")
        try:
            self._line = Line(url, timeout / 2, baudrate, retries, dialect)
        except PortError as error:
            raise error.with_traceback(None) from None  # where it is opened is all that its reader needs
        self.name: str = self._line.name

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the motors and close the port.

        Raises:
            PortError: They could not be stopped, or the port has failed before; the message has the result.
        """
        if not self.port.is_open:
            return
        stopped, told = self._line.halt()
        if isinstance(error, PortError):
            raise type(error)(f"{error}; {told}") from error
        if not stopped and error is None:
            raise PortError(f"{self.name}: {told}")
        if not stopped and error is not None:
            error.add_note(f"{self.name}: {told}")

    def hold(self) -> None:
        """Stop the motors, from another thread than the one that drives, and refuse from now on to move.

        Raises:
            PortError: The motors could not be stopped.
        """
        self._line.hold()

    def close(self) -> None:
        """Stop the motors, if the robot still answers, and close the port."""
        if self.port.is_open:
            self._line.halt()

    @property
    def port(self) -> serial.Serial:
        """Port, of pyserial."""
        return self._line.port

    def listen(self, listener: Callable[[str, str], None] | None) -> Callable[[str, str], None] | None:
        """Call `listener` with each request and its reply from now on; None for no listener.

        Returns:
            The previous listener.
        """
        before, self._line.listener = self._line.listener, listener
        return before

    # Time ----------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the port [s]: simulated on khep://, else the wall clock's."""
        return self._line.time

    def sleep(self, duration: float) -> None:
        """Wait in the port's own time [s]."""
        self._line.sleep(duration)

    def ask(self, request: str) -> str:
        """Send any line, once, and return the reply, or a tool's first line, both without their ending.

        The rest of a tool's output is read and discarded: its end is the first pause of the timeout.

        Raises:
            PortTimeout: No whole reply came within the timeout.
            PortError: The port failed or went away.
            StoppedError: The line would move a robot that must stand still.
            ValueError: The request is more than one line.
        """
        return self._line.ask(request)

    def _do(self, command: HostCommand[A]) -> A:
        return self._line.carry_out([command])[0]
