"""Conformance of a robot or twin at a port to the Khepera's serial protocol.

One body of checks for twin and robot. Each check is a function of a `CheckedPort` that raises `Deviation`,
and names the section of the manual (Khepera User Manual 5.02) that it tests. Checks that move the robot are
optional.
"""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass

import serial

from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, KhepTwinError, PortError
from khep_twin.host.line import LONGEST_OUTPUT

SILENCE = 0.1
"""Time without a byte after which a line counts as silent [s]; impatient hosts wait as long for a reply."""


_NUMBER = re.compile("-?(0|[1-9][0-9]*)")


class Deviation(KhepTwinError):
    """Error raised where a reply deviates from the protocol."""


@dataclass(frozen=True, slots=True)
class Check:
    """One check.

    Attributes:
        name: Tested statement.
        section: Section of the manual.
        moves: Motion of the robot during the check; empty if it stands still.
        body: Function that runs the check.
        turret: Number of the turret that it asks; None for the robot itself.
    """

    name: str
    section: str
    moves: str
    body: Callable[["CheckedPort"], None]
    turret: int | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a check; `deviation` is empty if it passed, or if the robot has not the turret it asks."""

    name: str
    section: str
    deviation: str
    absent: bool = False


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of all checks.

    Attributes:
        port: URL of the port.
        results: Results in the order of the checks.
        skipped: Names of the checks that were left out as they move the robot.
    """

    port: str
    results: tuple[Result, ...]
    skipped: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return not any(result.deviation for result in self.results)

    def text(self) -> str:
        """Return the report as readable text."""
        failed = [result for result in self.results if result.deviation]
        absent = [result for result in self.results if result.absent]
        lines = [
            f"{'FAIL' if result.deviation else 'none' if result.absent else 'ok  '}  "
            f"{result.name} [{result.section}]"
            for result in self.results
        ]
        lines += [f"skip  {name} (moves the robot; enable with --move)" for name in self.skipped]
        lines += [f"\n{result.name}\n    {result.deviation}" for result in failed]
        passed = len(self.results) - len(failed) - len(absent)
        told = f", {len(absent)} of turrets that are absent" if absent else ""
        lines.append(f"\n{self.port}: {passed} passed, {len(failed)} failed{told}")
        return "\n".join(lines)

    def json(self) -> str:
        """Return the report as JSON."""
        return json.dumps({"passed": self.passed, **asdict(self)}, indent=2)


class CheckedPort:
    """A pyserial port with its own time."""

    def __init__(self, port: serial.Serial) -> None:
        self.port = port
        try:
            port.timeout = 1.0
        except PORT_FAILURES as error:
            raise PortError(f"{port.name}: the port failed: {error}") from error

    def ask(self, request: str, end: str = "\n") -> str:
        """Send a line and return its reply without CR LF; raise a `Deviation` unless it is one line."""
        self.send(request + end)
        return self.reply(request)

    def send(self, text: str) -> None:
        """Send text to the robot."""
        self.port.write(text.encode("latin-1"))

    def reply(self, request: str) -> str:
        """Return the next reply without CR LF."""
        line: bytes = self.port.read_until(b"\n")
        if not line:
            raise Deviation(f"no reply to {request!r} within {self.port.timeout} s")
        if not line.endswith(b"\r\n") or b"\r" in line[:-2]:
            raise Deviation(f"{request!r} was answered {line!r}; expected one line that ends in CR LF")
        if not line.isascii():
            raise Deviation(f"{request!r} was answered {line!r}; expected plain ASCII")
        return line[:-2].decode("ascii")

    def silent(self, why: str) -> None:
        """Raise a `Deviation` if anything is received."""
        if data := self.read_for(SILENCE):
            raise Deviation(f"{why}: received {data!r}; expected silence")

    def read_for(self, duration: float) -> bytes:
        """Return the bytes received within a duration [s]."""
        before, self.port.timeout = self.port.timeout, duration
        try:
            return self.port.read(4096)
        finally:
            self.port.timeout = before

    def read_until_quiet(self, quiet: float) -> bytes:
        """Return the bytes received until the line was quiet for a duration [s]: any number of lines."""
        told, end = b"", self.time() + LONGEST_OUTPUT
        while more := self.read_for(quiet):
            told += more
            if self.time() > end:
                found = f"the robot still sends after {LONGEST_OUTPUT:g} s"
                raise Deviation(f"{found}; expected a pause of {quiet:g} s")
        return told

    def numbers(self, request: str, count: int) -> list[int]:
        """Return the integers of a reply; raise a `Deviation` unless there are `count`."""
        answer, letter = self.ask(request), request[0].lower()
        head, *fields = answer.split(",")
        if head != letter or len(fields) != count:
            raise Deviation(f"{request!r} was answered {answer!r}; expected {letter!r} and {count} numbers")
        if not all(_NUMBER.fullmatch(field) for field in fields):
            raise Deviation(f"{request!r} was answered {answer!r}; expected plain integers")
        return [int(field) for field in fields]

    def expect(self, request: str, reply: str) -> None:
        """Raise a `Deviation` unless a request gets this reply."""
        if (answer := self.ask(request)) != reply:
            line = f"{request}\n"
            raise Deviation(f"{line!r} was answered {answer!r}; expected {reply!r}")

    def order(self, *requests: str, pause: float = 0.0) -> None:
        """Send commands, each of which must be answered by its letter alone; then wait [s]."""
        for request in requests:
            self.expect(request, request[0].lower())
        if pause:
            self.sleep(pause)

    def sleep(self, duration: float) -> None:
        """Wait for a duration in the port's own time [s]."""
        getattr(self.port, "sleep", time.sleep)(duration)

    def time(self) -> float:
        """Return the port's own time [s]."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S


def conform(url: str, *, move: bool = False, baudrate: int = 9600) -> ConformanceReport:
    """Check the robot or twin at a port; with `move` also by the checks that move the robot.

    Raises:
        PortError: The port cannot be opened.
    """
    from khep_twin.host import Khepera

    if baudrate < 1:
        raise PortError(key="baudrate", value=baudrate, expected="the speed of the line, such as 9600")
    # A broken robot may not even confirm the last stop; the report must survive that.
    with closing(Khepera(url, baudrate=baudrate)) as robot:
        return examine(CheckedPort(robot.port), url, move=move)


def examine(line: CheckedPort, name: str, *, move: bool = False) -> ConformanceReport:
    """Run the checks on an open line."""
    results = tuple(run_check(check, line) for check in checks(move))
    skipped = () if move else tuple(check.name for check in checks(True) if check.moves)
    return ConformanceReport(name, results, skipped)


def checks(move: bool) -> Iterator[Check]:
    """Return all checks, with or without those that move the robot."""
    # Those that move the robot come behind the others, in one list.
    from khep_twin.lab.conformance import motion as motion
    from khep_twin.lab.conformance.vision_checks import ALL

    return (check for check in ALL if move or not check.moves)


def run_check(check: Check, line: CheckedPort) -> Result:
    """Run one check on a quiet line and leave the line quiet."""
    deviation, absent = "", False
    try:
        line.port.reset_input_buffer()
        try:
            absent = check.turret is not None and line.ask(f"T,{check.turret},B").startswith("z,")
            if not absent:
                check.body(line)
            line.silent("after the last reply")
        except Deviation as error:
            deviation = str(error)
            # Leftovers of a wrong answer must not reach the next check.
            line.send("\n")
            line.read_for(0.3)
    except PORT_FAILURES as error:
        deviation = f"the port failed: {error}"
    return Result(check.name, check.section, deviation, absent)
