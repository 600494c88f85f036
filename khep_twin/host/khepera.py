"""`Khepera`: a robot at the other end of a serial port, real or simulated.

The port is a URL of pyserial: `/dev/ttyUSB0` is a robot on a cable, the link of `khep-twin serve` a twin in
real time, `socket://` and `rfc2217://` either of them over a network, `khep://default` a twin in this very
process, in lock-step.

    from khep_twin.host import Khepera

    with Khepera("khep://default") as robot:
        robot.set_speed(5, 5)
        robot.sleep(1)
        print(robot.proximity())
"""

import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import serial

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, PortError, PortTimeout, ProtocolError
from khep_twin.units import N_SENSORS

QUIET = 0.15
"""Silence after which no late reply is expected any more [s]: a long reply at 9600 baud takes 0.05 s."""


@dataclass(frozen=True, slots=True)
class WheelStatus:
    """One wheel's motion control, as command K tells it.

    Attributes:
        on_target: whether the target is reached; after a reset, too.
        mode: of the motor, as the robot's ROM counts (5.02: 0 speed, 1 position, 2 PWM).
        error: of the controller [pulses in position mode, pulses/10 ms in speed mode].
    """

    on_target: bool
    mode: int
    error: int


class Khepera:
    """A Khepera behind a serial port. Every method is one command; closing stops the motors.

    Args:
        url: of the port, or an open port of pyserial.
        timeout: longest wait for a reply [s], in the port's own time.
        baudrate: of the line; a robot in running mode 1 speaks 9600.

    Raises:
        PortError: the port cannot be opened.
    """

    def __init__(self, url: str | serial.SerialBase, timeout: float = 1.0, baudrate: int = 9600) -> None:
        if isinstance(url, str):
            try:
                self.port: Any = serial.serial_for_url(
                    url, baudrate=baudrate, stopbits=serial.STOPBITS_TWO, timeout=timeout
                )
            except (serial.SerialException, OSError, ValueError) as error:
                raise PortError(_why_not_opened(url, error)) from error
        else:
            self.port = url
        self._unanswered = False
        self.name: str = url if isinstance(url, str) else str(url.name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stops the motors, if the robot still answers, and closes the port."""
        if not self.port.is_open:
            return
        try:
            self.set_speed(0, 0)
        except KhepTwinError:
            pass  # the line or the twin is dead: there is nobody left to stop
        finally:
            self.port.close()

    # Time ----------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """The port's own time [s]: simulated on khep://, else the wall clock's."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S

    def sleep(self, duration: float) -> None:
        """Waits in the port's own time [s]."""
        getattr(self.port, "sleep", time.sleep)(duration)

    # Motors --------------------------------------------------------------------------------------------

    def set_speed(self, left: int, right: int) -> None:
        """D: drives the wheels at these speeds [pulses/10 ms = 8 mm/s], -127 to 127."""
        self._acknowledged("D", left, right)

    def set_target(self, left: int, right: int) -> None:
        """C: sends the wheels to these positions [pulses of 0.08 mm]."""
        self._acknowledged("C", left, right)

    def set_duty(self, left: int, right: int) -> None:
        """P: drives the motors with a fixed duty, -255 to 255, uncontrolled."""
        self._acknowledged("P", left, right)

    def set_position(self, left: int, right: int) -> None:
        """G: sets the position counters [pulses]."""
        self._acknowledged("G", left, right)

    def speed(self) -> tuple[int, int]:
        """E: measured speed of the left and right wheel [pulses/10 ms]."""
        left, right = self._values("E", 2)
        return left, right

    def position(self) -> tuple[int, int]:
        """H: position counters of the left and right wheel [pulses]."""
        left, right = self._values("H", 2)
        return left, right

    def status(self) -> tuple[WheelStatus, WheelStatus]:
        """K: motion control of the left and right wheel."""
        values = self._values("K", 6)
        left, right = (WheelStatus(bool(each[0]), each[1], each[2]) for each in (values[:3], values[3:]))
        return left, right

    def configure_speed_controller(self, kp: int, ki: int, kd: int) -> None:
        """A: gains of the speed controller; 3800, 800, 100 after a reset."""
        self._acknowledged("A", kp, ki, kd)

    def configure_position_controller(self, kp: int, ki: int, kd: int) -> None:
        """F: gains of the position controller; 3000, 20, 4000 after a reset."""
        self._acknowledged("F", kp, ki, kd)

    def configure_profile(
        self, left_speed: int, left_acceleration: int, right_speed: int, right_acceleration: int
    ) -> None:
        """J: trapezoid of `set_target`, by wheel: speed [pulses/10 ms], acceleration [3.125 mm/s^2]."""
        self._acknowledged("J", left_speed, left_acceleration, right_speed, right_acceleration)

    # Senses --------------------------------------------------------------------------------------------

    def proximity(self) -> tuple[int, ...]:
        """N: eight proximity counts, 0 to 1023; left 90, 45, 10, right 10, 45, 90, back right, back left."""
        return self._values("N", N_SENSORS)

    def ambient(self) -> tuple[int, ...]:
        """O: eight ambient counts in the order of `proximity`, about 500 (dark) to 50 (bright)."""
        return self._values("O", N_SENSORS)

    def converter(self, channel: int) -> int:
        """I: one channel of the 10-bit converter, 1024 = 4.09 V."""
        return self._values("I", 1, channel)[0]

    # The rest ------------------------------------------------------------------------------------------

    def versions(self) -> tuple[str, str]:
        """B: versions of the BIOS and of the protocol, e.g. ("5.02", "5.01")."""
        fields = self._fields("B", 2)
        return fields[0], fields[1]

    def set_led(self, led: int, action: int) -> None:
        """L: LED 0 (lateral) or 1 (frontal); action 0 off, 1 on, 2 toggle."""
        self._acknowledged("L", led, action)

    def read_bus(self, address: int) -> int:
        """R: a byte of the extension bus, addresses 0 to 63."""
        return self._values("R", 1, address)[0]

    def write_bus(self, data: int, address: int) -> None:
        """W: writes a byte to the extension bus."""
        self._acknowledged("W", data, address)

    def turret(self, number: int, message: str) -> str:
        """T: passes a message such as "D,0" on to a turret; returns its answer without the head "t,1,"."""
        request = f"T,{number},{message}"
        answer = self.ask(request)
        if not answer.startswith(f"t,{number},"):
            raise ProtocolError(f"{self.name}: {request!r} was answered {answer!r}")
        return answer.split(",", 2)[2]

    def ask(self, request: str) -> str:
        """Sends any line and returns the reply, both without their ending.

        Raises:
            PortTimeout: no whole reply came within the timeout.
            PortError: the port failed or went away.
        """
        try:
            if self._unanswered:
                self._resynchronise()
            self._unanswered = True
            self.port.write(request.encode("ascii") + b"\n")
            line: bytes = self.port.read_until(b"\n", None)
        except (serial.SerialException, OSError) as error:
            raise PortError(f"{self.name}: the port failed at {request!r}: {error}") from error
        if not line.endswith(b"\n"):
            raise PortTimeout(
                f"{self.name}: no reply to {request!r} within {self.port.timeout} s"
                + (f", only {line!r}" if line else "")
                + f"; is the robot on, in a serial mode of {self.port.baudrate} baud?"
            )
        self._unanswered = False
        return line.decode("latin-1").rstrip("\r\n")

    def _resynchronise(self) -> None:
        """After an exchange that was broken off: ends the line begun and lets pass what still comes."""
        before, self.port.timeout = self.port.timeout, QUIET
        try:
            self.port.write(b"\n")
            while self.port.read_until(b"\n", None):
                pass
        finally:
            self.port.timeout = before

    def _fields(self, letter: str, count: int, *arguments: int) -> list[str]:
        request = ",".join([letter, *map(str, arguments)])
        answer = self.ask(request)
        head, *fields = answer.split(",")
        if head != letter.lower() or len(fields) != count:
            raise ProtocolError(
                f"{self.name}: {request!r} was answered {answer!r}; "
                f"right is {letter.lower()!r} and {count} values"
            )
        return fields

    def _values(self, letter: str, count: int, *arguments: int) -> tuple[int, ...]:
        fields = self._fields(letter, count, *arguments)
        try:
            return tuple(int(field) for field in fields)
        except ValueError:
            answer = ",".join([letter.lower(), *fields])
            raise ProtocolError(
                f"{self.name}: {letter!r} was answered {answer!r}: not whole numbers"
            ) from None

    def _acknowledged(self, letter: str, *arguments: int) -> None:
        self._fields(letter, 0, *arguments)


def _why_not_opened(url: str, error: Exception) -> str:
    text = str(error)
    if "://" not in url and isinstance(error, serial.SerialException):
        return f"{url}: cannot open this port: {text}; `khep-twin serve` makes one, khep://default needs none"
    return text if text.startswith(url) else f"{url}: {text}"
