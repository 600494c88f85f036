"""Calibration of one robot from recorded tests; parts without a test stay as they were."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from khep_twin.lab.fit.fit_inputs import Measured, SensorData
from khep_twin.lab.fit.infrared_fit import InfraredFit, fit_infrared, fitted, levels
from khep_twin.lab.fit.lamp_fit import LampFit, LampTable, ambient_counts, fit_lamps
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats, deviation, expected
from khep_twin.lab.fit.motor_fit import DutyDrive, aligned, driven, fit_motors
from khep_twin.lab.fit.placement import IN_PLACE, Misplacement, Ruler
from khep_twin.lab.fit.wheel_fit import fit_wheels, left_over
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS, SENSOR_LABELS

_TOO_FAR = 4.0
"""Error of an object's place from which on it is asked about, in the ruler's standard deviation."""


@dataclass(frozen=True, slots=True)
class FittedValue:
    """Value of a calibration that was fitted.

    Attributes:
        path: Its place in the calibration: table, key, and number of the sensor.
        value: Fitted value, in the calibration's unit.
        interval: Half of its 95 % confidence interval.
    """

    path: tuple[str, str] | tuple[str, str, int]
    value: float
    interval: float

    def of(self, calibration: Calibration) -> float:
        """Return this value of another calibration."""
        table, key, *sensor = self.path
        values = np.atleast_1d(getattr(getattr(calibration, table) if table else calibration, str(key)))
        return float(values[sensor[0] if len(values) > 1 else 0])


@dataclass(frozen=True, slots=True)
class RobotFit:
    """Fitted calibration of a robot.

    Attributes:
        calibration: Calibration with the fitted values.
        values: Fitted values with their confidence intervals.
        lines: Both as text, with the values that stayed as they were.
        moved: Where the object of each sensor test stood, by the test's name.
        drives: Drives with fixed duties in phase with the robot's controller, likewise.
    """

    calibration: Calibration
    values: tuple[FittedValue, ...] = ()
    lines: tuple[str, ...] = ()
    moved: Mapping[str, Misplacement] = field(default_factory=dict[str, Misplacement])
    drives: Mapping[str, DutyDrive] = field(default_factory=dict[str, DutyDrive])


def fit_robot(tests: Measured, start: Calibration, ruler: Ruler | None = None) -> RobotFit:
    """Fit the parts of a robot that have tests; the others stay as in `start`.

    Args:
        tests: Recorded tests.
        start: Initial values, and those of parts without a test.
        ruler: Precision of what a person has measured; None for the usual one.

    Raises:
        FitError: The tests do not determine a parameter.
    """
    ruler, found, values, lines = ruler or Ruler(), start, list[FittedValue](), list[str]()
    moved: dict[str, Misplacement] = {}
    drives: dict[str, DutyDrive] = {}
    if tests.wheels:
        wheels = fit_wheels(tests.wheels, ruler)
        found = found.model_copy(update={"wheels": wheels.calibration()})
        radius, base = ((x * 1e3) for x in (wheels.radius, wheels.base))
        within = wheels.radius_interval * 1e3, wheels.base_interval * 1e3
        values += [
            FittedValue(("wheels", "radius_mm"), radius, within[0]),
            FittedValue(("wheels", "base_mm"), base, within[1]),
        ]
        lines += [
            f"wheel radius   {radius:.3f} mm +- {within[0]:.3f} (95 %)",
            f"wheel base     {base:.2f} mm +- {within[1]:.2f} (95 %)",
        ]
        ruler = replace(ruler, base=wheels.base_interval / CONFIDENCE / wheels.base)
    if tests.motors:
        motors = fit_motors(tests.motors, found)
        drives = {drive.name: drive for drive in motors.drives}
        found = found.model_copy(update={"motors": motors.motors})
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
        infrared = fit_infrared([each.readings(found.wheels) for each in tests.objects], found, ruler)
        found = fitted(found, infrared)
        values += _infrared_values(infrared)
        lines += _infrared_lines(infrared)
        moved |= _by_name(tests.objects, infrared.moved)
    if tests.lamps:
        lamps = fit_lamps([each.readings(found.wheels) for each in tests.lamps], found, ruler)
        found = found.model_copy(update={"ambient": lamps.ambient})
        values += _lamp_values(lamps)
        lines += _lamp_lines(lamps)
        moved |= _by_name(tests.lamps, lamps.moved)
    return RobotFit(found, tuple(values), tuple(lines), moved, drives)


def _by_name(tests: Sequence[SensorData], moved: Sequence[Misplacement]) -> dict[str, Misplacement]:
    return {test.name: each for test, each in zip(tests, moved, strict=True)}


def _infrared_values(found: InfraredFit) -> Iterator[FittedValue]:
    for sensor, fit in enumerate(found.sensors):
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


def _infrared_lines(found: InfraredFit) -> Iterator[str]:
    kept: list[str] = []
    for name, fit in zip(SENSOR_LABELS, found.sensors, strict=True):
        words = [
            f"gain {fit.optics.gain_counts_mm2:.4g} +- {fit.gain_interval:.1%}",
            f"threshold {fit.optics.threshold_counts:.0f} +- {fit.threshold_interval:.0f}",
        ]
        for what, value, interval, digits in (
            ("heading", fit.heading_deg, fit.heading_interval, 1),
            ("lobe", fit.optics.lobe_exponent, fit.lobe_interval, 2),
            ("noise", fit.noise_counts, fit.noise_interval, 1),
        ):
            if interval is None:
                kept.append(f"{what} of {name}")
            else:
                words.append(f"{what} {value:.{digits}f} +- {interval:.{digits}f}")
        yield f"{name:10}     {', '.join(words)} (95 %), {fit.rms:.1f} counts rms left"
    if kept:
        yield f"as in --start  not determined by these tests: {', '.join(kept)}"


def _lamp_values(found: LampFit) -> Iterator[FittedValue]:
    ambient = found.ambient
    gains = np.array(found.gain_intervals) * ambient.gain_counts_mm2_per_w
    for key, intervals in (
        ("heading_deg", found.heading_intervals),
        ("gain_counts_mm2_per_w", gains.tolist()),
        ("lobe_exponent", found.lobe_intervals),
    ):
        for sensor, interval in enumerate(intervals):
            yield FittedValue(("ambient", key, sensor), getattr(ambient, key)[sensor], interval)
    yield FittedValue(("ambient", "dark_counts"), ambient.dark_counts, found.dark_interval)
    yield FittedValue(("ambient", "diffuse"), ambient.diffuse, found.diffuse_interval)


def _lamp_lines(found: LampFit) -> Iterator[str]:
    ambient = found.ambient
    for sensor, name in enumerate(SENSOR_LABELS):
        heading, gain = ambient.heading_deg[sensor], ambient.gain_counts_mm2_per_w[sensor]
        yield (
            f"{name:10}     heading to lamps {heading:.1f} +- {found.heading_intervals[sensor]:.1f} degrees, "
            f"gain {gain:.4g} +- {found.gain_intervals[sensor]:.1%}, "
            f"lobe {ambient.lobe_exponent[sensor]:.2f} +- {found.lobe_intervals[sensor]:.2f} (95 %)"
        )
    yield (
        f"light          dark {ambient.dark_counts:g} +- {found.dark_interval:.1f}, brightest "
        f"{ambient.floor_counts:g}, diffuse part {ambient.diffuse:g} +- {found.diffuse_interval:.3f} (95 %), "
        f"{found.rms:.1f} counts rms left"
    )


def met(tests: Measured, fit: RobotFit, ruler: Ruler | None = None) -> Iterator[str]:
    """Yield the residuals of a fit in each test, those that it used or others, as text."""
    found = fit.calibration
    for drive in tests.wheels:
        left = left_over(drive, found.wheels.radius_mm / 1e3, found.wheels.base_mm / 1e3)
        off = f"{np.degrees(left):+.2f} degrees" if drive.distance is None else f"{left * 1e3:+.2f} mm"
        yield f"{drive.name}: {off}"
    for drive in tests.motors:
        best = fit.drives.get(drive.name) or aligned(drive, found)
        left = driven(best, found) - best.speeds(best.values)
        yield f"{drive.name}: {np.sqrt(np.mean(left**2)):.2f} pulses/10 ms rms"
    for data in (*tests.objects, *tests.lamps):
        place = fit.moved.get(data.name, IN_PLACE)
        left, noise = modelled(data, found, place) - data.counts, _noise(data, found, place)
        words = f"{data.name}: {_rms(left):.1f} counts rms, of which the sensors' noise is {_rms(noise):.1f}"
        if place is not IN_PLACE:
            words += f", at {place.distance * 1e3:+.2f} mm and {math.degrees(place.bearing):+.1f} degrees,"
        # Allow a model error of 8 counts, or as much as the noise.
        beyond = _rms(left) > 2 * np.hypot(_rms(noise), 8) or _is_far(place, ruler or Ruler())
        yield words + ("; check the object and its distance" if beyond else "")


def _is_far(place: Misplacement, ruler: Ruler) -> bool:
    off_mm, off_deg = abs(place.distance) * 1e3, abs(math.degrees(place.bearing))
    # An exact ruler's object may deviate by what the model of the optics leaves out.
    limits = max(ruler.distance_mm, 0.5), max(ruler.bearing_deg, 1.5)
    return off_mm > _TOO_FAR * limits[0] or off_deg > _TOO_FAR * limits[1]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _noise(data: SensorData, found: Calibration, moved: Misplacement) -> Floats:
    """Return the standard deviation of each reading (n, 8), or of all readings."""
    if data.power is not None:
        return np.array(found.ambient.noise_counts)
    near = found.proximity
    return deviation(
        levels(data.readings(found.wheels).placement, found, moved),
        np.array(near.noise_counts),
        near.limit_counts,
    )


def modelled(data: SensorData, found: Calibration, moved: Misplacement = IN_PLACE) -> Floats:
    """Return the mean readings of a robot with a calibration in a sensor test (n, 8)."""
    test, near = data.readings(found.wheels), found.proximity
    if data.power is not None:
        lamp = LampTable.of(test, moved)
        return np.column_stack([ambient_counts(lamp, channel, found.ambient) for channel in range(N_SENSORS)])
    return expected(levels(test.placement, found, moved), np.array(near.noise_counts), near.limit_counts)


def named(found: Calibration, stem: str, how: str) -> Calibration:
    """Return a calibration with a name made of a file's, and with how it was found in its source."""
    name = re.sub("[^A-Za-z0-9_-]", "-", stem)[:64] or "robot"
    return found.model_copy(update={"name": name, "source": f"{found.source}; {how}"})
