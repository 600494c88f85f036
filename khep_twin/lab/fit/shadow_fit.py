"""Calibration from the values that a shadow learned of its robot: wheels, and the gains of its sensors.

A shadow's log has them in channel `/shadow/learned`; for a relay's log, a shadow follows the recorded serial
line first. A value keeps its initial value if the robot's drive did not determine it better than its prior.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from khep_twin.errors import CalibrationError, FitError
from khep_twin.files import toml_files
from khep_twin.lab.fit.least_squares import CONFIDENCE, MAX_DEVIATION_RATIO
from khep_twin.lab.fit.placement import FittedValue
from khep_twin.lab.fit.robot_fit import RobotFit
from khep_twin.log.attached import playpen_of
from khep_twin.log.reader import read_arrays
from khep_twin.log.shadow_channels import is_shadow
from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration
from khep_twin.shadow.following import Follower
from khep_twin.shadow.particles import LearnedValues, value_names
from khep_twin.shadow.recording import read_recording
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.start import PUBLISHED

_WHEELS = "radius_mm", "right_over_left", "base_mm"
_FORMATS = {
    "radius_mm": ("wheel radius", "{:.3f} mm +- {:.3f}"),
    "right_over_left": ("right over left", "{:.4f} +- {:.4f}"),
    "base_mm": ("wheel base", "{:.2f} mm +- {:.2f}"),
}


def read_learned(path: Path) -> tuple[LearnedValues, Calibration, Sequence[str]] | None:
    """Return the values at the end of a shadow's log, its calibration and sensors; None for another log.

    Raises:
        LogError: The log cannot be read.
        FitError: The shadow received no replies with values.
    """
    label, arrays = read_arrays(path)
    if not is_shadow(label):
        return None
    values = arrays.get("/shadow/learned", (None, np.empty((0, 0))))[1]
    sensors = playpen_of(label.attachments, path).robots[0].body.ring_sensors
    if not len(values) or values.shape[1] != len(value_names(sensors)):
        raise FitError(f"{path}: this shadow has learned nothing; expected replies to N in its log")
    text = next((text for name, text in label.attachments.items() if name.startswith("calibration/")), "")
    start = toml_files.validate(Calibration, text, f"{path}: calibration", CalibrationError)
    return LearnedValues.from_row(values[-1]), start, sensors


def learn_from_log(
    path: Path, playpen_name: str, progress: Callable[[float], None] | None
) -> tuple[LearnedValues, Calibration, Sequence[str]]:
    """Follow a relay's log; return the values that a shadow learns, its calibration and sensors.

    Args:
        path: Path of the log.
        playpen_name: Name or path of the playpen, with the robot's start and calibration.
        progress: Called with the completed share, 0 to 1.

    Raises:
        LogError: The log cannot be read.
        PlaypenError: The playpen cannot be used.
    """
    playpen = Playpen.load(playpen_name)
    recording = read_recording(path, model=playpen.robots[0].robot_model)
    settings = ShadowSettings() if recording.baud is None else ShadowSettings(baud=recording.baud)
    follower = Follower(shadow := Shadow(playpen, settings))
    for number, chunk in enumerate(recording.chunks):
        for _ in follower.feed(chunk):
            pass
        if progress is not None:
            progress(number / len(recording.chunks))
    if not follower.replies:
        raise FitError(f"{path}: no reply with values; expected replies to N")
    robot = playpen.robots[0]
    return shadow.learned, calibration.read(robot.calibration)[0], robot.body.ring_sensors


def fit_learned(learned: LearnedValues, start: Calibration, sensors: Sequence[str]) -> RobotFit:
    """Return the calibration of a robot with these sensors from the values of a shadow that used `start`."""
    values, lines, undetermined = list[FittedValue](), list[str](), list[str]()
    wheel_values, gains = dict[str, float](), list(start.proximity.gain_counts_mm2)
    for fitted_value, prior_interval in learned_values(learned, start):
        key, sensor = fitted_value.path[1], fitted_value.path[2] if len(fitted_value.path) > 2 else None
        name, form = _FORMATS[key] if sensor is None else (sensors[sensor], "gain {:.4g} +- {:.4g}")
        if fitted_value.interval > MAX_DEVIATION_RATIO * prior_interval:
            undetermined.append(name if sensor is None else f"gain of {name}")
            continue
        values.append(fitted_value)
        lines.append(f"{name:15}  {form.format(fitted_value.value, fitted_value.interval)} (95 %)")
        if sensor is None:
            wheel_values[key] = fitted_value.value
        else:
            gains[sensor] = fitted_value.value
    if undetermined:
        lines.append(f"as before        not determined by this drive: {', '.join(undetermined)}")
    proximity = start.proximity.model_copy(update={"gain_counts_mm2": tuple(gains)})
    wheels = start.wheels.model_copy(update=wheel_values)
    calibrated = start.model_copy(update={"wheels": wheels, "proximity": proximity})
    return RobotFit(calibrated, tuple(values), tuple(lines))


def learned_values(learned: LearnedValues, start: Calibration) -> Iterator[tuple[FittedValue, float]]:
    """Yield each value with its interval, and the half width of its interval before the fit."""
    priors = PUBLISHED.radius, PUBLISHED.ratio, PUBLISHED.base
    ratios, deviations = learned.wheels.tolist(), learned.wheel_deviations.tolist()
    for key, ratio, deviation, prior in zip(_WHEELS, ratios, deviations, priors, strict=True):
        unit = CONFIDENCE * float(getattr(start.wheels, key))
        yield FittedValue(("wheels", key), unit / CONFIDENCE * ratio, unit * deviation), unit * prior
    prior = math.hypot(PUBLISHED.gain, calibration.GAIN_SPREAD)
    gains = start.proximity.gain_counts_mm2
    ratios, deviations = learned.gains.tolist(), learned.gain_deviations.tolist()
    for sensor, (gain, ratio, deviation) in enumerate(zip(gains, ratios, deviations, strict=True)):
        unit = CONFIDENCE * gain * ratio
        path = ("proximity", "gain_counts_mm2", sensor)
        yield FittedValue(path, gain * ratio, unit * deviation), unit * prior
