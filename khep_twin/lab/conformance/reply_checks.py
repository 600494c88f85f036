"""Checks of a recording's replies: their form, errors and times. See `recording`."""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np

from khep_twin.board.protocol import (
    COMMAND_NOT_FOUND,
    PROTOCOL_ERROR,
    Command,
    Malformed,
    Tool,
    TurretMessage,
)
from khep_twin.board.rom import ROMS
from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recorded_line import RecordedLine, Step, is_error
from khep_twin.lab.conformance.recording import (
    Finding,
    RecordingCheck,
    Verdict,
    adder,
    answered,
    finding,
)
from khep_twin.log.exchanges import BANNER
from khep_twin.log.transcript import text_of
from khep_twin.units import COUNTS_LIMIT

ALL: list[RecordingCheck] = []
"""All checks; `check` adds to them."""

check = adder(ALL)

SPEED_MOST = 180
"""Fastest speed of a wheel [pulses/10 ms] (assumed: 155 without load on full cells, and 15 % more)."""

_RANGES = {
    "E": (-SPEED_MOST, SPEED_MOST),
    "H": (-(2**31), 2**31 - 1),
    "I": (0, COUNTS_LIMIT),
    "N": (0, COUNTS_LIMIT),
    "O": (0, COUNTS_LIMIT),
    "R": (0, 255),
}
"""Least and greatest value of each reply's (manual, appendix A)."""

_INTEGER = re.compile(rb"-?(0|[1-9][0-9]*)")
_REVISION = re.compile(r"Rev\. ([0-9.]+)")
_END = b"\r\n"
_REFUSED = b"z,"


def _with_replies(
    line: RecordedLine, kind: type[Command] | type[Malformed] | type[Tool] | type[TurretMessage]
) -> Iterator[Step]:
    """Yield the steps with a reply and a request of one kind."""
    return (step for step in line.steps if isinstance(step.request, kind) and step.exchange.reply is not None)


def _accepted(line: RecordedLine) -> Iterator[tuple[Step, bytes]]:
    """Yield the steps, with their replies, of commands that board's code and robot accept."""
    for step in _with_replies(line, Command):
        reply = step.exchange.reply or b""
        if not is_error(step.expected) and not is_error(reply):
            yield step, reply


def _over(steps: Iterator[Step], deviation: Callable[[Step], Finding | None]) -> Verdict:
    """Return the verdict over steps of which each may deviate."""
    found = [deviation(step) for step in steps]
    return Verdict(len(found), [each for each in found if each is not None])


# Grammar -------------------------------------------------------------------------------------------------


@check("every command is answered", "3.2")
def _answers(line: RecordedLine) -> Verdict:
    asked = (step for step in line.steps if step.exchange.command and not step.exchange.abandoned)
    return _over(
        asked, lambda step: finding(step, "no reply", "one") if step.exchange.reply is None else None
    )


@check("the robot sends nothing unasked", "3.2")
def _silence(line: RecordedLine) -> Verdict:
    findings: list[Finding] = []
    last, lines = b"", 0
    for step in line.steps:
        each = step.exchange
        lines += each.reply is not None
        if each.command:
            last = each.command
        elif not each.output_of and not step.restarts:
            what = ", an echo of the command" if each.reply == last else ""
            findings.append(
                finding(step, f"{answered(step)[4:].replace('reply', 'line', 1)}{what}", "silence")
            )
    return Verdict(lines, findings)


@check("a reply begins with its command's letter", "A")
def _letters(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        letter = step.exchange.letter.lower()
        head = (step.exchange.reply or b"").partition(b",")[0]
        return None if head == letter.encode() else finding(step, answered(step), f"{letter!r} first")

    return _over((step for step, _ in _accepted(line)), deviation)


@check("a reply has as many plain integers as its command asks for", "A")
def _values(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        wanted = step.expected.count(b",")
        fields = (step.exchange.reply or b"").split(b",")[1:]
        if len(fields) == wanted and all(map(_INTEGER.fullmatch, fields)):
            return None
        return finding(
            step, answered(step), f"{wanted} plain integer{'s' * (wanted != 1)}" if wanted else "none"
        )

    return _over((step for step, _ in _accepted(line) if step.exchange.letter != "B"), deviation)


@check("values are in the range of their command", "A")
def _ranges(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        low, high = _RANGES[step.exchange.letter]
        wrong = next((value for value in step.exchange.values or () if not low <= value <= high), None)
        return None if wrong is None else finding(step, f"{wrong} in {answered(step)}", f"{low} to {high}")

    valued = (step for step, _ in _accepted(line) if step.exchange.letter in _RANGES)
    return _over((step for step in valued if step.exchange.values), deviation)


@check("a valid command is not refused", "A")
def _refusals(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        reply = step.exchange.reply or b""
        return finding(step, answered(step), f"{text_of(step.expected[:-2])}") if is_error(reply) else None

    valid = (step for step in _with_replies(line, Command) if not is_error(step.expected))
    return _over(valid, deviation)


def _exactly(step: Step) -> Finding | None:
    if (step.exchange.reply or b"") + _END == step.expected:
        return None
    return finding(step, answered(step), text_of(step.expected[:-2]))


@check("missing, surplus or wrong parameters are a protocol error", "A")
def _wrong_parameters(line: RecordedLine) -> Verdict:
    return _over(
        (step for step in _with_replies(line, Malformed) if step.expected == PROTOCOL_ERROR), _exactly
    )


@check("an unknown word is answered with Command not found", "3.2")
def _unknown_words(line: RecordedLine) -> Verdict:
    unknown = (step for step in line.steps if step.exchange.reply is not None and step.request is not None)
    return _over((step for step in unknown if step.expected == COMMAND_NOT_FOUND), _exactly)


@check("an LED, channel or address that does not exist is refused", "A")
def _nothing_there(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        reply = step.exchange.reply or b""
        return (
            None
            if reply.startswith(_REFUSED)
            else finding(step, answered(step), "a line that starts with 'z,'")
        )

    return _over((step for step in _with_replies(line, Command) if is_error(step.expected)), deviation)


@check("a turret answers under its number, an absent one is refused", "A, command T")
def _turrets(line: RecordedLine) -> Verdict:
    def deviation(step: Step) -> Finding | None:
        request, reply = step.request, step.exchange.reply or b""
        assert isinstance(request, TurretMessage)
        letter = request.message[:1].lower()
        own = re.fullmatch(rb"t,%d,%b(,-?[0-9]+)*" % (request.turret, re.escape(letter)), reply)
        if line.turrets is None:
            if own or reply.startswith(_REFUSED):
                return None
            return finding(step, answered(step), f"'t,{request.turret},{text_of(letter)}…' or 'z,…'")
        if is_error(step.expected) or step.expected.count(b",") == 2:
            return _exactly(step)
        alike = own and reply.count(b",") == step.expected.count(b",")
        return None if alike else finding(step, answered(step), f"one such as {text_of(step.expected[:-2])}")

    return _over(_with_replies(line, TurretMessage), deviation)


@check("a tool is answered in lines", "3.2.1")
def _tools(line: RecordedLine) -> Verdict:
    known = (step for step in _with_replies(line, Tool) if step.expected != COMMAND_NOT_FOUND)
    return _over(
        known, lambda step: _exactly(step) if step.exchange.reply == COMMAND_NOT_FOUND[:-2] else None
    )


# Versions and restarts -----------------------------------------------------------------------------------


@check("B reads the versions of the ROM, and always the same", "A, command B")
def _versions(line: RecordedLine) -> Verdict:
    told: list[bytes] = []

    def deviation(step: Step) -> Finding | None:
        reply = step.exchange.reply or b""
        told.append(reply)
        if line.mode is not None:
            return _exactly(step)
        if not re.fullmatch(rb"b,[0-9]+\.[0-9]+,[0-9]+\.[0-9]+", reply):
            return finding(step, answered(step), "one such as b,5.02,5.01")
        return None if reply == told[0] else finding(step, answered(step), f"{text_of(told[0])} as before")

    verdict = _over((step for step, _ in _accepted(line) if step.exchange.letter == "B"), deviation)
    return Verdict(verdict.seen, verdict.findings, text_of(told[0]) if told else "")


@check("a restart shows the banner of the ROM", "3.2.1, tool restart")
def _banner(line: RecordedLine) -> Verdict:
    findings: list[Finding] = []
    rom, seen, alone_s = ROMS[line.rom], 0, list[float]()
    versions = {step.exchange.reply for step, _ in _accepted(line) if step.exchange.letter == "B"}
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
    later = (each.exchange for each in line.steps[place + 1 :] if not each.exchange.command)
    for each in later:
        if each.output_of != source:
            return
        yield each.reply or b""


# Time ----------------------------------------------------------------------------------------------------

_SHORTEST = 10 / 11
"""Shortest time of a byte, with one stop bit, by that with two."""

_WALL_CLOCK_NS = 3_000_000
"""Error of a relay's times (assumed; they are those of its own reads and writes) [ns]."""

FIRST_BYTE_NS = {True: 10_000_000, False: 30_000_000}
"""Longest wait for a reply beyond its time on the line [ns]: of a twin, and of a relay, with the delays of an
adapter (16 ms) and a scheduler (assumed; hosts bear 50 ms)."""

_LATE_SHARE = 0.05
"""Share of a command's late replies that a relay's machine may have caused (assumed)."""


def _timed(line: RecordedLine) -> Iterator[Step]:
    """Yield the steps whose reply is one line, of which the line's speed is known."""
    for step in line.steps:
        asked = isinstance(step.request, (Command, Malformed, TurretMessage))
        if asked and step.exchange.reply is not None and step.byte_ns:
            yield step


@check("no reply ends before command and reply have crossed the line", "3.2")
def _early(line: RecordedLine) -> Verdict:
    slack_ns = 0 if line.simulated else _WALL_CLOCK_NS

    def deviation(step: Step) -> Finding | None:
        length = len(step.exchange.reply or b"") + 2
        least_ns = (step.arrived_ns - step.exchange.sent_ns + length * step.byte_ns) * _SHORTEST
        took_ns = step.exchange.heard_ns - step.exchange.sent_ns
        if took_ns + slack_ns >= int(least_ns):
            return None
        return finding(
            step, f"{answered(step)} after {took_ns / 1e6:.1f} ms", f"at least {least_ns / 1e6:.1f} ms"
        )

    return _over(_timed(line), deviation)


@check("replies begin within 10 ms, through a relay within 30 ms", "3.2")
def _late(line: RecordedLine) -> Verdict:
    most_ns, busy_ns = FIRST_BYTE_NS[line.simulated], 0
    waits: dict[str, list[tuple[int, Step]]] = defaultdict(list)
    timed = {id(step) for step in _timed(line)}
    # Replies and banners wait for each other.
    for step in sorted(line.steps, key=lambda step: step.exchange.heard_ns):
        length = len(step.exchange.reply or b"") + 2
        if id(step) in timed and not step.exchange.abandoned:
            wait_ns = step.exchange.heard_ns - max(step.arrived_ns, busy_ns) - length * step.byte_ns
            waits[step.exchange.letter].append((wait_ns, step))
        busy_ns = step.exchange.heard_ns
    findings: list[Finding] = []
    for of_letter in waits.values():
        late = [
            finding(step, f"{answered(step)} {wait_ns / 1e6:.0f} ms late", f"at most {most_ns / 1e6:.0f} ms")
            for wait_ns, step in of_letter
            if wait_ns > most_ns
        ]
        if line.simulated or len(late) > max(_LATE_SHARE * len(of_letter), 2):
            findings += late
    every = [wait_ns / 1e6 for of_letter in waits.values() for wait_ns, _ in of_letter]
    if not every:
        return Verdict(0)
    middle, most, last = np.quantile(every, [0.5, 0.95, 1.0]).clip(0).tolist()
    note = f"half within {middle:.1f} ms, 95 % within {most:.1f} ms, all within {last:.1f} ms"
    return Verdict(len(every), sorted(findings, key=lambda each: each.time_s), note)
