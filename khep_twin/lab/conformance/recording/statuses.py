"""Checks of a recording's status of the motors, the replies to K."""

from collections.abc import Callable, Iterator
from itertools import pairwise

from khep_twin.board.kernel import TARGET_TOLERANCE_PULSES, Mode, wrap
from khep_twin.board.protocol import SETPOINT_COMMANDS
from khep_twin.board.rom import ROMS
from khep_twin.clock import NS_PER_S
from khep_twin.lab.conformance.recording.board_model import MotorSettings, RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import MAX_SPEED, Reading, read_values
from khep_twin.lab.conformance.recording.wheels import SIDES

_MAX_PUSH_PULSES = 10
"""Largest distance by which a wheel on its target may be off between two statuses [pulses] (assumed)."""
_SLOW_ACCELERATION = 16
"""Smallest acceleration of J for an arrival within a second [pulses/256 per (10 ms)^2]."""
_RECENT_NS = NS_PER_S // 2
"""Largest age of the last counter of a wheel on its target [ns] (assumed)."""


def _check_status(
    line: RecordedLine, deviation: Callable[[RecordedStep, MotorSettings, int, tuple[int, ...]], str]
) -> Verdict:
    """Return the verdict over each wheel in each reply to K.

    Args:
        line: Line.
        deviation: Function of a step, its motion, the wheel, and the wheel's target flag, mode and error.
            It returns "" if these are right, "?" if they cannot be checked, else the expected value.
    """
    n_checked, findings = 0, list[Finding]()
    for step, values in read_values(line, "K"):
        if step.motion is None:
            continue
        for wheel, side in enumerate(SIDES):
            expected = deviation(step, step.motion, wheel, values[3 * wheel : 3 * wheel + 3])
            n_checked += expected != "?"
            if expected not in ("", "?"):
                findings.append(finding(step, f"{step.reply_text}, {side} wheel", expected))
    return Verdict(n_checked, findings)


@check("K has the mode that D, C, P or a restart has set", "A, command K")
def modes(line: RecordedLine) -> Verdict:
    codes = ROMS[line.rom].mode_codes

    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
        code = codes[motion.modes[wheel]]
        return "" if status[1] == code else f"mode {code}, {motion.modes[wheel].name.lower()}"

    return _check_status(line, deviation)


@check("K's target flag is 0 after D and P, 1 after a restart, and otherwise 0 or 1", "A, command K; assumed")
def flags(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
        if motion.modes[wheel] == Mode.POSITION:
            return "" if status[0] in (0, 1) else "a target flag of 0 or 1"
        expected = motion.on_target[wheel]
        return "" if status[0] == expected else f"a target flag of {expected}"

    return _check_status(line, deviation)


@check("K's error is that of the controller: 0 in PWM mode, small on a target", "A, command K; assumed")
def errors(line: RecordedLine) -> Verdict:
    def deviation(step: RecordedStep, motion: MotorSettings, wheel: int, status: tuple[int, ...]) -> str:
        match motion.modes[wheel]:
            case Mode.PWM:
                limit = 0
            case Mode.SPEED:
                limit = abs(motion.speeds[wheel]) + MAX_SPEED
            case Mode.POSITION:
                limit = TARGET_TOLERANCE_PULSES if status[0] == 1 else 2**31
        return "" if abs(status[2]) <= limit else f"an error of at most {limit}"

    return _check_status(line, deviation)


@check("a wheel that is on its target by K has the counter of C", "A, commands C, H and K")
def counters_on_target(line: RecordedLine) -> Verdict:
    n_checked, findings = 0, list[Finding]()
    for first, (step, values), last in _between_status(line):
        for wheel, side in enumerate(SIDES):
            motion = step.motion
            is_on_target = first[1][3 * wheel] == 1 == last[1][3 * wheel]
            if motion is None or not is_on_target or motion.modes[wheel] != Mode.POSITION:
                continue
            n_checked += 1
            target = _target_in_counts(first[0], step, last[0], wheel)
            if target is not None and abs(wrap(values[wheel] - target)) > _MAX_PUSH_PULSES:
                findings.append(finding(step, f"{step.reply_text}, {side} wheel", f"{target}, its target"))
    return Verdict(n_checked, findings)


def _between_status(line: RecordedLine) -> Iterator[tuple[Reading, Reading, Reading]]:
    """Yield each reply to H between two replies to K without a motor command, with these replies."""
    last_status: Reading | None = None
    counters: list[Reading] = []
    changes = list(line.changes_ns)
    for step in line.steps:
        values, letter = step.exchange.values, step.exchange.letter
        is_moved = bool(changes) and changes[0] <= step.exchange.sent_ns
        while changes and changes[0] <= step.exchange.sent_ns:
            changes.pop(0)
        if is_moved or step.restarts or letter in ("", *SETPOINT_COMMANDS):
            last_status, counters = None, []
        elif letter == "H" and values is not None and len(values) == 2:
            counters.append((step, values))
        elif letter == "K" and values is not None and len(values) == 6:
            if last_status is not None:
                yield from ((last_status, counter, (step, values)) for counter in counters)
            last_status, counters = (step, values), []


def _target_in_counts(first: RecordedStep, step: RecordedStep, last: RecordedStep, wheel: int) -> int | None:
    """Return the target of a wheel in counts of H; None if it is not known."""
    motions = [item.motion for item in (first, step, last)]
    targets = {motion.targets[wheel] if motion and motion.targets else None for motion in motions}
    return targets.pop() if len(targets) == 1 else None


@check("K reports a wheel on its target within a second", "A, commands C, H and K")
def arrival_in_time(line: RecordedLine) -> Verdict:
    """Check the status of wheels whose counters have been on the target for a second."""
    n_checked, findings = 0, list[Finding]()
    for wheel, side in enumerate(SIDES):
        on_target_steps: list[RecordedStep] = []
        for previous, step in pairwise(line.steps):
            motion, values, letter = step.motion, step.exchange.values, step.exchange.letter
            is_positioning = motion is not None and motion.modes[wheel] == Mode.POSITION
            if (
                motion is None
                or not is_positioning
                or letter in ("", *SETPOINT_COMMANDS)
                or previous.motion != motion
            ):
                on_target_steps = []
            elif letter == "H" and values is not None and len(values) == 2:
                is_near = motion.targets is not None and (
                    abs(wrap(values[wheel] - motion.targets[wheel])) <= TARGET_TOLERANCE_PULSES
                )
                on_target_steps = [*on_target_steps, step] if is_near else []
            elif letter == "K" and values is not None and len(values) == 6 and len(on_target_steps) > 1:
                speed, acceleration = motion.profile
                is_long = on_target_steps[-1].arrived_ns - on_target_steps[0].arrived_ns > NS_PER_S
                is_recent = step.arrived_ns - on_target_steps[-1].arrived_ns < _RECENT_NS
                if not is_long or not is_recent or speed < 1 or acceleration < _SLOW_ACCELERATION:
                    continue
                n_checked += 1
                if values[3 * wheel] != 1:
                    findings.append(finding(step, f"{step.reply_text}, {side} wheel", "a target flag of 1"))
    return Verdict(n_checked, findings)
