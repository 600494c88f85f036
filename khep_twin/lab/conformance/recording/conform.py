"""Check of a recording: the replies of a robot or an emulator in a log, compared with the firmware's.

No commands are sent: only the commands in the log are checked.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from khep_twin.files.paths import StrPath
from khep_twin.lab.conformance.recording.catalogue import CHECKS
from khep_twin.lab.conformance.recording.check import Finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine, recorded_lines

MAX_SHOWN = 5
"""Largest number of findings per check in the text; the JSON report has all."""


@dataclass(frozen=True, slots=True)
class CheckedStatement:
    """Verdict of a check with its name and section; these attributes are keys of the JSON report."""

    name: str
    section: str
    seen: int
    findings: Sequence[Finding]
    note: str

    def text(self) -> str:
        """Return the lines of a report."""
        mark = "FAIL" if self.findings else "ok  " if self.seen else "none"
        counts = f"{len(self.findings)} of {self.seen}" if self.findings else str(self.seen)
        summary = f"{counts}{', ' + self.note if self.note else ''}" if self.seen or self.findings else ""
        lines = [f"{mark}  {self.name} [{self.section}]{': ' if summary else ''}{summary}"]
        lines += [f"        {finding.text}" for finding in self.findings[:MAX_SHOWN]]
        if (n_hidden := len(self.findings) - MAX_SHOWN) > 0:
            lines.append(f"        and {n_hidden} more")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class CheckedRobot:
    """Results of one robot: its name, a description with the ROM it was compared with, and the verdicts."""

    name: str
    text: str
    statements: Sequence[CheckedStatement]

    @property
    def passed(self) -> bool:
        """True if there are no findings."""
        return not any(statement.findings for statement in self.statements)


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """Results of all robots of a log."""

    log: str
    robots: Sequence[CheckedRobot]

    @property
    def passed(self) -> bool:
        """True if no robot has findings."""
        return all(robot.passed for robot in self.robots)

    def text(self) -> str:
        """Return the report as readable text."""
        lines: list[str] = []
        for robot in self.robots:
            lines += [robot.text, *(statement.text() for statement in robot.statements)]
            n_failed = sum(bool(statement.findings) for statement in robot.statements)
            n_unseen = sum(not statement.seen and not statement.findings for statement in robot.statements)
            n_passed = len(robot.statements) - n_failed - n_unseen
            counts = f"{n_passed} passed, {n_failed} failed, {n_unseen} not seen"
            lines.append(f"\n{self.log}, {robot.name}: {counts}\n")
        return "\n".join(lines).rstrip("\n")

    def json(self) -> str:
        """Return the report as JSON."""
        robots = [{"passed": robot.passed, **asdict(robot)} for robot in self.robots]
        return json.dumps({"passed": self.passed, "log": self.log, "robots": robots}, indent=2)


def conform_recording(path: StrPath) -> RecordingReport:
    """Check the replies of all robots of a log.

    Raises:
        LogError: The log is missing or incomplete, or has no serial data.
    """
    return RecordingReport(str(path), tuple(map(_check_line, recorded_lines(Path(path)))))


def _check_line(line: RecordedLine) -> CheckedRobot:
    verdicts = [(check, check.body(line)) for check in CHECKS]
    statements = tuple(
        CheckedStatement(check.name, check.section, verdict.n_checked, tuple(verdict.findings), verdict.note)
        for check, verdict in verdicts
    )
    return CheckedRobot(line.name, line.text, statements)
