"""Checks of a recording's versions and restarts."""

import re
from collections.abc import Iterator

from khep_twin.board.rom import ROMS
from khep_twin.clock import NEVER_NS, NS_PER_S
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding, judge, wrong_reply
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import accepted_steps, check_exact
from khep_twin.log.exchanges import BANNER
from khep_twin.log.transcript import escape

_REVISION = re.compile(r"Rev\. ([0-9.]+)")


@check("B reads the versions of the ROM, which never change", "A, command B")
def versions(line: RecordedLine) -> Verdict:
    replies: list[bytes] = []

    def deviation(step: RecordedStep) -> Finding | None:
        reply = step.exchange.reply or b""
        replies.append(reply)
        if line.mode is not None:
            return check_exact(step)
        if not re.fullmatch(rb"b,[0-9]+\.[0-9]+,[0-9]+\.[0-9]+", reply):
            return wrong_reply(step, "one such as b,5.02,5.01")
        return None if reply == replies[0] else wrong_reply(step, f"{escape(replies[0])} as before")

    verdict = judge((step for step, _ in accepted_steps(line) if step.exchange.letter == "B"), deviation)
    return Verdict(verdict.n_checked, verdict.findings, escape(replies[0]) if replies else "")


@check("a restart shows the banner of the ROM", "3.2.1, tool restart")
def banner(line: RecordedLine) -> Verdict:
    findings: list[Finding] = []
    rom, n_checked, unasked_s = ROMS[line.rom], 0, list[float]()
    versions = {step.exchange.reply for step, _ in accepted_steps(line) if step.exchange.letter == "B"}
    for index, step in enumerate(line.steps):
        is_command = step.exchange.command.split() == [b"restart"] and step.exchange.reply is not None
        if not is_command and not step.restarts:
            continue
        n_checked += 1
        if not is_command:
            unasked_s.append(step.exchange.reply_ns / NS_PER_S)
        if not step.restarts:
            findings.append(wrong_reply(step, f"a line with {escape(BANNER)!r}"))
            continue
        output = " ".join(escape(row) for row in _output(line, index))
        expected = " ".join(rom.banner)
        if line.mode is not None and not output.startswith(expected):
            findings.append(finding(step, f"the banner {output}", expected))
        elif (revision := _REVISION.search(output)) is not None and not all(
            revision[1].encode() in (version or b"").split(b",") for version in versions
        ):
            observation = f"the banner of {revision[0]}, and {escape(min(versions, key=str) or b'')} to B"
            findings.append(finding(step, observation, "the same versions"))
    note = f"unsolicited at {', '.join(f'{time_s:.2f}' for time_s in unasked_s[:3])} s" if unasked_s else ""
    return Verdict(n_checked, findings, note)


def _output(line: RecordedLine, index: int) -> Iterator[bytes]:
    """Yield the lines of a banner whose first line is at a step."""
    first = line.steps[index].exchange
    source = first.command or first.reply
    yield first.reply or b""
    # Steps are in the order of commands: outputs of earlier tools and later restarts may be in between.
    later = [step.exchange for step in line.steps[index + 1 :]]
    restarts = [other.reply_ns for other in later if other.command == b"restart" and other.reply is not None]
    end_ns = min(restarts, default=NEVER_NS)
    for other in later:
        if not other.command and other.output_of == source and first.reply_ns <= other.reply_ns < end_ns:
            yield other.reply or b""
