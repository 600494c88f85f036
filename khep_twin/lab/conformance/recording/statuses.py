"""Checks of a recording's status of the motors, the replies to K."""

from collections.abc import Callable, Iterator
from itertools import pairwise

from khep_twin.board.kernel import TARGET_TOLERANCE_PULSES, Mode, wrap
from khep_twin.board.protocol import SETTING
from khep_twin.board.rom import ROMS
from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recording.board_model import MotorSettings, RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, answered, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import SPEED_MOST, Reading, read
from khep_twin.lab.conformance.recording.wheels import SIDES

_PUSHED = 10
"""Most pulses by which a wheel on its target is pushed away and comes back between two replies (assumed)."""

_SLOW_ACCELERATION = 16
"""Acceleration of J from which the last pulses take less than a second [pulses/256 per (10 ms)^2]."""

_RECENT_NS = NS_PER_S // 2
"""Longest time since the last counter of a wheel that stands on its target [ns] (assumed)."""


def _status(
    line: RecordedLine, deviation: Callable[[RecordedStep, MotorSettings, int, tuple[int, ...]], str]
) -> Verdict:
    """Return the verdict over each wheel of each reply to K.

    Args:
        line: Line.
        deviation: Function of a step, its motion, the wheel, and target flag, mode and error of it; it
            returns what was expected, "?" if this wheel says nothing, "" if it is right.
    """
    seen, findings = 0, list[Finding]()
    for step, values in read(line, "K"):
        if step.motion is None:
            continue
        for wheel, side in enumerate(SIDES):
            expected = deviation(step, step.motion, wheel, values[3 * wheel : 3 * wheel + 3])
            seen += expected != "?"
            if expected not in ("", "?"):
                findings.append(finding(step, f"{answered(step)}, {side} wheel", expected))
    return Verdict(seen, findings)


@check("K has the mode that D, C, P or a restart has set", "A, command K")
def modes(line: RecordedLine) -> Verdict:
    codes = ROMS[line.rom].mode_codes

    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
        code = codes[motion.modes[wheel]]
        return "" if status[1] == code else f"mode {code}, {motion.modes[wheel].name.lower()}"

    return _status(line, deviation)


@check("K's target flag is 0 after D and P, 1 after a restart, and otherwise 0 or 1", "A, command K; assumed")
def flags(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
        if motion.modes[wheel] == Mode.POSITION:
            return "" if status[0] in (0, 1) else "a target flag of 0 or 1"
        right = motion.on_target[wheel]
        return "" if status[0] == right else f"a target flag of {right}"

    return _status(line, deviation)


@check("K's error is that of the controller: 0 in PWM mode, small on a target", "A, command K; assumed")
def errors(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
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
def counters_on_target(line: RecordedLine) -> Verdict:
    seen, findings = 0, list[Finding]()
    for before, (step, values), after in _between_status(line):
        for wheel, side in enumerate(SIDES):
            motion = step.motion
            there = before[1][3 * wheel] == 1 == after[1][3 * wheel]
            if motion is None or not there or motion.modes[wheel] != Mode.POSITION:
                continue
            seen += 1
            target = _target_in_counts(before[0], step, after[0], wheel)
            if target is not None and abs(wrap(values[wheel] - target)) > _PUSHED:
                findings.append(finding(step, f"{answered(step)}, {side} wheel", f"{target}, its target"))
    return Verdict(seen, findings)


def _between_status(line: RecordedLine) -> Iterator[tuple[Reading, Reading, Reading]]:
    """Yield each reply to H that lies between two to K without another command to the motors."""
    last: Reading | None = None
    counters: list[Reading] = []
    changes = list(line.changes_ns)
    for step in line.steps:
        values, letter = step.exchange.values, step.exchange.letter
        moved = bool(changes) and changes[0] <= step.exchange.sent_ns
        while changes and changes[0] <= step.exchange.sent_ns:
            changes.pop(0)
        if moved or step.restarts or letter in ("", *SETTING):
            last, counters = None, []
        elif letter == "H" and values is not None and len(values) == 2:
            counters.append((step, values))
        elif letter == "K" and values is not None and len(values) == 6:
            if last is not None:
                yield from ((last, each, (step, values)) for each in counters)
            last, counters = (step, values), []


def _target_in_counts(
    before: RecordedStep, step: RecordedStep, after: RecordedStep, wheel: int
) -> int | None:
    """Return the target of a wheel in the counts of H; None if it is not known."""
    motions = [each.motion for each in (before, step, after)]
    targets = {motion.targets[wheel] if motion and motion.targets else None for motion in motions}
    return targets.pop() if len(targets) == 1 else None


@check("K says that a wheel is on its target within a second", "A, commands C, H and K")
def arrival_in_time(line: RecordedLine) -> Verdict:
    """Check the status of wheels whose counters have been on the target for a second."""
    seen, findings = 0, list[Finding]()
    for wheel, side in enumerate(SIDES):
        there: list[RecordedStep] = []
        for before, step in pairwise(line.steps):
            motion, values, letter = step.motion, step.exchange.values, step.exchange.letter
            held = motion is not None and motion.modes[wheel] == Mode.POSITION
            if motion is None or not held or letter in ("", *SETTING) or before.motion != motion:
                there = []
            elif letter == "H" and values is not None and len(values) == 2:
                near = motion.targets is not None and (
                    abs(wrap(values[wheel] - motion.targets[wheel])) <= TARGET_TOLERANCE_PULSES
                )
                there = [*there, step] if near else []
            elif letter == "K" and values is not None and len(values) == 6 and len(there) > 1:
                speed, acceleration = motion.profile
                long = there[-1].arrived_ns - there[0].arrived_ns > NS_PER_S
                recent = step.arrived_ns - there[-1].arrived_ns < _RECENT_NS
                if not long or not recent or speed < 1 or acceleration < _SLOW_ACCELERATION:
                    continue
                seen += 1
                if values[3 * wheel] != 1:
                    findings.append(finding(step, f"{answered(step)}, {side} wheel", "a target flag of 1"))
    return Verdict(seen, findings)
