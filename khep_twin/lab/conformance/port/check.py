"""Contract of a check of a robot or twin at a port.

A check is a function that takes a `CheckedPort`, raises a `Deviation`, and has the decorator `check`. The
checks in `catalogue` are run.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import serial

from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, KhepTwinError, PortError
from khep_twin.host.line import LONGEST_OUTPUT
from khep_twin.robots.framing import LINES, Framing
from khep_twin.units import BITS_PER_BYTE

SILENCE = 0.1
"""Time without a byte after which a line counts as silent [s]; impatient hosts have this time-out."""

SETTLE = 0.2
"""Silence that ends a banner [s]."""

_STOPPING = 0.3
"""Time in which a robot stops, or its wheels turn by several pulses [s]."""

REFUSED = "z,.*"
"""Pattern of the reply to a wrong command."""

_FIRST_BYTE = 0.010
"""Longest wait for a reply's first byte after the transmission of the command [s] (hosts tolerate it)."""
_REAL_TIME_SLACK = 0.02
"""Tolerance for delays by the operating system's scheduler [s]."""


class Deviation(KhepTwinError):
    """Error raised when a reply deviates from the protocol."""


class NotPossibleError(KhepTwinError):
    """Error raised when a check is not possible in the robot's surroundings or state."""


@dataclass(frozen=True, slots=True)
class Check:
    """One check.

    Attributes:
        name: Tested statement.
        section: Source of the statement: a section of the manual, "simulators" or "assumed".
        moves: Motion of the robot during the check; empty if it stands still.
        body: Function that runs the check.
        turret: Number of the checked turret; None for the robot itself.
        at_rest: Whether the robot must be at rest when the check starts.
    """

    name: str
    section: str
    moves: str
    body: Callable[["CheckedPort"], None]
    turret: int | None = None
    at_rest: bool = False


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Checks of a family of robots.

    Attributes:
        checks: Checks in the order in which they run.
        counters: Command that reads the positions of the wheels, of robots that may drive without commands;
            the commands D and E are then those of a Khepera.
    """

    checks: tuple[Check, ...]
    counters: str = ""


def check(
    name: str, section: str, moves: str = "", turret: int | None = None, *, at_rest: bool = False
) -> Callable[[Callable[["CheckedPort"], None]], Check]:
    """Return a decorator that turns a function into a check; the arguments are attributes of `Check`."""
    return lambda body: Check(name, section, moves, body, turret, at_rest or bool(moves))


class CheckedPort:
    """A pyserial port with a clock, which is simulated for a twin in the same process.

    Args:
        port: Port.
        framing: Ends of the messages; requests and replies are given by their texts.
    """

    def __init__(self, port: serial.Serial, framing: Framing = LINES) -> None:
        self.port = port
        self.framing = framing
        try:
            port.timeout = 1.0
        except PORT_FAILURES as error:
            raise PortError(f"{port.name}: the port failed: {error}") from error

    def ask(self, request: str) -> str:
        """Send a request and return its reply; raise a `Deviation` unless it is one message."""
        self.port.write(self.framing.encode(request))
        return self.reply(request)

    def send(self, data: str | bytes) -> None:
        """Send text or bytes to the robot."""
        self.port.write(data.encode("latin-1") if isinstance(data, str) else data)

    def reply(self, request: str) -> str:
        """Return the text of the next reply."""
        reply = self.framing.read(self.port, self.time)
        if not reply:
            raise Deviation(f"no reply to {request!r} within {self.port.timeout} s")
        if flaw := self.framing.flaw(reply):
            raise Deviation(f"{request!r} was answered {reply!r}; {flaw}")
        return self.framing.decode(reply)

    def expect_silence(self, context: str) -> None:
        """Raise a `Deviation` if anything is received."""
        if data := self.read_for(SILENCE):
            raise Deviation(f"{context}: received {data!r}; expected silence")

    def read_for(self, duration: float) -> bytes:
        """Return the bytes received within a duration [s]."""
        saved_timeout, self.port.timeout = self.port.timeout, duration
        try:
            return self.port.read(4096)
        finally:
            self.port.timeout = saved_timeout

    def read_until_quiet(self, quiet: float) -> bytes:
        """Return all bytes received until the line has been silent for a duration [s]."""
        data, end = b"", self.time() + LONGEST_OUTPUT
        while chunk := self.read_for(quiet):
            data += chunk
            if self.time() > end:
                raise Deviation(
                    f"the robot still sends after {LONGEST_OUTPUT:g} s; expected a pause of {quiet:g} s"
                )
        return data

    def numbers(self, request: str, count: int) -> list[int]:
        """Return the integers of a reply; raise a `Deviation` unless there are `count`."""
        self.port.write(self.framing.encode(request))
        return self.next_numbers(request, count)

    def next_numbers(self, request: str, count: int) -> list[int]:
        """Return the integers of the next reply, after its letter, or turret and letter."""
        head = request.lower().split(",")[: 3 if request.startswith("T,") else 1]
        answer = self.reply(request)
        if not re.fullmatch(rf"{','.join(head)}(,-?(0|[1-9]\d*)){{{count}}}", answer):
            expected = f"{','.join(head)!r} and {count} plain integers"
            raise Deviation(f"{request!r} was answered {answer!r}; expected {expected}")
        return [int(field) for field in answer.split(",")[len(head) :]]

    def expect(self, request: str, reply: str) -> None:
        """Raise a `Deviation` unless the reply to a request is this text, or matches it as a pattern."""
        self.port.write(self.framing.encode(request))
        self.expect_reply(request, reply)

    def expect_reply(self, request: str, reply: str) -> None:
        """Raise a `Deviation` unless the next reply is this text, or matches it as a pattern."""
        if (answer := self.reply(request)) != reply and not re.fullmatch(reply, answer):
            raise Deviation(f"{request!r} was answered {answer!r}; expected {reply!r}")

    def order(self, *requests: str, pause: float = 0.0) -> None:
        """Send commands whose replies must be their letter alone; then wait for `pause` [s]."""
        for request in requests:
            self.expect(request, request[0].lower())
        if pause:
            self.sleep(pause)

    def sleep(self, duration: float) -> None:
        """Wait for a duration by the port's clock [s]."""
        getattr(self.port, "sleep", time.sleep)(duration)

    def time(self) -> float:
        """Return the time of the port's clock [s]."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S


def is_driving(line: CheckedPort, counters: str = "H") -> bool:
    """Return whether the robot drives without a command, as in its demonstration, and D does not stop it.

    Args:
        line: Line of the robot.
        counters: Command that reads its positions.
    """
    for orders in ((), ("D,0,0",)):
        line.order(*orders, pause=_STOPPING if orders else 0.0)
        starts = line.numbers(counters, 2)
        line.sleep(_STOPPING)
        ends, speeds = line.numbers(counters, 2), line.numbers("E", 2)
        # Counters and speeds must agree, as either may be wrong.
        if not any((end - start) * speed > 0 for start, end, speed in zip(starts, ends, speeds, strict=True)):
            return False
    return True


def expect_range(request: str, values: list[int], low: int, high: int) -> None:
    """Raise a `Deviation` if a number of a reply is out of range."""
    for value in values:
        if not low <= value <= high:
            raise Deviation(f"{request!r} gave {value}; expected {low} to {high}")


class Numbers(NamedTuple):
    """A request for integers."""

    request: str
    n_values: int  # in the reply
    low: int  # least and greatest value
    high: int
    part: slice = slice(None)  # of the reply, which has these values


def replies(
    name: str, section: str, *steps: str | float | Numbers | tuple[str, ...], at_rest: bool = False
) -> Check:
    """Return a check of replies, with the attributes of a `Check`.

    A step is a command that is acknowledged, a pause [s], `Numbers`, or a reply, as for `CheckedPort.expect`,
    and the requests that get it.
    """

    def body(line: CheckedPort) -> None:
        for step in steps:
            if isinstance(step, str):
                line.order(step)
            elif isinstance(step, Numbers):
                expect_range(step.request, line.numbers(*step[:2])[step.part], step.low, step.high)
            elif isinstance(step, tuple):
                for request in step[1:]:
                    line.expect(request, step[0])
            else:
                line.sleep(step)

    return Check(name, section, "", body, at_rest=at_rest)


def expect_in_time(line: CheckedPort, request: str) -> None:
    """Raise a `Deviation` unless the reply starts within 10 ms and lasts as long as its bytes."""
    byte_time = BITS_PER_BYTE / line.port.baudrate
    slack = 0.0 if hasattr(line.port, "time_ns") else _REAL_TIME_SLACK
    # A network delivers a reply as a whole, at the time of its last byte.
    in_one_piece = str(line.port.port).startswith(("socket:", "rfc2217:"))
    start = line.time()
    line.send(request + "\n")
    first: bytes = line.port.read(1)
    wait = line.time() - start
    rest: bytes = line.port.read_until(b"\n")
    total = line.time() - start
    if not first:
        raise Deviation(f"no reply to {request!r}")
    n_bytes = len(first + rest) if in_one_piece else 1
    if wait > (len(request) + 1 + n_bytes) * byte_time + _FIRST_BYTE + slack:
        raise Deviation(f"the first byte of the reply to {request!r} came after {wait * 1000:.1f} ms")
    if total > (len(request) + 1 + len(first + rest)) * byte_time + _FIRST_BYTE + 2 * slack:
        raise Deviation(f"{request!r} and its reply of {len(first + rest)} bytes took {total * 1000:.1f} ms")
