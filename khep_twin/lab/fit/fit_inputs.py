"""Recorded tests and their measurements, given as words on the command line.

straight.mcap=998mm             a straight drive, of this length by the ruler
spin.mcap=5turns                turns on the spot, counter-clockwise
steps.mcap=duty                 a drive with fixed duties on open floor
wall.csv=wall@22mm              a sensor test: a flat wall ahead, at this distance from the robot's edge
can.csv=cylinder:27mm@15mm      a cylinder of that radius ahead
lamp.csv=lamp:2W@150mm          a lamp of that power ahead, its filament 15 mm above the floor,
lamp.csv=lamp:2W:60mm@150mm     or at this height
paper.csv=floor:white           a sensor test on a floor of this surface, for sensors that look at it
"""

import math
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from khep_twin.errors import FitError
from khep_twin.files.atomic import resolve
from khep_twin.lab.fit.least_squares import Floats
from khep_twin.lab.fit.motor_fit import DutyDrive, read_drive
from khep_twin.lab.fit.placement import KHEPERA, Placement, Readings
from khep_twin.lab.fit.wheel_fit import Drive, check_family, read_pulses
from khep_twin.lab.sensor_test.sensor_files import load
from khep_twin.lab.sensor_test.sensor_test import DEFAULT_SPEED_UNIT, SensorRun
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import find_family
from khep_twin.sensing.calibration import WheelCalibration
from khep_twin.units import BULB_RADIUS

FILAMENT_MM = 15.0
"""Default height of a lamp's filament [mm], as for lamps of a playpen."""

FASTEST_TURN = 8
"""Fastest turn [pulses/10 ms]: above it, a robot turns by 2.8 degrees during one scan of its sensors."""

_LAG_S = 0.01
"""Time by which readings are younger than their row's counters [s]: N comes some 20 ms after H at 9600 baud,
and its values are up to 20 ms old."""

_MAX_ROWS = 500
"""Rows of a sensor test in a fit, at most: errors of the optics' model are the same in neighbours."""

_NUMBER = r"(\d{1,6}(?:\.\d{1,6})?)"
_WORDS = re.compile(
    rf"(?P<file>.+)=(?:"
    rf"(?P<distance>-?{_NUMBER})mm|(?P<turns>-?{_NUMBER})turns|(?P<duty>duty)"
    rf"|wall@(?P<wall>{_NUMBER})mm|floor:(?P<floor>white|black)"
    rf"|cylinder:(?P<radius>{_NUMBER})mm@(?P<cylinder>{_NUMBER})mm"
    rf"|lamp:(?P<power>{_NUMBER})W(?::(?P<height>{_NUMBER})mm)?@(?P<lamp>{_NUMBER})mm)"
)
_EXPECTED_WORDS = (
    "expected a file and a measurement, such as straight.mcap=998mm, spin.mcap=5turns, steps.mcap=duty, "
    "run.csv=wall@22mm, run.csv=cylinder:27mm@15mm, run.csv=lamp:2W@150mm or run.csv=floor:white"
)


@dataclass(frozen=True, slots=True)
class SensorData:
    """Sensor test with an object that stood straight ahead at its start, or on a floor of one surface.

    Attributes:
        name: Name in messages.
        run: Recorded data.
        distance: Distance from the robot's edge to the object's nearest point at the start [m].
        radius: Radius of the cylinder, 0 for a wall [m].
        power: Power of the lamp [W]; None for a wall or a cylinder.
        height: Height of the lamp's filament above the floor [m].
        model: Model of the robot.
        reflectance: Reflectance of the floor; None for a test with an object.
    """

    name: str
    run: SensorRun
    distance: float
    radius: float = 0.0
    power: float | None = None
    height: float = FILAMENT_MM / 1e3
    model: RobotModel = KHEPERA
    reflectance: float | None = None

    def readings(self, wheels: WheelCalibration) -> Readings:
        """Return the readings, with the object's position and the robot's poses."""
        body = self.model.body
        pulse_length_mm = 2 * math.pi * wheels.radius_mm / body.pulses_per_turn
        # A straight drive does not turn, and the speed of a turn is known.
        speed = self.run.test.speed if self.run.test.motion == "rotational" else None
        pulse_rate = (speed or 0) * (DEFAULT_SPEED_UNIT / body.pulse_length)
        turn_rate = 2 * pulse_rate * pulse_length_mm / wheels.base_mm
        radius = self.radius if self.power is None else BULB_RADIUS
        placement = Placement(self._poses(wheels), self.distance, radius, turn_rate, self.model)
        return Readings(self.name, placement, self.counts, self.power, self.height - body.sensor_height)

    @property
    def counts(self) -> Floats:
        """Readings of the sensors around, or of those of the floor (n, n_sensors) [counts]."""
        n_around = len(self.model.body.sensor_positions)
        ring, floor = np.split(self.run.dv[:, 2:].astype(np.float64), [n_around], axis=1)
        return ring if self.reflectance is None else floor

    def _poses(self, wheels: WheelCalibration) -> Floats:
        """Return the robot's poses at the readings by odometry: x, y [m], heading [rad] (n, 3)."""
        pulses_per_turn = self.model.body.pulses_per_turn
        distances = self.run.dv[:, :2] * (2 * math.pi * wheels.radius_mm / 1e3 / pulses_per_turn)
        times_s = self.run.times
        if len(times_s) > 1 and np.isfinite(times_s).all() and (np.diff(times_s) > 0).all():
            distances = distances + _LAG_S * np.gradient(distances, times_s, axis=0)
        heading = (distances[:, 1] - distances[:, 0]) / (wheels.base_mm / 1e3)
        forward = np.diff(distances.mean(axis=1), prepend=0.0)
        middle_heading = heading - np.diff(heading, prepend=0.0) / 2
        x, y = np.cumsum(forward * np.cos(middle_heading)), np.cumsum(forward * np.sin(middle_heading))
        return np.column_stack([x, y, heading])


@dataclass(frozen=True, slots=True)
class FitTests:
    """Tests by the part of the robot that they calibrate.

    Attributes:
        wheels: Measured drives.
        motors: Drives with fixed duties.
        objects: Sensor tests with walls and cylinders.
        lamps: Sensor tests with lamps.
        floors: Sensor tests on floors.
        model: Model of the robot.
    """

    wheels: tuple[Drive, ...] = ()
    motors: tuple[DutyDrive, ...] = ()
    objects: tuple[SensorData, ...] = ()
    lamps: tuple[SensorData, ...] = ()
    floors: tuple[SensorData, ...] = ()
    model: RobotModel = KHEPERA


def fit_inputs(words: list[str], model: RobotModel = KHEPERA) -> FitTests:
    """Read the files of a model's robot, named by words of the command line as in the module's docstring.

    Raises:
        FitError: A word is invalid, or does not match its file.
        LogError: A log cannot be read.
        SensorTestError: A sensor test cannot be read.
    """
    tests: dict[Path, Drive | DutyDrive | SensorData] = {}
    for word in words:
        path = resolve(Path(word.rpartition("=")[0]))
        if path in tests:
            raise FitError(f"{word}: this file is given twice; expected each test once")
        tests[path] = _read_test(word, model)
    sensor_tests = [test for test in tests.values() if isinstance(test, SensorData)]
    return FitTests(
        tuple(test for test in tests.values() if isinstance(test, Drive)),
        tuple(test for test in tests.values() if isinstance(test, DutyDrive)),
        tuple(test for test in sensor_tests if test.power is None and test.reflectance is None),
        tuple(test for test in sensor_tests if test.power is not None),
        tuple(test for test in sensor_tests if test.reflectance is not None),
        model,
    )


def _read_test(word: str, model: RobotModel) -> Drive | DutyDrive | SensorData:
    """Read the file of one word."""
    match = _WORDS.fullmatch(word)
    if match is None:
        raise FitError(f"{word}; {_EXPECTED_WORDS}")
    path = Path(match["file"])
    if match["duty"]:
        return read_drive(path, model)
    if match["distance"]:
        return Drive(match["file"], *read_pulses(path, model), distance=float(match["distance"]) / 1e3)
    if match["turns"]:
        return Drive(match["file"], *read_pulses(path, model), turn=float(match["turns"]) * 2 * math.pi)
    sensor_kind = "light" if match["lamp"] else "proximity"
    run = load(path, sensor_kind)
    step = 1 + len(run.times) // _MAX_ROWS
    run = replace(run, dv=run.dv[::step], times=run.times[::step])
    if run.test.what != sensor_kind:
        raise FitError(f"{word}: a test of {run.test.what}; expected one of {sensor_kind}")
    check_family(word, find_family(run.test.model).family, model)
    data = partial(SensorData, word, run, model=model)
    if match["floor"]:
        if not model.body.ground_positions:
            raise FitError(f"{word}: a {model.title} has no sensors of the floor; expected a robot with them")
        return data(0.0, reflectance=BUILT_IN_SURFACES[match["floor"]].reflectance)
    speed = run.test.speed
    if run.test.motion == "rotational" and (speed is None or speed > FASTEST_TURN):
        speed_text = "an unknown speed" if speed is None else f"speed {speed}"
        raise FitError(
            f"{word}: turned at {speed_text}, where readings lag by degrees; expected a turn with "
            f"`khep-twin sense --speed 1`, and up to {FASTEST_TURN}"
        )
    if match["lamp"]:
        power, height = float(match["power"]), float(match["height"] or FILAMENT_MM) / 1e3
        if not power:
            raise FitError(f"{word}: a lamp of 0 W; expected a power above 0")
        return data(float(match["lamp"]) / 1e3, power=power, height=height)
    if match["cylinder"]:
        if not float(match["radius"]):
            raise FitError(f"{word}: a cylinder of radius 0; expected a radius above 0")
        return data(float(match["cylinder"]) / 1e3, radius=float(match["radius"]) / 1e3)
    return data(float(match["wall"]) / 1e3)
