"""Checks of a recording's replies: syntax and errors."""

import re
from collections.abc import Iterator

from khep_twin.board.protocol import (
    COMMAND_NOT_FOUND,
    PROTOCOL_ERROR,
    Command,
    Malformed,
    Tool,
    TurretMessage,
)
from khep_twin.board.radio import BUSY
from khep_twin.lab.conformance.recording.board_model import RecordedStep, is_error
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding, judge, wrong_reply
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.log.transcript import escape
from khep_twin.units import COUNTS_LIMIT, N_SENSORS, RADIO_NUMBER

MAX_SPEED = 180
"""Largest speed of a wheel [pulses/10 ms] (assumed: 155 without load on full cells, plus 15 %)."""

_RANGES = {
    "E": (-MAX_SPEED, MAX_SPEED),
    "H": (-(2**31), 2**31 - 1),
    "I": (0, COUNTS_LIMIT),
    "N": (0, COUNTS_LIMIT),
    "O": (0, COUNTS_LIMIT),
    "R": (0, 255),
}
"""Smallest and largest value in each reply (manual, appendix A)."""

_INTEGER = re.compile(rb"-?(0|[1-9][0-9]*)")
_END = b"\r\n"
_REFUSAL_START = b"z,"

_N_VALUES = {"E": 2, "H": 2, "K": 6, "N": N_SENSORS, "O": N_SENSORS}
"""Number of values of each reply."""

Reading = tuple[RecordedStep, tuple[int, ...]]
"""A step and the values of its reply."""


def read_values(line: RecordedLine, letters: str) -> Iterator[Reading]:
    """Yield the steps of some commands whose replies have the right number of values."""
    for step in line.steps:
        values = step.exchange.values if step.exchange.letter in letters else None
        if values is not None and len(values) == _N_VALUES[step.exchange.letter]:
            yield step, values


def _with_replies(
    line: RecordedLine, kind: type[Command] | type[Malformed] | type[Tool] | type[TurretMessage]
) -> Iterator[RecordedStep]:
    """Return the steps with a reply and a request of one kind."""
    return (step for step in line.steps if isinstance(step.request, kind) and step.exchange.reply is not None)


def accepted_steps(line: RecordedLine) -> Iterator[tuple[RecordedStep, bytes]]:
    """Yield steps and replies of commands that both the firmware and the robot accept."""
    for step in _with_replies(line, Command):
        reply = step.exchange.reply or b""
        if not is_error(step.expected) and not is_error(reply):
            yield step, reply


# Grammar -------------------------------------------------------------------------------------------------


@check("every command is answered", "3.2")
def answers(line: RecordedLine) -> Verdict:
    commands = (step for step in line.steps if step.exchange.command and not step.exchange.abandoned)
    return judge(
        commands, lambda step: finding(step, "no reply", "one") if step.exchange.reply is None else None
    )


@check("the robot sends nothing unsolicited", "3.2")
def unasked_lines(line: RecordedLine) -> Verdict:
    findings: list[Finding] = []
    last_command, n_lines = b"", 0
    for step in line.steps:
        exchange = step.exchange
        n_lines += exchange.reply is not None
        if exchange.command:
            last_command = exchange.command
        elif not exchange.output_of and not step.restarts:
            note = ", an echo of the command" if exchange.reply == last_command else ""
            findings.append(
                finding(step, f"{step.reply_text[4:].replace('reply', 'line', 1)}{note}", "silence")
            )
    return Verdict(n_lines, findings)


@check("a reply starts with its command's letter", "A")
def letters(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        letter = step.exchange.letter.lower()
        reply_letter = (step.exchange.reply or b"").partition(b",")[0]
        return None if reply_letter == letter.encode() else wrong_reply(step, f"{letter!r} first")

    return judge((step for step, _ in accepted_steps(line)), deviation)


@check("a reply has as many plain integers as its command asks for", "A")
def plain_integers(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        n_values = step.expected.count(b",")
        fields = (step.exchange.reply or b"").split(b",")[1:]
        if len(fields) == n_values and all(map(_INTEGER.fullmatch, fields)):
            return None
        return wrong_reply(step, f"{n_values} plain integer{'s' * (n_values != 1)}" if n_values else "none")

    return judge((step for step, _ in accepted_steps(line) if step.exchange.letter != "B"), deviation)


@check("values are in the range of their command", "A")
def ranges(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        low, high = _RANGES[step.exchange.letter]
        outlier = next((value for value in step.exchange.values or () if not low <= value <= high), None)
        observation = f"{outlier} in {step.reply_text}"
        return None if outlier is None else finding(step, observation, f"{low} to {high}")

    steps = (step for step, _ in accepted_steps(line) if step.exchange.letter in _RANGES)
    return judge((step for step in steps if step.exchange.values), deviation)


@check("a valid command is not refused", "A")
def refusals(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        reply = step.exchange.reply or b""
        return wrong_reply(step, escape(step.expected[:-2])) if is_error(reply) else None

    valid_steps = (step for step in _with_replies(line, Command) if not is_error(step.expected))
    return judge(valid_steps, deviation)


def check_exact(step: RecordedStep) -> Finding | None:
    """Return a finding unless a reply is the expected one to the last byte."""
    if (step.exchange.reply or b"") + _END == step.expected:
        return None
    return wrong_reply(step, escape(step.expected[:-2]))


@check("missing, surplus or wrong parameters are a protocol error", "A")
def wrong_parameters(line: RecordedLine) -> Verdict:
    malformed = _with_replies(line, Malformed)
    return judge((step for step in malformed if step.expected == PROTOCOL_ERROR), check_exact)


@check("an unknown word is answered with Command not found", "3.2")
def unknown_words(line: RecordedLine) -> Verdict:
    answered_steps = (
        step for step in line.steps if step.exchange.reply is not None and step.request is not None
    )
    return judge((step for step in answered_steps if step.expected == COMMAND_NOT_FOUND), check_exact)


@check("an LED, channel or address that does not exist is refused", "A")
def missing_devices(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        reply = step.exchange.reply or b""
        return None if reply.startswith(_REFUSAL_START) else wrong_reply(step, "a line that starts with 'z,'")

    return judge((step for step in _with_replies(line, Command) if is_error(step.expected)), deviation)


@check("a turret answers under its number, an absent one is refused", "A, command T")
def turrets(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep) -> Finding | None:
        request, reply = step.request, step.exchange.reply or b""
        assert isinstance(request, TurretMessage)
        letter = request.message[:1].lower()
        match = re.fullmatch(rb"t,%d,%b(,-?[0-9]+)*" % (request.turret, re.escape(letter)), reply)
        if line.turrets is None:
            if match or reply.startswith(_REFUSAL_START):
                return None
            return wrong_reply(step, f"'t,{request.turret},{escape(letter)}…' or 'z,…'")
        if request.turret == RADIO_NUMBER and letter == b"s" and reply == BUSY[: -len(_END)]:
            # Whether a radio is still sending depends on other robots.
            return check_exact(step) if is_error(step.expected) else None
        if is_error(step.expected) or step.expected.count(b",") == 2:
            return check_exact(step)
        is_similar = match and reply.count(b",") == step.expected.count(b",")
        return None if is_similar else wrong_reply(step, f"one such as {escape(step.expected[:-2])}")

    return judge(_with_replies(line, TurretMessage), deviation)


@check("a tool is answered in lines", "3.2.1")
def tools(line: RecordedLine) -> Verdict:
    steps = (step for step in _with_replies(line, Tool) if step.expected != COMMAND_NOT_FOUND)
    return judge(
        steps, lambda step: check_exact(step) if step.exchange.reply == COMMAND_NOT_FOUND[:-2] else None
    )
