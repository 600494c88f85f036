"""Checks of a recording's sensor readings, which depend on where the robot was."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, answered, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import Reading, read
from khep_twin.units import COUNTS_LIMIT, N_SENSORS, STEP_NS

_READINGS = 200
"""Readings in a row that a working sensor cannot repeat while others change (assumed)."""

_LIVELY = 0.2
"""Share of readings that differ from the one before, from which a sensor is said to change (assumed)."""

_OTHERS = 4
"""Number of other sensors that have to change."""

_DIFFERENT = 50
"""Different values of each other sensor, of a robot that has been near things on all sides (assumed)."""

_DARK = 10
"""Proximity below which nothing is near [counts] (assumed)."""

_FAR_PULSES = 1000
"""Travel of a wheel in which the readings of a robot change [pulses] (assumed)."""


@check("readings within one scan are the same but for the sensors converted meanwhile", "3.1.5")
def one_scan(line: RecordedLine) -> Verdict:
    seen, findings = 0, list[Finding]()
    changes_ns = np.array(line.changes_ns, np.int64)
    for letter in "NO":
        before: Reading | None = None
        for step, values in read(line, letter):
            if before is not None:
                from_ns, until_ns = before[0].arrived_ns, step.read_ns
                converted = (until_ns - from_ns) // STEP_NS + 2
                moved = np.any((changes_ns >= from_ns) & (changes_ns <= until_ns))
                if converted < N_SENSORS and not moved:
                    seen += 1
                    changed = sum(now != then for then, now in zip(before[1], values, strict=True))
                    if changed > converted:
                        took_ms = (until_ns - from_ns) / 1e6
                        found = f"{answered(step)}, {changed} values changed in {took_ms:.1f} ms"
                        findings.append(finding(step, found, f"at most {converted}"))
            before = step, values
    return Verdict(seen, findings)


@check("no sensor repeats its reading while others change", "3.1.5")
def stuck_sensors(line: RecordedLine) -> Verdict:
    seen, findings = 0, list[Finding]()
    for letter, name in (("N", "proximity"), ("O", "ambient light")):
        found = list(read(line, letter)) if line.noisy else []
        seen += len(found) // _READINGS
        if len(found) < _READINGS:
            continue
        values: NDArray[np.int64] = np.array([each for _, each in found], np.int64)
        changed = np.diff(values, axis=0) != 0
        for sensor in range(N_SENSORS):
            span = (0, len(found)) if _is_dead(values, sensor) else _repeated(values, changed, sensor)
            if span is not None:
                first, last = span
                text = f"{values[first, sensor]} of sensor {sensor}, {name}, in {last - first} readings"
                findings.append(finding(found[first][0], text, "other values, as of the other sensors"))
    return Verdict(seen, findings)


def _repeated(values: NDArray[np.int64], changed: NDArray[np.bool_], sensor: int) -> tuple[int, int] | None:
    """Return the first span in which a sensor repeats its reading while others change; None without."""
    places: list[int] = np.flatnonzero(changed[:, sensor]).tolist()
    ends = [0, *(place + 1 for place in places), len(values)]
    for first, last in pairwise(ends):
        if last - first < _READINGS or not 0 < values[first, sensor] < COUNTS_LIMIT:
            continue
        if np.count_nonzero(changed[first : last - 1].mean(axis=0) > _LIVELY) >= _OTHERS:
            return first, last
    return None


def _is_dead(values: NDArray[np.int64], sensor: int) -> bool:
    """Return whether a sensor is at a limit of its range in the whole log, while each other has seen much."""
    if len(values) < 3 * _READINGS or values[0, sensor] not in (0, COUNTS_LIMIT):
        return False
    different = [len(np.unique(values[:, other])) for other in range(N_SENSORS)]
    return different.pop(sensor) == 1 and min(different) >= _DIFFERENT


def _windows(line: RecordedLine, letter: str) -> Iterator[tuple[list[RecordedStep], NDArray[np.int64]]]:
    """Yield windows of readings, each with its steps and values (readings, sensors)."""
    found = list(read(line, letter)) if line.noisy else []
    for start in range(0, len(found) - _READINGS + 1, _READINGS):
        window = found[start : start + _READINGS]
        yield [step for step, _ in window], np.array([values for _, values in window], np.int64)


@check("readings change while the robot drives", "3.1.5")
def frozen_readings(line: RecordedLine) -> Verdict:
    seen, findings = 0, list[Finding]()
    distances = _travelled(line)
    for letter in "NO":
        for steps, values in _windows(line, letter):
            driven = _travel_between(distances, steps[0].arrived_ns, steps[-1].arrived_ns)
            if driven < _FAR_PULSES or (letter == "N" and values.max() <= _DARK):
                continue
            seen += 1
            if not np.diff(values, axis=0).any():
                found = f"{answered(steps[0])} and {len(steps) - 1} times the same, over {driven} pulses"
                findings.append(finding(steps[0], found, "other values"))
    return Verdict(seen, findings)


def _travelled(line: RecordedLine) -> NDArray[np.int64]:
    """Return times [ns] and counters of the replies to H (n, 3), or else those that D's speeds would give."""
    counters = [(step.arrived_ns, *values) for step, values in read(line, "H")]
    if len(counters) > 1:
        return np.array(counters, np.int64)
    rows, left, right, last_ns, speeds = list[tuple[int, int, int]](), 0.0, 0.0, 0, (0, 0)
    for step in line.steps:
        ticks = (step.arrived_ns - last_ns) / 10e6
        left, right, last_ns = left + speeds[0] * ticks, right + speeds[1] * ticks, step.arrived_ns
        speeds = step.motion.speeds if step.motion is not None else (0, 0)
        rows.append((last_ns, int(left), int(right)))
    return np.array(rows, np.int64).reshape(-1, 3)


def _travel_between(distances: NDArray[np.int64], from_ns: int, until_ns: int) -> int:
    """Return the larger of the wheels' distances between two times [pulses]."""
    within = distances[(distances[:, 0] >= from_ns) & (distances[:, 0] <= until_ns), 1:]
    return int(np.abs(np.diff(within, axis=0)).sum(axis=0).max()) if len(within) > 1 else 0
