"""Checks of a recording's versions and restarts."""

import re
from collections.abc import Iterator

from khep_twin.board.rom import ROMS
from khep_twin.clock import NEVER_NS, NS_PER_S
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, answered, check, finding, over
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import accepted, exactly
from khep_twin.log.exchanges import BANNER
from khep_twin.log.transcript import text_of

_REVISION = re.compile(r"Rev\. ([0-9.]+)")


@check("B reads the versions of the ROM, and always the same", "A, command B")
def versions(line: RecordedLine) -> Verdict:
    told: list[bytes] = []

    def deviation(step: RecordedStep) -> Finding | None:
        reply = step.exchange.reply or b""
        told.append(reply)
        if line.mode is not None:
            return exactly(step)
        if not re.fullmatch(rb"b,[0-9]+\.[0-9]+,[0-9]+\.[0-9]+", reply):
            return finding(step, answered(step), "one such as b,5.02,5.01")
        return None if reply == told[0] else finding(step, answered(step), f"{text_of(told[0])} as before")

    verdict = over((step for step, _ in accepted(line) if step.exchange.letter == "B"), deviation)
    return Verdict(verdict.seen, verdict.findings, text_of(told[0]) if told else "")


@check("a restart shows the banner of the ROM", "3.2.1, tool restart")
def banner(line: RecordedLine) -> Verdict:
    findings: list[Finding] = []
    rom, seen, alone_s = ROMS[line.rom], 0, list[float]()
    versions = {step.exchange.reply for step, _ in accepted(line) if step.exchange.letter == "B"}
    for place, step in enumerate(line.steps):
        asked = step.exchange.command.split() == [b"restart"] and step.exchange.reply is not None
        if not asked and not step.restarts:
            continue
        seen += 1
        if not asked:
            alone_s.append(step.exchange.heard_ns / NS_PER_S)
        if not step.restarts:
            findings.append(finding(step, answered(step), f"a line with {text_of(BANNER)!r}"))
            continue
        told = " ".join(text_of(each) for each in _output(line, place))
        wanted = " ".join(rom.banner)
        if line.mode is not None and not told.startswith(wanted):
            findings.append(finding(step, f"the banner {told}", wanted))
        elif (revision := _REVISION.search(told)) is not None and not all(
            revision[1].encode() in (version or b"").split(b",") for version in versions
        ):
            found = f"the banner of {revision[0]}, and {text_of(min(versions, key=str) or b'')} to B"
            findings.append(finding(step, found, "the same versions"))
    note = f"by itself at {', '.join(f'{each:.2f}' for each in alone_s[:3])} s" if alone_s else ""
    return Verdict(seen, findings, note)


def _output(line: RecordedLine, place: int) -> Iterator[bytes]:
    """Yield the lines of a banner that begins at a step."""
    first = line.steps[place].exchange
    source = first.command or first.reply
    yield first.reply or b""
    # Outputs of tools before it, and commands of the next banner, may be between: steps are in their order.
    later = [step.exchange for step in line.steps[place + 1 :]]
    restarts = [each.heard_ns for each in later if each.command == b"restart" and each.reply is not None]
    end_ns = min(restarts, default=NEVER_NS)
    for each in later:
        if not each.command and each.output_of == source and first.heard_ns <= each.heard_ns < end_ns:
            yield each.reply or b""
