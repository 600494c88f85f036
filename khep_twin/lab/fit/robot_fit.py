"""Calibration of one robot from recorded tests; parts without a test keep their initial values."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from khep_twin.lab.fit.fit_inputs import FitTests, SensorData
from khep_twin.lab.fit.infrared_fit import InfraredFit, apply_fit, fit_infrared, mean_counts
from khep_twin.lab.fit.lamp_fit import LampFit, LampPositions, ambient_counts, fit_lamps
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats, expected_readings, reading_deviations
from khep_twin.lab.fit.motor_fit import DutyDrive, align, fit_motors, simulate
from khep_twin.lab.fit.placement import IN_PLACE, Misplacement, Ruler
from khep_twin.lab.fit.wheel_fit import drive_residual, fit_wheels
from khep_twin.renamed import renamed_attribute
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS, SENSOR_LABELS

_MAX_MISPLACEMENT = 4.0
"""Smallest misplacement of an object to be reported, in the ruler's standard deviations."""


@dataclass(frozen=True, slots=True)
class FittedValue:
    """Fitted value of a calibration.

    Attributes:
        path: Location in the calibration: table, key, and number of the sensor.
        value: Fitted value, in the calibration's unit.
        interval: Half width of its 95 % confidence interval.
    """

    path: tuple[str, str] | tuple[str, str, int]
    value: float
    interval: float

    def value_in(self, calibration: Calibration) -> float:
        """Return the value of another calibration at the same path."""
        table, key, *sensor = self.path
        values = np.atleast_1d(getattr(getattr(calibration, table) if table else calibration, str(key)))
        return float(values[sensor[0] if len(values) > 1 else 0])


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
    if tests.wheels:
        wheels = fit_wheels(tests.wheels, ruler)
        robot = robot.model_copy(update={"wheels": wheels.calibration()})
        radius, base = ((x * 1e3) for x in (wheels.radius, wheels.base))
        intervals = wheels.radius_interval * 1e3, wheels.base_interval * 1e3
        values += [
            FittedValue(("wheels", "radius_mm"), radius, intervals[0]),
            FittedValue(("wheels", "base_mm"), base, intervals[1]),
        ]
        lines += [
            f"wheel radius   {radius:.3f} mm +- {intervals[0]:.3f} (95 %)",
            f"wheel base     {base:.2f} mm +- {intervals[1]:.2f} (95 %)",
        ]
        ruler = replace(ruler, base=wheels.base_interval / CONFIDENCE / wheels.base)
    if tests.motors:
        motors = fit_motors(tests.motors, robot)
        drives = {drive.name: drive for drive in motors.drives}
        robot = robot.model_copy(update={"motors": motors.motors})
        speed, torque = motors.motors.no_load_speed_rad_s, motors.motors.stall_torque_n_m
        friction = motors.motors.friction_torque_n_m
        values += [
            FittedValue(("motors", "no_load_speed_rad_s"), speed, motors.speed_interval),
            FittedValue(("motors", "stall_torque_n_m"), torque, motors.torque_interval),
            FittedValue(("motors", "friction_torque_n_m"), friction, motors.friction_interval),
        ]
        lines += [
            f"no-load speed  {speed:.1f} rad/s +- {motors.speed_interval:.1f} (95 %)",
            f"stall torque   {torque * 1e3:.2f} mN m +- {motors.torque_interval * 1e3:.2f} (95 %)",
            f"gear friction  {friction * 1e3:.3f} mN m +- {motors.friction_interval * 1e3:.3f} (95 %)",
        ]
        if not tests.wheels:
            lines.append("               with wheels as in --start; measured wheels improve the torque")
    if tests.objects:
        infrared = fit_infrared([test.readings(robot.wheels) for test in tests.objects], robot, ruler)
        robot = apply_fit(robot, infrared)
        values += _infrared_values(infrared)
        lines += _infrared_lines(infrared)
        misplacements |= zip((test.name for test in tests.objects), infrared.misplacements, strict=True)
    if tests.lamps:
        lamps = fit_lamps([test.readings(robot.wheels) for test in tests.lamps], robot, ruler)
        robot = robot.model_copy(update={"ambient": lamps.ambient})
        values += _lamp_values(lamps)
        lines += _lamp_lines(lamps)
        misplacements |= zip((test.name for test in tests.lamps), lamps.misplacements, strict=True)
    return RobotFit(robot, tuple(values), tuple(lines), misplacements, drives)


def _infrared_values(infrared: InfraredFit) -> Iterator[FittedValue]:
    for sensor, fit in enumerate(infrared.sensors):
        optics, gain = fit.optics, fit.optics.gain_counts_mm2
        for table, key, value, interval in (
            ("proximity", "gain_counts_mm2", gain, fit.gain_interval * gain),
            ("proximity", "threshold_counts", optics.threshold_counts, fit.threshold_interval),
            ("", "heading_deg", fit.heading_deg, fit.heading_interval),
            ("proximity", "lobe_exponent", optics.lobe_exponent, fit.lobe_interval),
            ("proximity", "noise_counts", fit.noise_counts, fit.noise_interval),
        ):
            if interval is not None:
                yield FittedValue((table, key, sensor), value, interval)


def _infrared_lines(infrared: InfraredFit) -> Iterator[str]:
    undetermined: list[str] = []
    for name, fit in zip(SENSOR_LABELS, infrared.sensors, strict=True):
        values = [
            f"gain {fit.optics.gain_counts_mm2:.4g} +- {fit.gain_interval:.1%}",
            f"threshold {fit.optics.threshold_counts:.0f} +- {fit.threshold_interval:.0f}",
        ]
        for quantity, value, interval, digits in (
            ("heading", fit.heading_deg, fit.heading_interval, 1),
            ("lobe", fit.optics.lobe_exponent, fit.lobe_interval, 2),
            ("noise", fit.noise_counts, fit.noise_interval, 1),
        ):
            if interval is None:
                undetermined.append(f"{quantity} of {name}")
            else:
                values.append(f"{quantity} {value:.{digits}f} +- {interval:.{digits}f}")
        yield f"{name:10}     {', '.join(values)} (95 %), {fit.rms:.1f} counts rms left"
    if undetermined:
        yield f"as in --start  not determined by these tests: {', '.join(undetermined)}"


def _lamp_values(lamps: LampFit) -> Iterator[FittedValue]:
    ambient = lamps.ambient
    gains = np.array(lamps.gain_intervals) * ambient.gain_counts_mm2_per_w
    for key, intervals in (
        ("heading_deg", lamps.heading_intervals),
        ("gain_counts_mm2_per_w", gains.tolist()),
        ("lobe_exponent", lamps.lobe_intervals),
    ):
        for sensor, interval in enumerate(intervals):
            yield FittedValue(("ambient", key, sensor), getattr(ambient, key)[sensor], interval)
    yield FittedValue(("ambient", "dark_counts"), ambient.dark_counts, lamps.dark_interval)
    yield FittedValue(("ambient", "diffuse"), ambient.diffuse, lamps.diffuse_interval)


def _lamp_lines(lamps: LampFit) -> Iterator[str]:
    ambient = lamps.ambient
    for sensor, name in enumerate(SENSOR_LABELS):
        heading, gain = ambient.heading_deg[sensor], ambient.gain_counts_mm2_per_w[sensor]
        yield (
            f"{name:10}     heading to lamps {heading:.1f} +- {lamps.heading_intervals[sensor]:.1f} degrees, "
            f"gain {gain:.4g} +- {lamps.gain_intervals[sensor]:.1%}, "
            f"lobe {ambient.lobe_exponent[sensor]:.2f} +- {lamps.lobe_intervals[sensor]:.2f} (95 %)"
        )
    yield (
        f"light          dark {ambient.dark_counts:g} +- {lamps.dark_interval:.1f}, brightest "
        f"{ambient.floor_counts:g}, diffuse part {ambient.diffuse:g} +- {lamps.diffuse_interval:.3f} (95 %), "
        f"{lamps.rms:.1f} counts rms left"
    )


def describe_residuals(tests: FitTests, fit: RobotFit, ruler: Ruler | None = None) -> Iterator[str]:
    """Yield a line of text with the residuals of each test; the tests may be others than those of the fit."""
    robot = fit.calibration
    for drive in tests.wheels:
        error = drive_residual(drive, robot.wheels.radius_mm / 1e3, robot.wheels.base_mm / 1e3)
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
    """Return the standard deviation of each reading (n, 8), or a common one."""
    if test.power is not None:
        return np.array(robot.ambient.noise_counts)
    means = mean_counts(test.readings(robot.wheels).placement, robot, misplacement)
    return reading_deviations(means, np.array(robot.proximity.noise_counts), robot.proximity.limit_counts)


def simulate_readings(test: SensorData, robot: Calibration, misplacement: Misplacement = IN_PLACE) -> Floats:
    """Return the mean readings of a robot with a calibration in a sensor test (n, 8)."""
    readings, proximity = test.readings(robot.wheels), robot.proximity
    if test.power is not None:
        lamp = LampPositions.of(readings, misplacement)
        return np.column_stack([ambient_counts(lamp, channel, robot.ambient) for channel in range(N_SENSORS)])
    means = mean_counts(readings.placement, robot, misplacement)
    return expected_readings(means, np.array(proximity.noise_counts), proximity.limit_counts)


def with_name(calibration: Calibration, stem: str, method: str) -> Calibration:
    """Return a calibration with a name derived from a file's stem, and the method in its source."""
    name = re.sub("[^A-Za-z0-9_-]", "-", stem)[:64] or "robot"
    return calibration.model_copy(update={"name": name, "source": f"{calibration.source}; {method}"})
