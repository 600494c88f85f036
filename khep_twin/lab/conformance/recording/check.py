"""Contract of a check of a recording.

A check is a function of a `RecordedLine`, under the decorator `check`, which returns what it has seen and
where that deviates. The checks of `catalogue` are those that run.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.log.decoding import shown
from khep_twin.log.transcript import text_of


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


def check(name: str, section: str) -> Callable[[Callable[[RecordedLine], Verdict]], RecordingCheck]:
    """Return a decorator that makes a check of a function; the arguments are those of `RecordingCheck`."""
    return lambda body: RecordingCheck(name, section, body)


def finding(step: RecordedStep, found: str, expected: str) -> Finding:
    """Return a finding at a step."""
    each = step.exchange
    time_ns = each.sent_ns if each.reply is None else each.heard_ns
    return Finding(time_ns / NS_PER_S, text_of(each.command), found, expected)


def answered(step: RecordedStep) -> str:
    """Return the words for a step's reply."""
    reply = step.exchange.reply
    return "no reply" if reply is None else f"the reply {shown(text_of(reply))}"


def over(steps: Iterator[RecordedStep], deviation: Callable[[RecordedStep], Finding | None]) -> Verdict:
    """Return the verdict over steps of which each may deviate."""
    found = [deviation(step) for step in steps]
    return Verdict(len(found), [each for each in found if each is not None])
