"""Checks of a recording's counters and speeds, which depend on the wheels.

A wheel's motion between two replies is not known, so counters are compared with speeds over 160 mm and
more, and by half of them.
"""

# NumPy's interp is partly untyped.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import Mode, wrap
from khep_twin.board.protocol import Command
from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recording.board_model import RecordedStep, is_error
from khep_twin.lab.conformance.recording.check import Finding, Verdict, answered, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import SPEED_MOST, read
from khep_twin.units import TICK_NS

SIDES = ("left", "right")
_SLOWEST = 3
"""Slowest speed that is compared: E has whole pulses/10 ms."""

_DISTANCE = 2000
"""Distance after which two measures of it are compared [pulses], 160 mm."""

_LARGEST_DEVIATION = 0.5
"""Largest deviation of two measures of a distance, as a share of it (assumed; bumps lie between)."""

_SETTLED_NS = NS_PER_S // 2
"""Time after a change of D until a wheel has its speed [ns] (docs/protocol.md: 120 ms on the floor)."""

_STEADY = 0.2
"""Largest difference of the speeds around a distance, as a share of them (assumed)."""

_LONGEST_NS = NS_PER_S // 5
"""Longest time between two counters over which the speeds at its ends say what was between [ns] (assumed)."""

_UNSURE_NS = 30_000_000
"""Longest time within which a value was read at some moment, for comparisons over distances [ns]."""


class _Counter(NamedTuple):
    """Counters that are known: left and right, between two times [ns], and from what."""

    values: tuple[int, ...]
    from_ns: int
    until_ns: int
    source: str


def _counted(line: RecordedLine) -> Iterator[tuple[_Counter, RecordedStep, tuple[int, ...]]]:
    """Yield each reply to H after counters that are known: of an H, a G or a restart."""
    known: _Counter | None = None
    changes = iter([*line.changes_ns, None])
    change_ns = next(changes)
    for step in line.steps:
        each = step.exchange
        while change_ns is not None and change_ns <= each.sent_ns:
            # A robot that is put elsewhere may be reset.
            known, change_ns = None, next(changes)
        if step.restarts:
            known = _Counter(
                (0, 0), each.sent_ns if each.command else each.heard_ns - NS_PER_S, each.heard_ns, "restart"
            )
        elif isinstance(step.request, Command) and each.letter == "G" and not is_error(step.expected):
            if each.reply is None or is_error(each.reply):
                known = None
            else:
                values = tuple(map(wrap, step.request.arguments))
                known = _Counter(values, step.arrived_ns, step.read_ns, "G")
        elif each.reply is None and each.letter == "":
            known = None  # it may have been a restart
        elif each.letter == "H" and (values := each.values) is not None and len(values) == 2:
            if known is not None:
                yield known, step, values
            known = _Counter(values, step.arrived_ns, step.read_ns, "H")


def _jumps(line: RecordedLine, source: str, expected: str) -> Verdict:
    """Return the verdict over counters that change by more than a wheel can turn."""
    seen, findings = 0, list[Finding]()
    for known, step, values in _counted(line):
        if known.source != source:
            continue
        seen += 1
        most = SPEED_MOST * ((step.read_ns - known.from_ns) // TICK_NS + 2)
        if any(abs(wrap(now - then)) > most for then, now in zip(known.values, values, strict=True)):
            found = f"{answered(step)}, {(step.arrived_ns - known.until_ns) / 1e6:.0f} ms later"
            findings.append(finding(step, found, f"{expected} {known.values[0]},{known.values[1]}, ±{most}"))
    return Verdict(seen, findings)


@check("counters go on from reply to reply, no faster than a wheel turns", "A, command H")
def counters_without_jumps(line: RecordedLine) -> Verdict:
    return _jumps(line, "H", "after")


@check("G sets the counters", "A, command G")
def set_counters(line: RecordedLine) -> Verdict:
    return _jumps(line, "G", "after G")


@check("a restart sets the counters to 0", "3.2.1, tool restart")
def counters_after_restart(line: RecordedLine) -> Verdict:
    return _jumps(line, "restart", "")


# Distances -----------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Distances:
    """Sums of the distances of one wheel by two measures, and what they say after each `_DISTANCE`.

    Attributes:
        wheel: Name of the wheel.
        first: What is compared, of `expected` distances.
        given: What it is compared with.
    """

    wheel: str
    first: str
    given: str
    seen: int = 0
    findings: list[Finding] = field(default_factory=list[Finding])
    _expected: float = 0.0
    _found: float = 0.0
    _since: RecordedStep | None = None

    def add(self, step: RecordedStep, expected: float, found: float) -> None:
        """Add a distance by both measures [pulses]."""
        self._since = self._since or step
        self.seen += 1
        self._expected += abs(expected)
        self._found += found if expected > 0 else -found
        if self._expected < _DISTANCE:
            return
        if abs(self._found - self._expected) > _LARGEST_DEVIATION * self._expected:
            words = f"{self.first} of the {self.wheel} wheel {self._found:+.0f} pulses from here on"
            self.findings.append(finding(self._since, words, f"about {self._expected:+.0f} by {self.given}"))
        self._expected = self._found = 0.0
        self._since = None


def _is_sure(step: RecordedStep) -> bool:
    """Return whether the time at which a value was read is known well enough."""
    return step.read_ns - step.arrived_ns < _UNSURE_NS


def _is_distance(known: _Counter, step: RecordedStep) -> bool:
    """Return whether two counters have been counted by the wheel, at times that are known well enough."""
    return known.source == "H" and known.until_ns - known.from_ns < _UNSURE_NS and _is_sure(step)


def _verdict(distances: list[_Distances]) -> Verdict:
    findings = [each for distance in distances for each in distance.findings]
    return Verdict(
        sum(distance.seen for distance in distances), sorted(findings, key=lambda each: each.time_s)
    )


@check("counters go as far as the speeds of E say", "A, commands E and H")
def counters_by_measured_speeds(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by H a distance", "E") for side in SIDES]
    speeds = [(step.arrived_ns, *values) for step, values in read(line, "E") if _is_sure(step)]
    if len(speeds) < 2:
        return Verdict(0)
    columns: NDArray[np.float64] = np.array(speeds, np.float64).T
    times_ns, of_wheels = columns[0], columns[1:]
    for known, step, values in _counted(line):
        first, last = np.searchsorted(times_ns, [known.from_ns, step.arrived_ns]).tolist()
        if not _is_distance(known, step) or not 0 < first or last >= len(times_ns):
            continue
        if times_ns[last] - times_ns[first - 1] > _LONGEST_NS:
            continue
        inside_ns: list[float] = times_ns[first:last].tolist()
        ends_ns: NDArray[np.float64] = np.array([known.from_ns, *inside_ns, step.arrived_ns])
        for wheel, distance in enumerate(distances):
            speeds_around = of_wheels[wheel][first - 1 : last + 1]
            least = float(np.abs(speeds_around).min())
            if least >= _SLOWEST and np.ptp(speeds_around) <= max(_STEADY * least, 2):
                between = np.interp(ends_ns, times_ns, of_wheels[wheel])
                by_speeds = float(np.trapezoid(between, ends_ns / TICK_NS))
                distance.add(step, by_speeds, wrap(values[wheel] - known.values[wheel]))
    return _verdict(distances)


def _steady(line: RecordedLine) -> Iterator[tuple[RecordedStep, tuple[int, int], int]]:
    """Yield the steps while speed mode has had the same speeds, these, and since when it has them [ns]."""
    speeds, since_ns = (0, 0), 0
    changes = iter([*line.changes_ns, None])
    change_ns = next(changes)
    for step in line.steps:
        while change_ns is not None and change_ns <= step.exchange.sent_ns:
            since_ns, change_ns = change_ns, next(changes)
        now = step.motion
        held = now is not None and now.modes == (Mode.SPEED, Mode.SPEED) and now.usual_gains
        if now is None or not held or now.speeds != speeds or step.restarts:
            speeds, since_ns = now.speeds if now is not None and held else (0, 0), step.exchange.heard_ns
        yield step, speeds, since_ns


@check("counters go as far as the speeds of D say", "A, commands D and H")
def counters_by_setpoints(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by H a distance", "D") for side in SIDES]
    since = {id(step): (speeds, since_ns) for step, speeds, since_ns in _steady(line)}
    for known, step, values in _counted(line):
        speeds, since_ns = since[id(step)]
        if not _is_distance(known, step) or known.from_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, distance in enumerate(distances):
            if abs(speeds[wheel]) >= _SLOWEST:
                ticks = (step.arrived_ns - known.from_ns) / TICK_NS
                distance.add(step, speeds[wheel] * ticks, wrap(values[wheel] - known.values[wheel]))
    return _verdict(distances)


@check("speeds of E are those of D", "A, commands D and E")
def speeds_by_setpoints(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by E speeds, times 10,", "D") for side in SIDES]
    for step, speeds, since_ns in _steady(line):
        values = step.exchange.values if step.exchange.letter == "E" else None
        if values is None or len(values) != 2 or step.arrived_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, distance in enumerate(distances):
            if abs(speeds[wheel]) >= _SLOWEST:
                # Ten readings at a speed of 20 are compared at once.
                distance.add(step, 10 * speeds[wheel], 10 * values[wheel])
    return _verdict(distances)
