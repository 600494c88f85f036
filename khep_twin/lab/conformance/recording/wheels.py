"""Checks of a recording's counters and speeds, which depend on the wheels.

A wheel's motion between two replies is not known. Therefore, counters and speeds are compared over at least
160 mm, with a tolerance of half the distance.
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
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import MAX_SPEED, read_values
from khep_twin.units import TICK_NS

SIDES = ("left", "right")
_MIN_SPEED = 3
"""Slowest speed that is compared, as E has whole pulses/10 ms."""
_COMPARED_PULSES = 2000
"""Distance over which counters and speeds are compared [pulses], 160 mm."""
_LARGEST_DEVIATION = 0.5
"""Largest deviation, as a share of the distance (assumed; there are collisions in between)."""
_SETTLED_NS = NS_PER_S // 2
"""Settling time of the speed after a change of D [ns] (docs/protocol.md: 120 ms on the floor)."""
_MAX_VARIATION = 0.2
"""Largest variation of the speeds around a distance, as a share of them (assumed)."""
_MAX_GAP_NS = NS_PER_S // 5
"""Longest time between two counters over which speeds may be interpolated [ns] (assumed)."""
_MAX_ERROR_NS = 30_000_000
"""Largest uncertainty of the time of a value in comparisons over distances [ns]."""


class _Counter(NamedTuple):
    """Known counters: left and right, the earliest and latest time of reading [ns], and their source."""

    values: tuple[int, ...]
    from_ns: int
    until_ns: int
    source: str


def _counter_intervals(line: RecordedLine) -> Iterator[tuple[_Counter, RecordedStep, tuple[int, ...]]]:
    """Yield each reply to H with the known counters before it: by an H, a G or a restart."""
    start: _Counter | None = None
    changes = iter([*line.changes_ns, None])
    change_ns = next(changes)
    for step in line.steps:
        exchange = step.exchange
        while change_ns is not None and change_ns <= exchange.sent_ns:
            # A robot that is moved by hand may be reset.
            start, change_ns = None, next(changes)
        if step.restarts:
            start_ns = exchange.sent_ns if exchange.command else exchange.reply_ns - NS_PER_S
            start = _Counter((0, 0), start_ns, exchange.reply_ns, "restart")
        elif isinstance(step.request, Command) and exchange.letter == "G" and not is_error(step.expected):
            if exchange.reply is None or is_error(exchange.reply):
                start = None
            else:
                values = tuple(map(wrap, step.request.arguments))
                start = _Counter(values, step.arrived_ns, step.read_ns, "G")
        elif exchange.reply is None and exchange.letter == "":
            start = None  # it may have been a restart
        elif exchange.letter == "H" and (values := exchange.values) is not None and len(values) == 2:
            if start is not None:
                yield start, step, values
            start = _Counter(values, step.arrived_ns, step.read_ns, "H")


def _check_jumps(line: RecordedLine, source: str, expected: str) -> Verdict:
    """Return the verdict over counters; more change than a wheel can turn is a finding."""
    n_checked, findings = 0, list[Finding]()
    for start, step, values in _counter_intervals(line):
        if start.source != source:
            continue
        n_checked += 1
        limit = MAX_SPEED * ((step.read_ns - start.from_ns) // TICK_NS + 2)
        if any(abs(wrap(new - old)) > limit for old, new in zip(start.values, values, strict=True)):
            observation = f"{step.reply_text}, {(step.arrived_ns - start.until_ns) / 1e6:.0f} ms later"
            left, right = start.values
            findings.append(finding(step, observation, f"{expected} {left},{right}, ±{limit}"))
    return Verdict(n_checked, findings)


@check("counters change no faster than a wheel can turn", "A, command H")
def counters_without_jumps(line: RecordedLine) -> Verdict:
    return _check_jumps(line, "H", "after")


@check("G sets the counters", "A, command G")
def set_counters(line: RecordedLine) -> Verdict:
    return _check_jumps(line, "G", "after G")


@check("a restart sets the counters to 0", "3.2.1, tool restart")
def counters_after_restart(line: RecordedLine) -> Verdict:
    return _check_jumps(line, "restart", "")


# Distances -----------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Distances:
    """Distances of one wheel by two measures, whose sums are compared after each `_COMPARED_PULSES`.

    Attributes:
        wheel: Name of the wheel.
        measure: Description of the compared distances.
        reference: Source of the expected distances.
    """

    wheel: str
    measure: str
    reference: str
    n_checked: int = 0
    findings: list[Finding] = field(default_factory=list[Finding])
    _expected: float = 0.0
    _measured: float = 0.0
    _first_step: RecordedStep | None = None

    def add(self, step: RecordedStep, expected: float, distance: float) -> None:
        """Add a distance by both measures [pulses]."""
        self._first_step = self._first_step or step
        self.n_checked += 1
        self._expected += abs(expected)
        self._measured += distance if expected > 0 else -distance
        if self._expected < _COMPARED_PULSES:
            return
        if abs(self._measured - self._expected) > _LARGEST_DEVIATION * self._expected:
            text = f"{self.measure} of the {self.wheel} wheel {self._measured:+.0f} pulses from here on"
            expected_text = f"about {self._expected:+.0f} by {self.reference}"
            self.findings.append(finding(self._first_step, text, expected_text))
        self._expected = self._measured = 0.0
        self._first_step = None


def _is_precise(step: RecordedStep) -> bool:
    """Return whether the time of a value is known precisely enough."""
    return step.read_ns - step.arrived_ns < _MAX_ERROR_NS


def _is_distance(start: _Counter, step: RecordedStep) -> bool:
    """Return whether two counters differ by the wheel's motion alone, at times known precisely enough."""
    return start.source == "H" and start.until_ns - start.from_ns < _MAX_ERROR_NS and _is_precise(step)


def _combine(distances: list[_Distances]) -> Verdict:
    findings = [deviation for distance in distances for deviation in distance.findings]
    n_checked = sum(distance.n_checked for distance in distances)
    return Verdict(n_checked, sorted(findings, key=lambda deviation: deviation.time_s))


@check("counters agree with the speeds that E reads", "A, commands E and H")
def counters_by_measured_speeds(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by H a distance", "E") for side in SIDES]
    speeds = [(step.arrived_ns, *values) for step, values in read_values(line, "E") if _is_precise(step)]
    if len(speeds) < 2:
        return Verdict(0)
    columns: NDArray[np.float64] = np.array(speeds, np.float64).T
    times_ns, wheel_speeds = columns[0], columns[1:]
    for start, step, values in _counter_intervals(line):
        first_row, end_row = np.searchsorted(times_ns, [start.from_ns, step.arrived_ns]).tolist()
        if not _is_distance(start, step) or not 0 < first_row or end_row >= len(times_ns):
            continue
        if times_ns[end_row] - times_ns[first_row - 1] > _MAX_GAP_NS:
            continue
        inside_ns: list[float] = times_ns[first_row:end_row].tolist()
        ends_ns: NDArray[np.float64] = np.array([start.from_ns, *inside_ns, step.arrived_ns])
        for wheel, distance in enumerate(distances):
            speeds_around = wheel_speeds[wheel][first_row - 1 : end_row + 1]
            min_speed = float(np.abs(speeds_around).min())
            if min_speed >= _MIN_SPEED and np.ptp(speeds_around) <= max(_MAX_VARIATION * min_speed, 2):
                speeds_between = np.interp(ends_ns, times_ns, wheel_speeds[wheel])
                speed_distance = float(np.trapezoid(speeds_between, ends_ns / TICK_NS))
                distance.add(step, speed_distance, wrap(values[wheel] - start.values[wheel]))
    return _combine(distances)


def _steady_speeds(line: RecordedLine) -> Iterator[tuple[RecordedStep, tuple[int, int], int]]:
    """Yield the steps with the speeds of speed mode and the time of their last change [ns]."""
    speeds, since_ns = (0, 0), 0
    changes = iter([*line.changes_ns, None])
    change_ns = next(changes)
    for step in line.steps:
        while change_ns is not None and change_ns <= step.exchange.sent_ns:
            since_ns, change_ns = change_ns, next(changes)
        motion = step.motion
        is_steady = motion is not None and motion.modes == (Mode.SPEED, Mode.SPEED) and motion.usual_gains
        if motion is None or not is_steady or motion.speeds != speeds or step.restarts:
            speeds = motion.speeds if motion is not None and is_steady else (0, 0)
            since_ns = step.exchange.reply_ns
        yield step, speeds, since_ns


@check("counters agree with the speeds that D sets", "A, commands D and H")
def counters_by_setpoints(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by H a distance", "D") for side in SIDES]
    speed_spans = {id(step): (speeds, since_ns) for step, speeds, since_ns in _steady_speeds(line)}
    for start, step, values in _counter_intervals(line):
        speeds, since_ns = speed_spans[id(step)]
        if not _is_distance(start, step) or start.from_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, distance in enumerate(distances):
            if abs(speeds[wheel]) >= _MIN_SPEED:
                ticks = (step.arrived_ns - start.from_ns) / TICK_NS
                distance.add(step, speeds[wheel] * ticks, wrap(values[wheel] - start.values[wheel]))
    return _combine(distances)


@check("E reads the speeds that D sets", "A, commands D and E")
def speeds_by_setpoints(line: RecordedLine) -> Verdict:
    distances = [_Distances(side, "by E speeds, times 10,", "D") for side in SIDES]
    for step, speeds, since_ns in _steady_speeds(line):
        values = step.exchange.values if step.exchange.letter == "E" else None
        if values is None or len(values) != 2 or step.arrived_ns < since_ns + _SETTLED_NS:
            continue
        for wheel, distance in enumerate(distances):
            if abs(speeds[wheel]) >= _MIN_SPEED:
                # Ten readings at a speed of 20 make one comparison.
                distance.add(step, 10 * speeds[wheel], 10 * values[wheel])
    return _combine(distances)
