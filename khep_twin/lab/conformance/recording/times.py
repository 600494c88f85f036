"""Checks of a recording's times: when replies begin and end, by the speed of the line."""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from khep_twin.board.protocol import Command, Malformed, TurretMessage
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, answered, check, finding, over
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine

_SHORTEST = 10 / 11
"""Shortest time of a byte, with one stop bit, by that with two."""

_WALL_CLOCK_NS = 3_000_000
"""Error of a relay's times (assumed; they are those of its own reads and writes) [ns]."""

FIRST_BYTE_NS = {True: 10_000_000, False: 30_000_000}
"""Longest wait for a reply beyond its time on the line [ns]: of a twin, and of a relay, with the delays of an
adapter (16 ms) and a scheduler (assumed; hosts bear 50 ms)."""

_LATE_SHARE = 0.05
"""Share of a command's late replies that a relay's machine may have caused (assumed)."""


def _timed(line: RecordedLine) -> Iterator[RecordedStep]:
    """Yield the steps whose reply is one line, of which the line's speed is known."""
    for step in line.steps:
        asked = isinstance(step.request, (Command, Malformed, TurretMessage))
        if asked and step.exchange.reply is not None and step.byte_ns:
            yield step


@check("no reply ends before command and reply have crossed the line", "3.2")
def too_early(line: RecordedLine) -> Verdict:
    slack_ns = 0 if line.simulated else _WALL_CLOCK_NS

    def deviation(step: RecordedStep) -> Finding | None:
        length = len(step.exchange.reply or b"") + 2
        least_ns = (step.arrived_ns - step.exchange.sent_ns + length * step.byte_ns) * _SHORTEST
        took_ns = step.exchange.heard_ns - step.exchange.sent_ns
        if took_ns + slack_ns >= int(least_ns):
            return None
        return finding(
            step, f"{answered(step)} after {took_ns / 1e6:.1f} ms", f"at least {least_ns / 1e6:.1f} ms"
        )

    return over(_timed(line), deviation)


@check("replies begin within 10 ms, through a relay within 30 ms", "3.2")
def too_late(line: RecordedLine) -> Verdict:
    most_ns, busy_ns = FIRST_BYTE_NS[line.simulated], 0
    waits: dict[str, list[tuple[int, RecordedStep]]] = defaultdict(list)
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
