"""Check of a recording: the replies of a robot or an emulator in a log, compared with the board's model.

Nothing is sent: what the hosts of the log did not ask is not seen. Each check is a function of a
`RecordedLine`, which returns what it has seen and where that deviates; `reply_checks`,
`version_checks`, `time_checks`, `wheel_checks`, `status_checks` and `sensor_checks` have them.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.board_model import RecordedStep
from khep_twin.lab.conformance.recorded_line import RecordedLine, recorded_lines
from khep_twin.log.decoding import shown
from khep_twin.log.transcript import text_of

_Body = Callable[[RecordedLine], "Verdict"]

MOST_SHOWN = 5
"""Most findings of a check that are shown; the JSON has all."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One place where a robot deviates.

    Attributes:
        time_s: Time in the log [s].
        command: Command that was sent; empty if none was.
        found: What was given.
        expected: What was expected.
    """

    time_s: float
    command: str
    found: str
    expected: str

    @property
    def text(self) -> str:
        """One line."""
        asked = f"{shown(self.command)}: " if self.command else ""
        return f"{self.time_s:.4f} s  {asked}{self.found}; expected {self.expected}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a check.

    Attributes:
        seen: Number of replies, or of pairs of them, that were checked.
        findings: Deviations.
        note: Further words, such as measured times.
    """

    seen: int
    findings: Sequence[Finding] = ()
    note: str = ""


@dataclass(frozen=True, slots=True)
class RecordingCheck:
    """One check.

    Attributes:
        name: Tested statement.
        section: Section of the manual; "assumed" where it is silent and the twin's decision counts.
        body: Function that runs the check.
    """

    name: str
    section: str
    body: Callable[[RecordedLine], Verdict]


@dataclass(frozen=True, slots=True)
class CheckedStatement:
    """Verdict of a check with its name and section."""

    name: str
    section: str
    seen: int
    findings: Sequence[Finding]
    note: str

    def text(self) -> str:
        """Return the lines of a report."""
        mark = "FAIL" if self.findings else "ok  " if self.seen else "none"
        counted = f"{len(self.findings)} of {self.seen}" if self.findings else str(self.seen)
        told = f"{counted}{', ' + self.note if self.note else ''}" if self.seen or self.findings else ""
        lines = [f"{mark}  {self.name} [{self.section}]{': ' if told else ''}{told}"]
        lines += [f"        {finding.text}" for finding in self.findings[:MOST_SHOWN]]
        if (more := len(self.findings) - MOST_SHOWN) > 0:
            lines.append(f"        and {more} more")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class CheckedRobot:
    """Results of one robot: its name, what it was compared with, and the verdict of each check."""

    name: str
    text: str
    statements: Sequence[CheckedStatement]

    @property
    def passed(self) -> bool:
        """True if nothing deviates."""
        return not any(each.findings for each in self.statements)


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """Results of all robots of a log."""

    log: str
    robots: Sequence[CheckedRobot]

    @property
    def passed(self) -> bool:
        """True if no robot deviates."""
        return all(robot.passed for robot in self.robots)

    def text(self) -> str:
        """Return the report as readable text."""
        lines: list[str] = []
        for robot in self.robots:
            lines += [robot.text, *(each.text() for each in robot.statements)]
            failed = sum(bool(each.findings) for each in robot.statements)
            unseen = sum(not each.seen and not each.findings for each in robot.statements)
            passed = len(robot.statements) - failed - unseen
            lines.append(f"\n{self.log}, {robot.name}: {passed} passed, {failed} failed, {unseen} not seen\n")
        return "\n".join(lines).rstrip("\n")

    def json(self) -> str:
        """Return the report as JSON."""
        robots = [{"passed": robot.passed, **asdict(robot)} for robot in self.robots]
        return json.dumps({"passed": self.passed, "log": self.log, "robots": robots}, indent=2)


def conform_recording(path: Path) -> RecordingReport:
    """Check the replies of all robots of a log.

    Raises:
        LogError: There is no log, it is not whole, or nothing crossed a line in it.
    """
    return RecordingReport(str(path), tuple(map(_checked, recorded_lines(path))))


def finding(step: RecordedStep, found: str, expected: str) -> Finding:
    """Return a finding at a step."""
    each = step.exchange
    time_ns = each.sent_ns if each.reply is None else each.heard_ns
    return Finding(time_ns / NS_PER_S, text_of(each.command), found, expected)


def answered(step: RecordedStep) -> str:
    """Return the words for a step's reply."""
    reply = step.exchange.reply
    return "no reply" if reply is None else f"the reply {shown(text_of(reply))}"


def _checked(line: RecordedLine) -> CheckedRobot:
    from khep_twin.lab.conformance import (
        reply_checks,
        sensor_checks,
        status_checks,
        time_checks,
        version_checks,
        wheel_checks,
    )

    modules = (reply_checks, version_checks, time_checks, wheel_checks, status_checks, sensor_checks)
    statements: list[CheckedStatement] = []
    for check in (check for module in modules for check in module.ALL):
        verdict = check.body(line)
        statements.append(
            CheckedStatement(check.name, check.section, verdict.seen, tuple(verdict.findings), verdict.note)
        )
    return CheckedRobot(line.name, line.text, tuple(statements))


def adder(checks: list[RecordingCheck]) -> Callable[[str, str], Callable[[_Body], _Body]]:
    """Return a decorator with name and section that adds a function to a list of checks."""

    def check(name: str, section: str) -> Callable[[_Body], _Body]:
        def add(body: _Body) -> _Body:
            checks.append(RecordingCheck(name, section, body))
            return body

        return add

    return check
