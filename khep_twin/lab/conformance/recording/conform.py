"""Check of a recording: the replies of a robot or an emulator in a log, compared with the board's model.

Nothing is sent: what the hosts of the log did not ask is not seen.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from khep_twin.files.paths import StrPath
from khep_twin.lab.conformance.recording.catalogue import CHECKS
from khep_twin.lab.conformance.recording.check import Finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine, recorded_lines

MOST_SHOWN = 5
"""Most findings of a check that are shown; the JSON has all."""


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


def conform_recording(path: StrPath) -> RecordingReport:
    """Check the replies of all robots of a log.

    Raises:
        LogError: There is no log, it is not whole, or nothing crossed a line in it.
    """
    return RecordingReport(str(path), tuple(map(_checked, recorded_lines(Path(path)))))


def _checked(line: RecordedLine) -> CheckedRobot:
    statements: list[CheckedStatement] = []
    for check in CHECKS:
        verdict = check.body(line)
        statements.append(
            CheckedStatement(check.name, check.section, verdict.seen, tuple(verdict.findings), verdict.note)
        )
    return CheckedRobot(line.name, line.text, tuple(statements))
