"""Checks of a recording's times: when replies start and end, by the baud rate of the line."""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from khep_twin.board.protocol import Command, Malformed, TurretMessage
from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding, judge
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine

_MIN_BYTE_RATIO = 10 / 11
"""Time of a byte with one stop bit, relative to that with two."""
_WALL_CLOCK_NS = 3_000_000
"""Error of a relay's times, which are those of its reads and writes (assumed) [ns]."""

FIRST_BYTE_NS = {True: 10_000_000, False: 30_000_000}
"""Longest latency of a reply without its transmission [ns]: of a twin, and of a relay, with the delays of an
adapter (16 ms) and a scheduler (assumed; hosts tolerate 50 ms)."""

_LATE_SHARE = 0.05
"""Largest share of a command's late replies due to the relay's computer (assumed)."""


def _one_line_steps(line: RecordedLine) -> Iterator[RecordedStep]:
    """Yield the steps whose reply is one line, at a known baud rate."""
    for step in line.steps:
        is_command = isinstance(step.request, (Command, Malformed, TurretMessage))
        if is_command and step.exchange.reply is not None and step.byte_ns:
            yield step


@check("no reply ends before command and reply are transmitted", "3.2")
def too_early(line: RecordedLine) -> Verdict:
    slack_ns = 0 if line.simulated else _WALL_CLOCK_NS

    def deviation(step: RecordedStep) -> Finding | None:
        length = len(step.exchange.reply or b"") + 2
        min_ns = (step.arrived_ns - step.exchange.sent_ns + length * step.byte_ns) * _MIN_BYTE_RATIO
        duration_ns = step.exchange.reply_ns - step.exchange.sent_ns
        if duration_ns + slack_ns >= int(min_ns):
            return None
        return finding(
            step, f"{step.reply_text} after {duration_ns / 1e6:.1f} ms", f"at least {min_ns / 1e6:.1f} ms"
        )

    return judge(_one_line_steps(line), deviation)


@check("replies start within 10 ms, through a relay within 30 ms", "3.2")
def too_late(line: RecordedLine) -> Verdict:
    limit_ns, previous_end_ns = FIRST_BYTE_NS[line.simulated], 0
    waits: dict[str, list[tuple[int, RecordedStep]]] = defaultdict(list)
    timed = {id(step) for step in _one_line_steps(line)}
    # A reply or banner starts only after the previous one.
    for step in sorted(line.steps, key=lambda step: step.exchange.reply_ns):
        length = len(step.exchange.reply or b"") + 2
        if id(step) in timed and not step.exchange.abandoned:
            wait_ns = step.exchange.reply_ns - max(step.arrived_ns, previous_end_ns) - length * step.byte_ns
            waits[step.exchange.letter].append((wait_ns, step))
        previous_end_ns = step.exchange.reply_ns
    findings, expected = list[Finding](), f"at most {limit_ns / 1e6:.0f} ms"
    for letter_waits in waits.values():
        late_findings = [
            finding(step, f"{step.reply_text} {wait_ns / 1e6:.0f} ms late", expected)
            for wait_ns, step in letter_waits
            if wait_ns > limit_ns
        ]
        if line.simulated or len(late_findings) > max(_LATE_SHARE * len(letter_waits), 2):
            findings += late_findings
    waits_ms = [wait_ns / 1e6 for of_letter in waits.values() for wait_ns, _ in of_letter]
    if not waits_ms:
        return Verdict(0)
    median, p95, longest = np.quantile(waits_ms, [0.5, 0.95, 1.0]).clip(0).tolist()
    note = f"half within {median:.1f} ms, 95 % within {p95:.1f} ms, all within {longest:.1f} ms"
    return Verdict(len(waits_ms), sorted(findings, key=lambda deviation: deviation.time_s), note)
