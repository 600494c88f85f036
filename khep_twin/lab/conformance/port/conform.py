"""Conformance of a robot or twin at a port to the Khepera's serial protocol.

One catalogue of checks for twin and robot, each with the section of the manual (Khepera User Manual 5.02)
that it tests. Checks that move the robot are optional.
"""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass

from khep_twin.errors import PORT_FAILURES, PortError
from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.catalogue import CHECKS
from khep_twin.lab.conformance.port.check import Check, CheckedPort, Deviation


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


def conform(url: str, *, move: bool = False, baudrate: int = 9600) -> ConformanceReport:
    """Check the robot or twin at a port; with `move` also by the checks that move the robot.

    Raises:
        PortError: The port cannot be opened.
    """
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
    return (check for check in CHECKS if move or not check.moves)


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
