"""Checks of a recording's counters, speeds and status, which depend on the wheels. See `recording`.

A wheel's motion between two replies is not known, so counters are compared with speeds over 160 mm and
more, and by half of them.
"""

# NumPy's interp is partly untyped.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import TARGET_TOLERANCE_PULSES, Mode, wrap
from khep_twin.board.protocol import Command
from khep_twin.board.rom import ROMS
from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recorded_line import Motion, RecordedLine, Step, is_error
from khep_twin.lab.conformance.recording import Finding, RecordingCheck, Verdict, adder, answered, finding
from khep_twin.lab.conformance.reply_checks import SPEED_MOST
from khep_twin.units import TICK_NS

ALL: list[RecordingCheck] = []
"""All checks; `check` adds to them."""

check = adder(ALL)

_SIDES = ("left", "right")
_VALUES = {"E": 2, "H": 2, "K": 6}

_SLOWEST = 3
"""Slowest speed that is compared: E has whole pulses/10 ms."""

_WAY = 2000
"""Way after which two measures of it are compared [pulses], 160 mm."""

_APART = 0.5
"""Largest deviation of two measures of a way, as a share of it (assumed; bumps and starts lie between)."""

_SETTLED_NS = NS_PER_S // 2
"""Time after a change of D until a wheel has its speed [ns] (docs/protocol.md: 120 ms on the floor)."""

_LONGEST_NS = NS_PER_S // 2
"""Longest time between two counters over which the speeds at its ends say what was between [ns] (assumed)."""

_UNSURE_NS = 30_000_000
"""Longest time within which a value was read at some moment, of those that are compared over ways [ns]."""

_PUSHED = 10
"""Most pulses by which a wheel on its target is pushed away and comes back between two replies (assumed)."""

_SLOW_ACCELERATION = 16
"""Acceleration of J from which the last pulses take less than a second [pulses/256 per (10 ms)^2]."""


def _read(line: RecordedLine, letters: str) -> Iterator[tuple[Step, tuple[int, ...]]]:
    """Yield the steps of these commands whose replies have their number of values."""
    for step in line.steps:
        values = step.exchange.values if step.exchange.letter in letters else None
        if values is not None and len(values) == _VALUES[step.exchange.letter]:
            yield step, values


class _Counter(NamedTuple):
    """Counters that are known: left and right, between two times [ns], and from what."""

    values: tuple[int, ...]
    from_ns: int
    until_ns: int
    source: str


def _counted(line: RecordedLine) -> Iterator[tuple[_Counter, Step, tuple[int, ...]]]:
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
def _continuity(line: RecordedLine) -> Verdict:
    return _jumps(line, "H", "after")


@check("G sets the counters", "A, command G")
def _set_counters(line: RecordedLine) -> Verdict:
    return _jumps(line, "G", "after G")


@check("a restart sets the counters to 0", "3.2.1, tool restart")
def _zero_counters(line: RecordedLine) -> Verdict:
    return _jumps(line, "restart", "")


# Ways ----------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Ways:
    """Sums of the ways of one wheel by two measures, and what they say after each `_WAY`.

    Attributes:
        wheel: Name of the wheel.
        first: What is compared, of `expected` ways.
        given: What it is compared with.
    """

    wheel: str
    first: str
    given: str
    seen: int = 0
    findings: list[Finding] = field(default_factory=list[Finding])
    _expected: float = 0.0
    _found: float = 0.0
    _since: Step | None = None

    def add(self, step: Step, expected: float, found: float) -> None:
        """Add a way by both measures [pulses]."""
        self._since = self._since or step
        self.seen += 1
        self._expected += abs(expected)
        self._found += found if expected > 0 else -found
        if self._expected < _WAY:
            return
        if abs(self._found - self._expected) > _APART * self._expected:
            words = f"{self.first} of the {self.wheel} wheel {self._found:+.0f} pulses from here on"
            self.findings.append(finding(self._since, words, f"about {self._expected:+.0f} by {self.given}"))
        self._expected = self._found = 0.0
        self._since = None


def _is_sure(step: Step) -> bool:
    """Return whether the time at which a value was read is known well enough."""
    return step.read_ns - step.arrived_ns < _UNSURE_NS


def _is_way(known: _Counter, step: Step) -> bool:
    """Return whether two counters have been counted by the wheel, at times that are known well enough."""
    return known.source == "H" and known.until_ns - known.from_ns < _UNSURE_NS and _is_sure(step)


def _verdict(ways: list[_Ways]) -> Verdict:
    findings = [each for way in ways for each in way.findings]
    return Verdict(sum(way.seen for way in ways), sorted(findings, key=lambda each: each.time_s))


@check("counters go as far as the speeds of E say", "A, commands E and H")
def _way_by_speeds(line: RecordedLine) -> Verdict:
    ways = [_Ways(side, "by H a way", "E") for side in _SIDES]
    speeds = [(step.arrived_ns, *values) for step, values in _read(line, "E") if _is_sure(step)]
    if len(speeds) < 2:
        return Verdict(0)
    columns: NDArray[np.float64] = np.array(speeds, np.float64).T
    times_ns, of_wheels = columns[0], columns[1:]
    for known, step, values in _counted(line):
        first, last = np.searchsorted(times_ns, [known.from_ns, step.arrived_ns]).tolist()
        if not _is_way(known, step) or not 0 < first or last >= len(times_ns):
            continue
        if times_ns[last] - times_ns[first - 1] > _LONGEST_NS:
            continue
        inside_ns: list[float] = times_ns[first:last].tolist()
        ends_ns: NDArray[np.float64] = np.array([known.from_ns, *inside_ns, step.arrived_ns])
        for wheel, way in enumerate(ways):
            if np.abs(of_wheels[wheel][first - 1 : last + 1]).min() >= _SLOWEST:
                between = np.interp(ends_ns, times_ns, of_wheels[wheel])
                by_speeds = float(np.trapezoid(between, ends_ns / TICK_NS))
                way.add(step, by_speeds, wrap(values[wheel] - known.values[wheel]))
    return _verdict(ways)


def _steady(line: RecordedLine) -> Iterator[tuple[Step, tuple[int, int], int]]:
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
def _way_by_setpoints(line: RecordedLine) -> Verdict:
    ways = [_Ways(side, "by H a way", "D") for side in _SIDES]
    since = {id(step): (speeds, since_ns) for step, speeds, since_ns in _steady(line)}
    for known, step, values in _counted(line):
        speeds, since_ns = since[id(step)]
        if not _is_way(known, step) or known.from_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, way in enumerate(ways):
            if abs(speeds[wheel]) >= _SLOWEST:
                ticks = (step.arrived_ns - known.from_ns) / TICK_NS
                way.add(step, speeds[wheel] * ticks, wrap(values[wheel] - known.values[wheel]))
    return _verdict(ways)


@check("speeds of E are those of D", "A, commands D and E")
def _speeds_by_setpoints(line: RecordedLine) -> Verdict:
    ways = [_Ways(side, "by E speeds, times 10,", "D") for side in _SIDES]
    for step, speeds, since_ns in _steady(line):
        values = step.exchange.values if step.exchange.letter == "E" else None
        if values is None or len(values) != 2 or step.arrived_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, way in enumerate(ways):
            if abs(speeds[wheel]) >= _SLOWEST:
                # Ten readings at a speed of 20 are compared at once.
                way.add(step, 10 * speeds[wheel], 10 * values[wheel])
    return _verdict(ways)


# Status --------------------------------------------------------------------------------------------------


def _status(line: RecordedLine, deviation: Callable[[Step, Motion, int, tuple[int, ...]], str]) -> Verdict:
    """Return the verdict over each wheel of each reply to K.

    Args:
        line: Line.
        deviation: Function of a step, its motion, the wheel, and target flag, mode and error of it; it
            returns what was expected, "?" if this wheel says nothing, "" if it is right.
    """
    seen, findings = 0, list[Finding]()
    for step, values in _read(line, "K"):
        if step.motion is None:
            continue
        for wheel, side in enumerate(_SIDES):
            expected = deviation(step, step.motion, wheel, values[3 * wheel : 3 * wheel + 3])
            seen += expected != "?"
            if expected not in ("", "?"):
                findings.append(finding(step, f"{answered(step)}, {side} wheel", expected))
    return Verdict(seen, findings)


@check("K has the mode that D, C, P or a restart has set", "A, command K")
def _modes(line: RecordedLine) -> Verdict:
    codes = ROMS[line.rom].mode_codes

    def deviation(step: Step, motion: Motion, wheel: int, status: tuple[int, ...]) -> str:
        code = codes[motion.modes[wheel]]
        return "" if status[1] == code else f"mode {code}, {motion.modes[wheel].name.lower()}"

    return _status(line, deviation)


@check("K's target flag is 0 after D and P, 1 after a restart, and otherwise 0 or 1", "A, command K; assumed")
def _flags(line: RecordedLine) -> Verdict:
    def deviation(step: Step, motion: Motion, wheel: int, status: tuple[int, ...]) -> str:
        if motion.modes[wheel] == Mode.POSITION:
            return "" if status[0] in (0, 1) else "a target flag of 0 or 1"
        right = motion.on_target[wheel]
        return "" if status[0] == right else f"a target flag of {right}"

    return _status(line, deviation)


@check("K's error is that of the controller: 0 in PWM mode, small on a target", "A, command K; assumed")
def _errors(line: RecordedLine) -> Verdict:
    def deviation(step: Step, motion: Motion, wheel: int, status: tuple[int, ...]) -> str:
        match motion.modes[wheel]:
            case Mode.PWM:
                most = 0
            case Mode.SPEED:
                most = abs(motion.speeds[wheel]) + SPEED_MOST
            case Mode.POSITION:
                most = TARGET_TOLERANCE_PULSES if status[0] == 1 else 2**31
        return "" if abs(status[2]) <= most else f"an error of at most {most}"

    return _status(line, deviation)


@check("a wheel that K says is on its target has the counter of C", "A, commands C, H and K")
def _arrivals(line: RecordedLine) -> Verdict:
    seen, findings = 0, list[Finding]()
    for before, (step, values), after in _between_status(line):
        for wheel, side in enumerate(_SIDES):
            motion = step.motion
            there = before[1][3 * wheel] == 1 == after[1][3 * wheel]
            if motion is None or not there or motion.modes[wheel] != Mode.POSITION:
                continue
            seen += 1
            target = _target_in_counts(before[0], step, after[0], wheel)
            if target is not None and abs(wrap(values[wheel] - target)) > _PUSHED:
                findings.append(finding(step, f"{answered(step)}, {side} wheel", f"{target}, its target"))
    return Verdict(seen, findings)


_Reading = tuple[Step, tuple[int, ...]]


def _between_status(line: RecordedLine) -> Iterator[tuple[_Reading, _Reading, _Reading]]:
    """Yield each reply to H that lies between two to K without another command to the motors."""
    last: _Reading | None = None
    counters: list[_Reading] = []
    changes = list(line.changes_ns)
    for step in line.steps:
        values, letter = step.exchange.values, step.exchange.letter
        moved = bool(changes) and changes[0] <= step.exchange.sent_ns
        while changes and changes[0] <= step.exchange.sent_ns:
            changes.pop(0)
        if moved or step.restarts or letter in ("", *"ACDFGJP"):
            last, counters = None, []
        elif letter == "H" and values is not None and len(values) == 2:
            counters.append((step, values))
        elif letter == "K" and values is not None and len(values) == 6:
            if last is not None:
                yield from ((last, each, (step, values)) for each in counters)
            last, counters = (step, values), []


def _target_in_counts(before: Step, step: Step, after: Step, wheel: int) -> int | None:
    """Return the target of a wheel in the counts of H; None if it is not known."""
    motions = [each.motion for each in (before, step, after)]
    targets = {motion.targets[wheel] if motion and motion.targets else None for motion in motions}
    return targets.pop() if len(targets) == 1 else None


@check("K says that a wheel is on its target within a second", "A, commands C, H and K")
def _notices(line: RecordedLine) -> Verdict:
    """Check the status of wheels whose counters have been on the target for a second."""
    seen, findings = 0, list[Finding]()
    for wheel, side in enumerate(_SIDES):
        there: list[Step] = []
        for before, step in pairwise(line.steps):
            motion, values, letter = step.motion, step.exchange.values, step.exchange.letter
            held = motion is not None and motion.modes[wheel] == Mode.POSITION
            if motion is None or not held or letter in ("", *"ACDFGJP") or before.motion != motion:
                there = []
            elif letter == "H" and values is not None and len(values) == 2:
                near = motion.targets is not None and (
                    abs(wrap(values[wheel] - motion.targets[wheel])) <= TARGET_TOLERANCE_PULSES
                )
                there = [*there, step] if near else []
            elif letter == "K" and values is not None and len(values) == 6 and len(there) > 1:
                speed, acceleration = motion.profile
                long = there[-1].arrived_ns - there[0].arrived_ns > NS_PER_S
                recent = step.arrived_ns - there[-1].arrived_ns < _LONGEST_NS
                if not long or not recent or speed < 1 or acceleration < _SLOW_ACCELERATION:
                    continue
                seen += 1
                if values[3 * wheel] != 1:
                    findings.append(finding(step, f"{answered(step)}, {side} wheel", "a target flag of 1"))
    return Verdict(seen, findings)
