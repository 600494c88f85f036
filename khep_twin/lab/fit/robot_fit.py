"""Calibration of one robot from recorded tests; parts without a test stay as they were."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from khep_twin.lab.fit.fit_inputs import Measured, SensorData
from khep_twin.lab.fit.infrared import TANGENTS, Floats, Optics, level
from khep_twin.lab.fit.infrared_fit import deviation, expected, fit_infrared, fitted
from khep_twin.lab.fit.lamp_fit import ambient_counts, fit_lamps
from khep_twin.lab.fit.motor_fit import driven, fit_motors
from khep_twin.lab.fit.wheel_fit import fit_wheels, left_over
from khep_twin.lab.sensor_test.sensor_test import SENSORS
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import N_SENSORS


@dataclass(frozen=True, slots=True)
class RobotFit:
    """Fitted calibration of a robot, and its values with 95 % confidence intervals as lines of text."""

    calibration: Calibration
    lines: tuple[str, ...]


def fit_robot(tests: Measured, start: Calibration) -> RobotFit:
    """Fit the parts of a robot that have tests; the others stay as in `start`.

    Raises:
        FitError: The tests do not determine a parameter.
    """
    found, lines = start, list[str]()
    if tests.wheels:
        wheels = fit_wheels(tests.wheels)
        found = found.model_copy(update={"wheels": wheels.calibration()})
        lines += [
            f"wheel radius   {wheels.radius * 1e3:.3f} mm +- {wheels.radius_interval * 1e3:.3f} (95 %)",
            f"wheel base     {wheels.base * 1e3:.2f} mm +- {wheels.base_interval * 1e3:.2f} (95 %)",
        ]
    if tests.motors:
        motors = fit_motors(tests.motors, found)
        found = found.model_copy(update={"motors": motors.motors})
        speed, torque = motors.motors.no_load_speed_rad_s, motors.motors.stall_torque_n_m
        friction = motors.motors.friction_torque_n_m
        lines += [
            f"no-load speed  {speed:.1f} rad/s +- {motors.speed_interval:.1f} (95 %)",
            f"stall torque   {torque * 1e3:.2f} mN m +- {motors.torque_interval * 1e3:.2f} (95 %)",
            f"gear friction  {friction * 1e3:.3f} mN m +- {motors.friction_interval * 1e3:.3f} (95 %)",
        ]
        if not tests.wheels:
            lines.append("               with wheels as in --start; measured wheels improve the torque")
    if tests.objects:
        fits = fit_infrared([each.table(found.wheels) for each in tests.objects], found)
        found = fitted(found, fits)
        lines += [
            f"{name:10}     gain {fit.optics.gain_counts_mm2:.4g} +- {fit.gain_interval:.1%}, threshold "
            f"{fit.optics.threshold_counts:.0f} +- {fit.threshold_interval:.0f} (95 %), "
            f"{fit.rms:.1f} counts rms left"
            for name, fit in zip(SENSORS, fits, strict=True)
        ]
    if tests.lamps:
        lamps = fit_lamps([each.lamp_table(found.wheels) for each in tests.lamps], found)
        found = found.model_copy(update={"ambient": lamps.ambient})
        lines += [
            f"{name:10}     heading to lamps {lamps.ambient.heading_deg[i]:.1f} +- "
            f"{lamps.heading_intervals[i]:.1f} degrees, gain {lamps.ambient.gain_counts_mm2_per_w[i]:.4g} +- "
            f"{lamps.gain_intervals[i]:.1%} (95 %)"
            for i, name in enumerate(SENSORS)
        ]
        ambient = lamps.ambient
        lines.append(
            f"light          dark {ambient.dark_counts:g}, brightest {ambient.floor_counts:g}, diffuse part "
            f"{ambient.diffuse:g}, {lamps.rms:.1f} counts rms left"
        )
    return RobotFit(found, tuple(lines))


def met(tests: Measured, found: Calibration) -> Iterator[str]:
    """Yield the residuals of a calibration in each test, as text."""
    for drive in tests.wheels:
        left = left_over(drive, found.wheels.radius_mm / 1e3, found.wheels.base_mm / 1e3)
        off = f"{np.degrees(left):+.2f} degrees" if drive.distance is None else f"{left * 1e3:+.2f} mm"
        yield f"{drive.name}: {off}"
    for drive in tests.motors:
        left = driven(drive, found) - drive.speeds(drive.values)
        yield f"{drive.name}: {np.sqrt(np.mean(left**2)):.2f} pulses/10 ms rms"
    for data in (*tests.objects, *tests.lamps):
        left, noise = modelled(data, found) - data.counts, _noise(data, found)
        words = f"{data.name}: {_rms(left):.1f} counts rms, of which the sensors' noise is {_rms(noise):.1f}"
        # Allow a model error of 8 counts, or as much as the noise.
        beyond = _rms(left) > 2 * np.hypot(_rms(noise), 8)
        yield words + ("; check the object and its distance" if beyond else "")


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _noise(data: SensorData, found: Calibration) -> Floats:
    """Return the standard deviation of each reading (n, 8), or of all readings."""
    if data.power is not None:
        return np.array(found.ambient.noise_counts)
    return deviation(_levels(data, found), found.proximity.noise_counts, found.proximity.limit_counts)


def modelled(data: SensorData, found: Calibration) -> Floats:
    """Return the mean readings of a robot with a calibration in a sensor test (n, 8)."""
    if data.power is not None:
        lamp = data.lamp_table(found.wheels)
        return np.column_stack([ambient_counts(lamp, channel, found.ambient) for channel in range(N_SENSORS)])
    return expected(_levels(data, found), found.proximity.noise_counts, found.proximity.limit_counts)


def _levels(data: SensorData, found: Calibration) -> Floats:
    """Return proximity without noise and clipping (n, 8)."""
    table, proximity = data.table(found.wheels), found.proximity
    headings = np.radians(found.heading_deg).tolist()
    views = [table.view(channel, heading) for channel, heading in enumerate(headings)]
    columns = [level(view, TANGENTS, Optics.of(proximity, channel)) for channel, view in enumerate(views)]
    return np.column_stack(columns)


def named(found: Calibration, stem: str, tests: int) -> Calibration:
    """Return a calibration with a name made of a file's and with its source."""
    name = re.sub("[^A-Za-z0-9_-]", "-", stem)[:64] or "robot"
    return found.model_copy(update={"name": name, "source": f"{found.source}; fitted to {tests} tests"})
