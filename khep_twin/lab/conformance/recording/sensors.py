"""Checks of a recording's sensor readings, which depend on the robot's surroundings."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from khep_twin.lab.conformance.recording.board_model import RecordedStep
from khep_twin.lab.conformance.recording.check import Finding, Verdict, check, finding
from khep_twin.lab.conformance.recording.recorded_line import RecordedLine
from khep_twin.lab.conformance.recording.replies import Reading, read_values
from khep_twin.units import COUNTS_LIMIT, N_SENSORS, STEP_NS

_N_READINGS = 200
"""Number of equal consecutive readings of a stuck sensor while others change (assumed)."""
_LIVELY_SHARE = 0.2
"""Smallest share of readings that differ from the previous one, of a sensor that changes (assumed)."""
_MIN_CHANGING = 4
"""Smallest number of other sensors that change."""
_MIN_DISTINCT = 50
"""Smallest number of distinct readings of a sensor that was near objects (assumed)."""
_FREE_COUNTS = 10
"""Proximity below which no object is near [counts] (assumed)."""
_MIN_TRAVEL_PULSES = 1000
"""Travel of a wheel in which the readings of a robot change [pulses] (assumed)."""


@check("readings within one scan are equal, except of sensors converted in between", "3.1.5")
def one_scan(line: RecordedLine) -> Verdict:
    n_checked, findings = 0, list[Finding]()
    changes_ns = np.array(line.changes_ns, np.int64)
    for letter in "NO":
        previous: Reading | None = None
        for step, values in read_values(line, letter):
            if previous is not None:
                from_ns, until_ns = previous[0].arrived_ns, step.read_ns
                n_converted = (until_ns - from_ns) // STEP_NS + 2
                has_moved = np.any((changes_ns >= from_ns) & (changes_ns <= until_ns))
                if n_converted < N_SENSORS and not has_moved:
                    n_checked += 1
                    n_changed = sum(new != old for old, new in zip(previous[1], values, strict=True))
                    if n_changed > n_converted:
                        duration_ms = (until_ns - from_ns) / 1e6
                        observation = f"{step.reply_text}, {n_changed} values changed in {duration_ms:.1f} ms"
                        findings.append(finding(step, observation, f"at most {n_converted}"))
            previous = step, values
    return Verdict(n_checked, findings)


@check("no sensor repeats its reading while others change", "3.1.5")
def stuck_sensors(line: RecordedLine) -> Verdict:
    n_checked, findings = 0, list[Finding]()
    for letter, name in (("N", "proximity"), ("O", "ambient light")):
        readings = list(read_values(line, letter)) if line.noisy else []
        n_checked += len(readings) // _N_READINGS
        if len(readings) < _N_READINGS:
            continue
        values: NDArray[np.int64] = np.array([counts for _, counts in readings], np.int64)
        changes = np.diff(values, axis=0) != 0
        for sensor in range(N_SENSORS):
            span = (0, len(readings)) if _is_dead(values, sensor) else _find_span(values, changes, sensor)
            if span is not None:
                start, stop = span
                text = f"{values[start, sensor]} of sensor {sensor}, {name}, in {stop - start} readings"
                findings.append(finding(readings[start][0], text, "changing values, as of the other sensors"))
    return Verdict(n_checked, findings)


def _find_span(values: NDArray[np.int64], changes: NDArray[np.bool_], sensor: int) -> tuple[int, int] | None:
    """Return the first span in which a sensor repeats its reading while others change, or None."""
    indices: list[int] = np.flatnonzero(changes[:, sensor]).tolist()
    ends = [0, *(index + 1 for index in indices), len(values)]
    for first, last in pairwise(ends):
        if last - first < _N_READINGS or not 0 < values[first, sensor] < COUNTS_LIMIT:
            continue
        if np.count_nonzero(changes[first : last - 1].mean(axis=0) > _LIVELY_SHARE) >= _MIN_CHANGING:
            return first, last
    return None


def _is_dead(values: NDArray[np.int64], sensor: int) -> bool:
    """Return whether a sensor is always at a limit of its range, while the others have many readings."""
    if len(values) < 3 * _N_READINGS or values[0, sensor] not in (0, COUNTS_LIMIT):
        return False
    n_distinct = [len(np.unique(values[:, other])) for other in range(N_SENSORS)]
    return n_distinct.pop(sensor) == 1 and min(n_distinct) >= _MIN_DISTINCT


def _windows(line: RecordedLine, letter: str) -> Iterator[tuple[list[RecordedStep], NDArray[np.int64]]]:
    """Yield windows of readings, each with its steps and values (readings, sensors)."""
    readings = list(read_values(line, letter)) if line.noisy else []
    for start in range(0, len(readings) - _N_READINGS + 1, _N_READINGS):
        window = readings[start : start + _N_READINGS]
        yield [step for step, _ in window], np.array([values for _, values in window], np.int64)


@check("readings change while the robot drives", "3.1.5")
def frozen_readings(line: RecordedLine) -> Verdict:
    n_checked, findings = 0, list[Finding]()
    distances = _wheel_counters(line)
    for letter in "NO":
        for steps, values in _windows(line, letter):
            travel = _travel_between(distances, steps[0].arrived_ns, steps[-1].arrived_ns)
            if travel < _MIN_TRAVEL_PULSES or (letter == "N" and values.max() <= _FREE_COUNTS):
                continue
            n_checked += 1
            if not np.diff(values, axis=0).any():
                observation = f"{steps[0].reply_text}, repeated {len(steps) - 1} times over {travel} pulses"
                findings.append(finding(steps[0], observation, "other values"))
    return Verdict(n_checked, findings)


def _wheel_counters(line: RecordedLine) -> NDArray[np.int64]:
    """Return times [ns] and counters (n, 3) by the replies to H, or else integrated from D's speeds."""
    counters = [(step.arrived_ns, *values) for step, values in read_values(line, "H")]
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
    """Return the larger one of the wheels' path lengths between two times [pulses]."""
    counters = distances[(distances[:, 0] >= from_ns) & (distances[:, 0] <= until_ns), 1:]
    return int(np.abs(np.diff(counters, axis=0)).sum(axis=0).max()) if len(counters) > 1 else 0
