"""Conformance: whether what is at the end of a port speaks the Khepera's serial protocol.

One body of checks for twin and robot. Each check is a function of a `Line` that raises `Deviation`, and names
the section of the manual (Khepera User Manual 5.02) that it stands on. What moves the robot runs only if
asked.
"""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import serial

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, PortError

SILENCE = 0.1
"""How long a line must stay silent before it counts as silent [s]: what impatient hosts wait for a reply."""


_NUMBER = re.compile("-?(0|[1-9][0-9]*)")


class Deviation(KhepTwinError):
    """Something that the protocol does not allow."""


@dataclass(frozen=True, slots=True)
class Check:
    """One check.

    Attributes:
        name: what holds, as a sentence.
        section: of the manual, that it stands on.
        moves: how the robot moves meanwhile; empty if it does not.
        body: does the check.
    """

    name: str
    section: str
    moves: str
    body: Callable[["Line"], None]


@dataclass(frozen=True, slots=True)
class Result:
    """How a check ended; `deviation` is empty if it passed."""

    name: str
    section: str
    deviation: str


@dataclass(frozen=True, slots=True)
class Report:
    """How all checks ended.

    Attributes:
        port: what was checked.
        results: in the order of the checks.
        skipped: names of the checks that would have moved the robot.
    """

    port: str
    results: tuple[Result, ...]
    skipped: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return not any(result.deviation for result in self.results)

    def text(self) -> str:
        """A page that a person can read."""
        failed = [result for result in self.results if result.deviation]
        lines = [
            f"{'FAIL' if result.deviation else 'ok  '}  {result.name} [{result.section}]"
            for result in self.results
        ]
        lines += [f"skip  {name} (moves the robot; asked for by --move)" for name in self.skipped]
        lines += [f"\n{result.name}\n    {result.deviation}" for result in failed]
        lines.append(f"\n{self.port}: {len(self.results) - len(failed)} passed, {len(failed)} failed")
        return "\n".join(lines)

    def json(self) -> str:
        """The same for programs."""
        return json.dumps({"passed": self.passed, **asdict(self)}, indent=2)


class Line:
    """A port of pyserial, and the port's own time."""

    def __init__(self, port: Any) -> None:
        self.port = port
        port.timeout = 1.0

    def ask(self, request: str, end: str = "\n") -> str:
        """The one reply to a line, without its ending; checks that it is one line and ends in CR LF."""
        self.send(request + end)
        return self.reply(request)

    def send(self, text: str) -> None:
        """Writes to the robot."""
        self.port.write(text.encode("latin-1"))

    def reply(self, request: str) -> str:
        """The next reply, without its ending."""
        line: bytes = self.port.read_until(b"\n")
        if not line:
            raise Deviation(f"no reply to {request!r} within {self.port.timeout} s")
        if not line.endswith(b"\r\n") or b"\r" in line[:-2]:
            raise Deviation(f"{request!r} was answered {line!r}; right is one line that ends in CR LF")
        if not line.isascii():
            raise Deviation(f"{request!r} was answered {line!r}; right is plain ASCII")
        return line[:-2].decode("ascii")

    def silent(self, why: str) -> None:
        """Checks that nothing comes."""
        data = self.read_for(SILENCE)
        if data:
            raise Deviation(f"{why}: {data!r} came; right is silence")

    def read_for(self, duration: float) -> bytes:
        """What comes within a time [s]."""
        before, self.port.timeout = self.port.timeout, duration
        try:
            return self.port.read(4096)
        finally:
            self.port.timeout = before

    def read_until_quiet(self, quiet: float) -> bytes:
        """What comes until nothing has come for a time [s]: a text of any number of lines."""
        told = b""
        while more := self.read_for(quiet):
            told += more
        return told

    def numbers(self, request: str, letter: str, count: int) -> list[int]:
        """The whole numbers of a reply, of which there must be so many."""
        answer = self.ask(request)
        head, *fields = answer.split(",")
        if head != letter or len(fields) != count:
            raise Deviation(f"{request!r} was answered {answer!r}; right is {letter!r} and {count} numbers")
        if not all(_NUMBER.fullmatch(field) for field in fields):
            raise Deviation(f"{request!r} was answered {answer!r}; right are plain whole numbers")
        return [int(field) for field in fields]

    def expect(self, request: str, reply: str, end: str = "\n") -> None:
        """Checks for one fixed reply."""
        answer = self.ask(request, end)
        if answer != reply:
            raise Deviation(f"{request + end!r} was answered {answer!r}; right is {reply!r}")

    def sleep(self, duration: float) -> None:
        """Waits in the port's own time [s]."""
        getattr(self.port, "sleep", time.sleep)(duration)

    def time(self) -> float:
        """The port's own time [s]."""
        time_ns = getattr(self.port, "time_ns", None)
        return (time.monotonic_ns() if time_ns is None else time_ns) / NS_PER_S


def conform(
    url: str, *, move: bool = False, baudrate: int = 9600, tell: Callable[[Check], None] | None = None
) -> Report:
    """Checks what is at the end of a port.

    Args:
        url: of the port.
        move: also run what moves the robot.
        baudrate: of the line.
        tell: is shown each check before it runs.

    Raises:
        PortError: the port cannot be opened.
    """
    from khep_twin.host import Khepera

    if baudrate < 1:
        raise PortError(f"baudrate = {baudrate}: right is the speed of the line, such as 9600")
    # What is broken may not even confirm the last stop; that is no reason to lose the report.
    with closing(Khepera(url, baudrate=baudrate)) as robot:
        return examine(Line(robot.port), url, move=move, tell=tell)


def examine(
    line: Line, name: str, *, move: bool = False, tell: Callable[[Check], None] | None = None
) -> Report:
    """Runs the checks on an open line."""
    results: list[Result] = []
    for check in checks(move):
        if tell is not None:
            tell(check)
        results.append(run_check(check, line))
    skipped = () if move else tuple(check.name for check in checks(True) if check.moves)
    return Report(name, tuple(results), skipped)


def checks(move: bool) -> Iterator[Check]:
    """All checks, with or without those that move the robot."""
    # Those that move the robot come behind the others, in one list.
    from khep_twin.lab.conformance.motion import ALL

    return (check for check in ALL if move or not check.moves)


def run_check(check: Check, line: Line) -> Result:
    """Runs one check on a quiet line, and leaves a quiet line behind."""
    deviation = ""
    try:
        line.port.reset_input_buffer()
        check.body(line)
        line.silent("after the last reply")
    except Deviation as error:
        deviation = str(error)
        # What a wrong answer left on the line is none of the next check's business.
        line.send("\n")
        line.read_for(0.3)
    except (serial.SerialException, OSError) as error:
        deviation = f"the port failed: {error}"
    return Result(check.name, check.section, deviation)
