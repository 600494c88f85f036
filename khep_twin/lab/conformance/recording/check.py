"""Contract of a check of a recording.

A check is a function that takes a `RecordedLine`, returns a `Verdict`, and has the decorator `check`. The
checks in `catalogue` are run.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.log.decoding import printable
from khep_twin.log.transcript import escape


@dataclass(frozen=True, slots=True)
class Finding:
    """Deviation of a robot at one time; its attributes are keys of the JSON report.

    Attributes:
        time_s: Time in the log [s].
        command: Command that was sent; empty if none was.
        found: Description of the reply.
        expected: Description of the expected reply.
    """

    time_s: float
    command: str
    found: str
    expected: str

    @property
    def text(self) -> str:
        """One line of a report."""
        prefix = f"{printable(self.command)}: " if self.command else ""
        return f"{self.time_s:.4f} s  {prefix}{self.found}; expected {self.expected}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a check.

    Attributes:
        n_checked: Number of replies, or of pairs of them, that were checked.
        findings: Deviations.
        note: Additional information, e.g. measured times.
    """

    n_checked: int
    findings: Sequence[Finding] = ()
    note: str = ""


@dataclass(frozen=True, slots=True)
class RecordingCheck:
    """One check.

    Attributes:
        name: Tested statement.
        section: Section of the manual; "assumed" if the manual leaves it open and the twin defines it.
        body: Function that runs the check.
    """

    name: str
    section: str
    body: Callable[[RecordedLine], Verdict]


def check(name: str, section: str) -> Callable[[Callable[[RecordedLine], Verdict]], RecordingCheck]:
    """Return a decorator that turns a function into a check; for the arguments see `RecordingCheck`."""
    return lambda body: RecordingCheck(name, section, body)


def finding(step: RecordedStep, observation: str, expected: str) -> Finding:
    """Return a finding at a step."""
    exchange = step.exchange
    time_ns = exchange.sent_ns if exchange.reply is None else exchange.reply_ns
    return Finding(time_ns / NS_PER_S, escape(exchange.command), observation, expected)


def wrong_reply(step: RecordedStep, expected: str) -> Finding:
    """Return a finding about the reply of a step."""
    return finding(step, step.reply_text, expected)


def judge(steps: Iterator[RecordedStep], deviation: Callable[[RecordedStep], Finding | None]) -> Verdict:
    """Return the verdict over steps, with the findings that `deviation` returns for them."""
    results = [deviation(step) for step in steps]
    return Verdict(len(results), [result for result in results if result is not None])
