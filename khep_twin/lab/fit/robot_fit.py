"""Calibration of one robot from recorded tests; parts without a test keep their initial values."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from khep_twin.errors import FitError
from khep_twin.lab.fit.fit_inputs import FitTests, SensorData
from khep_twin.lab.fit.infrared_fit import (
    convert,
    count_deviations,
    expected_counts,
    fit_infrared,
    mean_counts,
)
from khep_twin.lab.fit.lamp_fit import LampPositions, ambient_counts, fit_lamps
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats
from khep_twin.lab.fit.motor_fit import DutyDrive, align, fit_motors, simulate
from khep_twin.lab.fit.placement import IN_PLACE, FittedValue, Misplacement, Ruler, SensorsFit
from khep_twin.lab.fit.wheel_fit import drive_residual, fit_wheels
from khep_twin.renamed import renamed_attribute
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.optics import saturated

_MAX_MISPLACEMENT = 4.0
"""Smallest misplacement of an object to be reported, in the ruler's standard deviations."""


@dataclass(frozen=True, slots=True)
class RobotFit:
    """Fitted calibration of a robot.

    Attributes:
        calibration: Calibration with the fitted values.
        values: Fitted values with their confidence intervals.
        lines: Both as text, with the names of the values that were not fitted.
        misplacements: Misplacement of each sensor test's object, by the test's name.
        drives: Drives with fixed duties in phase with the robot's controller, by name.
    """

    calibration: Calibration
    values: tuple[FittedValue, ...] = ()
    lines: tuple[str, ...] = ()
    misplacements: Mapping[str, Misplacement] = field(default_factory=dict[str, Misplacement])
    moved = renamed_attribute("moved", "misplacements")
    drives: Mapping[str, DutyDrive] = field(default_factory=dict[str, DutyDrive])


def fit_robot(tests: FitTests, start: Calibration, ruler: Ruler | None = None) -> RobotFit:
    """Fit the parts of a robot that have tests; the others keep the values of `start`.

    Args:
        tests: Recorded tests.
        start: Initial values, and those of parts without a test.
        ruler: Precision of a person's measurements; None for the default.

    Raises:
        FitError: The tests do not determine a parameter.
    """
    ruler, robot, values, lines = ruler or Ruler(), start, list[FittedValue](), list[str]()
    misplacements: dict[str, Misplacement] = {}
    drives: dict[str, DutyDrive] = {}
    radius_part = 0.0
    if tests.wheels:
        wheels, (radius, base) = fit_wheels(tests.wheels, ruler, tests.model)
        sizes = {"radius_mm": wheels.radius_mm, "base_mm": wheels.base_mm}
        robot = robot.model_copy(update={"wheels": start.wheels.model_copy(update=sizes)})
        values += radius, base
        lines += [
            f"wheel radius   {radius.value:.3f} mm +- {radius.interval:.3f} (95 %)",
            f"wheel base     {base.value:.2f} mm +- {base.interval:.2f} (95 %)",
        ]
        radius_part = radius.interval / radius.value
        ruler = replace(ruler, base=base.interval / CONFIDENCE / base.value)
    if tests.motors:
        motors = fit_motors(tests.motors, robot)
        speed, *torques = motors.values
        drives = {drive.name: drive for drive in motors.drives}
        robot = robot.model_copy(update={"motors": motors.motors})
        # A torque is as the wheels' radius squared.
        part = 2 * radius_part
        torque, friction = (replace(t, interval=max(t.interval, part * t.value)) for t in torques)
        values += speed, torque, friction
        lines += [
            f"no-load speed  {speed.value:.1f} rad/s +- {speed.interval:.1f} (95 %)",
            f"stall torque   {torque.value * 1e3:.2f} mN m +- {torque.interval * 1e3:.2f} (95 %)",
            f"gear friction  {friction.value * 1e3:.3f} mN m +- {friction.interval * 1e3:.3f} (95 %)",
        ]
        if not tests.wheels:
            lines.append("               with wheels as in --start; measured wheels improve the torque")
    for sensor_tests, fit_sensors, describe in (
        (tests.objects, fit_infrared, _infrared_lines),
        (tests.lamps, fit_lamps, _lamp_lines),
    ):
        if sensor_tests:
            fit = fit_sensors([test.readings(robot.wheels) for test in sensor_tests], robot, ruler)
            robot = fit.calibration
            values += fit.values
            lines += describe(fit, tests.model.body.ring_sensors)
            misplacements |= zip((test.name for test in sensor_tests), fit.misplacements, strict=True)
    if tests.floors:
        robot, floor_values = _fit_floors(tests.floors, robot)
        values += floor_values
        *whites, nothing = [f"{value.value:.1f} +- {value.interval:.1f}" for value in floor_values]
        lines.append(f"floor          white {', '.join(whites)}, nothing {nothing} (95 %)")
    return RobotFit(robot, tuple(values), tuple(lines), misplacements, drives)


def _fit_floors(tests: Sequence[SensorData], start: Calibration) -> tuple[Calibration, list[FittedValue]]:
    """Fit lines of counts over reflectance; return also the values: white of each sensor, nothing."""
    reflectances = np.array([test.reflectance or 0.0 for test in tests])
    if (ground := start.ground) is None or np.ptp(reflectances) == 0:
        raise FitError("the sensors of the floor cannot be determined; expected floor:white and floor:black")
    if ground.excess > 1:
        reflectances = np.array([saturated(light, 1.0) for light in (reflectances * ground.excess).tolist()])
    slopes, nothings = np.polyfit(reflectances, np.array([test.counts.mean(axis=0) for test in tests]), 1)
    *whites, nothing = np.clip([*(slopes + nothings), nothings.mean()], 0, None).round(1).tolist()
    variance = float(np.mean([test.counts.var(axis=0) for test in tests]))
    # The converter rounds to whole counts.
    width = CONFIDENCE * math.sqrt(variance / min(len(test.counts) for test in tests) + 1 / 12)
    values = [FittedValue(("ground", "white_counts", i), white, width) for i, white in enumerate(whites)]
    values.append(FittedValue(("ground", "nothing_counts"), nothing, width))
    noise = round(math.sqrt(variance), 1)
    update = {"white_counts": tuple(whites), "nothing_counts": nothing, "noise_counts": noise}
    return start.model_copy(update={"ground": ground.model_copy(update=update)}), values


def _infrared_lines(infrared: SensorsFit, names: Sequence[str]) -> Iterator[str]:
    values = {value.path[1:]: value for value in infrared.values}
    undetermined: list[str] = []
    for sensor, (name, rms) in enumerate(zip(names, infrared.rms, strict=True)):
        gain = values["gain_counts_mm2", sensor]
        texts = [f"gain {gain.value:.4g} +- {gain.interval / gain.value:.1%}"]
        for quantity, key, digits in (
            ("threshold", "threshold_counts", 0),
            ("heading", "heading_deg", 1),
            ("lobe", "lobe_exponent", 2),
            ("noise", "noise_counts", 1),
        ):
            if (fitted := values.get((key, sensor))) is None:
                undetermined.append(f"{quantity} of {name}")
            else:
                texts.append(f"{quantity} {fitted.value:.{digits}f} +- {fitted.interval:.{digits}f}")
        yield f"{name:10}     {', '.join(texts)} (95 %), {rms:.1f} counts rms left"
    if undetermined:
        yield f"as in --start  not determined by these tests: {', '.join(undetermined)}"


def _lamp_lines(lamps: SensorsFit, names: Sequence[str]) -> Iterator[str]:
    values = {value.path[1:]: value for value in lamps.values}
    for sensor, name in enumerate(names):
        heading, gain = values["heading_deg", sensor], values["gain_counts_mm2_per_w", sensor]
        lobe = values["lobe_exponent", sensor]
        yield (
            f"{name:10}     heading to lamps {heading.value:.1f} +- {heading.interval:.1f} degrees, "
            f"gain {gain.value:.4g} +- {gain.interval / gain.value:.1%}, "
            f"lobe {lobe.value:.2f} +- {lobe.interval:.2f} (95 %)"
        )
    dark, diffuse = values["dark_counts",], values["diffuse",]
    yield (
        f"light          dark {dark.value:g} +- {dark.interval:.1f}, brightest "
        f"{lamps.calibration.ambient.floor_counts:g}, diffuse part {diffuse.value:g} +- "
        f"{diffuse.interval:.3f} (95 %), {lamps.rms[0]:.1f} counts rms left"
    )


def describe_residuals(tests: FitTests, fit: RobotFit, ruler: Ruler | None = None) -> Iterator[str]:
    """Yield a line of text with the residuals of each test; the tests may be others than those of the fit."""
    robot = fit.calibration
    for drive in tests.wheels:
        sizes = robot.wheels.radius_mm / 1e3, robot.wheels.base_mm / 1e3
        error = drive_residual(drive, *sizes, tests.model.body.pulses_per_turn)
        text = f"{np.degrees(error):+.2f} degrees" if drive.distance is None else f"{error * 1e3:+.2f} mm"
        yield f"{drive.name}: {text}"
    for drive in tests.motors:
        aligned_drive = fit.drives.get(drive.name) or align(drive, robot)
        residuals = simulate(aligned_drive, robot) - aligned_drive.speeds(aligned_drive.values)
        yield f"{drive.name}: {np.sqrt(np.mean(residuals**2)):.2f} pulses/10 ms rms"
    for test in (*tests.objects, *tests.lamps):
        misplacement = fit.misplacements.get(test.name, IN_PLACE)
        rms = _rms(simulate_readings(test, robot, misplacement) - test.counts)
        noise = _rms(_noise_deviations(test, robot, misplacement))
        text = f"{test.name}: {rms:.1f} counts rms, of which the sensors' noise is {noise:.1f}"
        if misplacement is not IN_PLACE:
            bearing_deg = math.degrees(misplacement.bearing)
            text += f", at {misplacement.distance * 1e3:+.2f} mm and {bearing_deg:+.1f} degrees,"
        # Allow a model error of 8 counts, or as much as the noise.
        is_large = rms > 2 * np.hypot(noise, 8) or _is_misplaced(misplacement, ruler or Ruler())
        yield text + ("; check the object and its distance" if is_large else "")


def _is_misplaced(misplacement: Misplacement, ruler: Ruler) -> bool:
    """Return whether an object is too far from its measured position for a ruler with these errors."""
    off_mm, off_deg = abs(misplacement.distance) * 1e3, abs(math.degrees(misplacement.bearing))
    # Even with an exact ruler, the fitted position also absorbs errors of the optics' model.
    limits = max(ruler.distance_mm, 0.5), max(ruler.bearing_deg, 1.5)
    return off_mm > _MAX_MISPLACEMENT * limits[0] or off_deg > _MAX_MISPLACEMENT * limits[1]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _noise_deviations(test: SensorData, robot: Calibration, misplacement: Misplacement) -> Floats:
    """Return the standard deviation of each reading (n, n_sensors), or a common one."""
    if test.power is not None:
        return np.array(robot.ambient.noise_counts)
    return count_deviations(*_proximity_counts(test, robot, misplacement), robot.proximity)


def simulate_readings(test: SensorData, robot: Calibration, misplacement: Misplacement = IN_PLACE) -> Floats:
    """Return the mean readings of a robot with a calibration in a sensor test (n, n_sensors)."""
    if test.power is not None:
        lamp = LampPositions.of(test.readings(robot.wheels), misplacement)
        channels = range(len(robot.heading_deg))
        return np.column_stack(
            [ambient_counts(lamp, channel, robot.ambient, robot.largest_count) for channel in channels]
        )
    return expected_counts(*_proximity_counts(test, robot, misplacement), robot.proximity)


def _proximity_counts(
    test: SensorData, robot: Calibration, misplacement: Misplacement
) -> tuple[Floats, Floats]:
    """Return the counts of an object before clipping, and their noise (n, n_sensors)."""
    proximity = robot.proximity
    levels = mean_counts(test.readings(robot.wheels).placement, robot, misplacement)
    counts, growth = convert(levels, proximity.threshold_counts, proximity)
    return counts, np.array(proximity.noise_counts) * growth


def with_name(calibration: Calibration, stem: str, method: str) -> Calibration:
    """Return a calibration with a name derived from a file's stem, and the method in its source."""
    name = re.sub("[^A-Za-z0-9_-]", "-", stem)[:64] or "robot"
    return calibration.model_copy(update={"name": name, "source": f"{calibration.source}; {method}"})
