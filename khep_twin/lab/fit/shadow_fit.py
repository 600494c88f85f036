"""Calibration from what a shadow has learned of its robot: wheels, and the gains of its sensors.

The shadow's log has it in `/shadow/learned`; the line of a relay is followed first. Values that the robot's
drive has not determined better than they were known before stay as they were.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from khep_twin.errors import CalibrationError, FitError
from khep_twin.files import toml_files
from khep_twin.lab.fit.least_squares import CONFIDENCE, DETERMINED
from khep_twin.lab.fit.robot_fit import FittedValue, RobotFit
from khep_twin.log.reader import read_arrays
from khep_twin.log.shadow_channels import is_shadow
from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration
from khep_twin.shadow.following import Follower
from khep_twin.shadow.particles import VALUE_NAMES, LearnedValues
from khep_twin.shadow.recording import recorded
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.start import PUBLISHED
from khep_twin.units import SENSOR_LABELS

_WHEELS = "radius_mm", "right_over_left", "base_mm"
_TOLD = {
    "radius_mm": ("wheel radius", "{:.3f} mm +- {:.3f}"),
    "right_over_left": ("right over left", "{:.4f} +- {:.4f}"),
    "base_mm": ("wheel base", "{:.2f} mm +- {:.2f}"),
}


def read_learned(path: Path) -> tuple[LearnedValues, Calibration] | None:
    """Return what the shadow of a log had learned at its end, and its calibration; None of another log.

    Raises:
        LogError: The log cannot be read.
        FitError: The shadow had heard nothing.
    """
    label, arrays = read_arrays(path)
    if not is_shadow(label):
        return None
    values = arrays.get("/shadow/learned", (None, np.empty((0, 0))))[1]
    if not len(values) or values.shape[1] != len(VALUE_NAMES):
        raise FitError(f"{path}: this shadow has learned nothing; expected replies to N in its log")
    text = next((text for name, text in label.attachments.items() if name.startswith("calibration/")), "")
    start = toml_files.validate(Calibration, text, f"{path}: calibration", CalibrationError)
    return LearnedValues.of_row(values[-1]), start


def follow_all(
    path: Path, playpen: str, progress: Callable[[float], None] | None
) -> tuple[LearnedValues, Calibration]:
    """Follow the line of a relay's log; return what a shadow learns from it, and its calibration.

    Args:
        path: Path of the log.
        playpen: Name or path of the playpen, with the robot's start and calibration.
        progress: Function that takes the share that is done, 0 to 1.

    Raises:
        LogError: The log cannot be read.
        PlaypenError: The playpen cannot be used.
    """
    line, found = recorded(path), Playpen.load(playpen)
    settings = ShadowSettings() if line.baud is None else ShadowSettings(baud=line.baud)
    follower = Follower(shadow := Shadow(found, settings))
    for number, heard in enumerate(line.heard):
        for _ in follower.feed(heard):
            pass
        if progress is not None:
            progress(number / len(line.heard))
    if not follower.replies:
        raise FitError(f"{path}: no reply with values; expected replies to N")
    return shadow.learned, calibration.read(found.robots[0].calibration)[0]


def fit_learned(found: LearnedValues, start: Calibration) -> RobotFit:
    """Return the calibration of a robot that a shadow has followed with `start`."""
    values, lines, kept = list[FittedValue](), list[str](), list[str]()
    wheels, gains = dict[str, float](), list(start.proximity.gain_counts_mm2)
    for each, known in learned_values(found, start):
        key, sensor = each.path[1], each.path[2] if len(each.path) > 2 else None
        name, words = _TOLD[key] if sensor is None else (SENSOR_LABELS[sensor], "gain {:.4g} +- {:.4g}")
        if each.interval > DETERMINED * known:
            kept.append(name if sensor is None else f"gain of {name}")
            continue
        values.append(each)
        lines.append(f"{name:15}  {words.format(each.value, each.interval)} (95 %)")
        if sensor is None:
            wheels[key] = each.value
        else:
            gains[sensor] = each.value
    if kept:
        lines.append(f"as before        not determined by this drive: {', '.join(kept)}")
    near = start.proximity.model_copy(update={"gain_counts_mm2": tuple(gains)})
    turning = start.wheels.model_copy(update=wheels)
    return RobotFit(
        start.model_copy(update={"wheels": turning, "proximity": near}), tuple(values), tuple(lines)
    )


def learned_values(found: LearnedValues, start: Calibration) -> Iterator[tuple[FittedValue, float]]:
    """Yield all values with their intervals, and the intervals in which they were known before."""
    known = PUBLISHED.radius, PUBLISHED.ratio, PUBLISHED.base
    parts, deviations = found.wheels.tolist(), found.wheel_deviations.tolist()
    for key, part, deviation, before in zip(_WHEELS, parts, deviations, known, strict=True):
        unit = CONFIDENCE * float(getattr(start.wheels, key))
        yield FittedValue(("wheels", key), unit / CONFIDENCE * part, unit * deviation), unit * before
    before = math.hypot(PUBLISHED.gain, calibration.GAIN_SPREAD)
    for sensor, (gain, part, deviation) in enumerate(
        zip(
            start.proximity.gain_counts_mm2,
            found.gains.tolist(),
            found.gain_deviations.tolist(),
            strict=True,
        )
    ):
        unit = CONFIDENCE * gain * part
        path = ("proximity", "gain_counts_mm2", sensor)
        yield FittedValue(path, gain * part, unit * deviation), unit * before
