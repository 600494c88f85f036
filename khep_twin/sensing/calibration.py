"""Calibrations: parameters of the sensors, wheels and motors of one named robot, in a TOML file.

Two Kheperas differ by 40 % in range, so a calibration belongs to one robot and names its source. The files in
assets/calibration are used by bare name, others by path. `khep_twin.sensors` explains the parameters. A
file may have only the keys in which it differs from another one, its `base`: a name, or a path from its
folder.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mode
from typing import Annotated, Literal, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from khep_twin.errors import CalibrationError, Problem
from khep_twin.files import toml_files
from khep_twin.files.toml_files import Name, Problems, TomlTable
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import installed_models
from khep_twin.units import (
    COUNTS_LIMIT,
    MOTOR_FRICTION_TORQUE,
    MOTOR_NO_LOAD_SPEED,
    MOTOR_STALL_TORQUE,
    SUPPLY_VOLTAGE,
    TYRE_FRICTION,
    WHEEL_BASE,
    WHEEL_RADIUS,
    metres,
)

_Table = TypeVar("_Table", bound=TomlTable)
_Gain = Annotated[float, Field(gt=0, le=1e8)]
_Exponent = Annotated[float, Field(ge=0, le=20)]
_Offset = Annotated[float, Field(ge=0.01, le=50)]
_LampOffset = Annotated[float, Field(ge=-100, le=50)]
_Heading = Annotated[float, Field(ge=-360, le=360)]
_PerSensor = Field(min_length=1, max_length=64, description="a list of numbers, one per sensor")


GAIN_SPREAD, THRESHOLD_SPREAD, LAMP_SPREAD = 0.13, 0.14, 0.055
"""Relative standard deviations of gain and threshold over the eight sensors of the sampled robot, and of
their gain for lamps (4 to 7 % measured); that of the threshold where a calibration gives no other."""


class ProximityCalibration(TomlTable):
    """Reflected light; per-sensor values in the order of the command N.

    Attributes:
        gain_counts_mm2: Counts at 1 mm in front of an infinite white wall, perpendicular to it.
        threshold_counts: Subtracted counts; if negative, minus the reading with nothing in range.
        threshold_spread: Relative standard deviation of the thresholds among robots of the same model.
        offset_mm: Offset of the chip behind the sensor's face.
        lobe_exponent: Exponent of the cosine off the sensor's axis, in azimuth.
        elevation_exponent: Exponent of the cosine in elevation, an odd number.
        floor_light_counts: Part of `-threshold_counts` from a white floor; others give less light.
        mirror: Weight of the mirror images of objects in a white floor.
        limit_counts: Highest reading.
        saturates: Whether readings approach it gradually.
        floor_counts: Lowest reading, also where ambient light saturates the sensor; may be below 0.
        quantum_counts: Step between readings.
        noise_counts: Standard deviation of one reading; one number applies to all sensors.
        noise_growth: Relative growth of this deviation per count of reflected light.
        idle_counts: Mean of the noise with nothing in range.
    """

    gain_counts_mm2: Annotated[tuple[_Gain, ...], _PerSensor]
    threshold_counts: Annotated[tuple[float, ...], _PerSensor]
    threshold_spread: Annotated[float, Field(ge=0, le=1)] = THRESHOLD_SPREAD
    offset_mm: Annotated[tuple[_Offset, ...], _PerSensor]
    lobe_exponent: Annotated[tuple[_Exponent, ...], _PerSensor]
    elevation_exponent: Literal[3, 5, 7, 9, 11] = 3
    floor_light_counts: Annotated[tuple[float, ...], _PerSensor] | None = None
    mirror: Annotated[float, Field(ge=0, le=3)] = 1.0
    limit_counts: int = COUNTS_LIMIT
    saturates: bool = False
    floor_counts: int = 0
    quantum_counts: Annotated[int, Field(ge=1, le=64)] = 1
    noise_counts: Annotated[
        tuple[float, ...], Field(description="a number from 0, or a list of numbers, one per sensor")
    ]
    noise_growth: Annotated[float, Field(ge=0, le=1)] = 0.0
    idle_counts: float

    @model_validator(mode="before")
    @classmethod
    def _repeat_noise(cls, table: object) -> object:
        """Repeat one number of the noise for each sensor."""
        if not isinstance(table, Mapping):
            return table
        values = cast(Mapping[str, object], table)
        noise, gains = values.get("noise_counts"), values.get("gain_counts_mm2")
        if not isinstance(noise, int | float) or not math.isfinite(noise):
            return values
        n_sensors = len(cast(Sequence[object], gains)) if isinstance(gains, list | tuple) else 1
        return {**values, "noise_counts": (noise,) * n_sensors}


class AmbientCalibration(TomlTable):
    """Light of lamps; per-sensor values in the order of the command O.

    Attributes:
        heading_deg: Heading of each receiver, counter-clockwise from the front.
        gain_counts_mm2_per_w: Counts per light of a lamp.
        lobe_exponent: Exponent of the cosine off the receiver's axis.
        diffuse: Diffuse part of the sensitivity.
        offset_mm: Offset in the light's inverse square law.
        dark_counts: Reading in the dark.
        floor_counts: Reading in the brightest light.
        ceiling_counts: Highest reading, noise included.
        noise_counts: Standard deviation of one reading.
        rises_with_light: Whether readings are subtracted from the converter's largest count.
    """

    heading_deg: Annotated[tuple[_Heading, ...], _PerSensor]
    gain_counts_mm2_per_w: Annotated[tuple[_Gain, ...], _PerSensor]
    lobe_exponent: Annotated[tuple[_Exponent, ...], _PerSensor]
    diffuse: Annotated[float, Field(ge=0, le=1)] = 0.0
    offset_mm: _LampOffset = 0.0
    dark_counts: float
    floor_counts: float
    ceiling_counts: int
    noise_counts: float
    rises_with_light: bool = False


class GroundCalibration(TomlTable):
    """Sensors that face the floor; per-sensor values in the order of the robot's registers.

    Attributes:
        white_counts: Reading above a white floor.
        nothing_counts: Reading with no floor below.
        spot_mm: Radius of the spot that a sensor sees.
        excess: Light from a white floor over that which saturates; then readings approach white gradually.
        noise_counts: Standard deviation of one reading.
    """

    white_counts: Annotated[tuple[float, ...], _PerSensor]
    nothing_counts: float
    spot_mm: Annotated[float, Field(ge=0.1, le=50)]
    excess: Annotated[float, Field(ge=1, le=100)] = 1.0
    noise_counts: float


class WheelCalibration(TomlTable):
    """Both wheels; the firmware only counts their pulses.

    Attributes:
        radius_mm: Mean radius of the wheels.
        right_over_left: Radius of the right wheel over that of the left.
        base_mm: Distance between the wheels' contacts with the floor.
        friction: Friction of the tyres on the floor.
    """

    radius_mm: Annotated[float, Field(ge=6, le=25)] = WHEEL_RADIUS * 1000
    right_over_left: Annotated[float, Field(ge=0.9, le=1.1)] = 1.0
    base_mm: Annotated[float, Field(ge=40, le=150)] = WHEEL_BASE * 1000
    friction: Annotated[float, Field(ge=0.1, le=3)] = TYRE_FRICTION

    @property
    def radii(self) -> tuple[float, float]:
        """Radius of the left and of the right wheel [m]."""
        left = 2 * metres(self.radius_mm) / (1 + self.right_over_left)
        return left, left * self.right_over_left


class MotorCalibration(TomlTable):
    """Both motors, referred to the wheels.

    Attributes:
        supply_v: Supply voltage at which the figures hold.
        no_load_speed_rad_s: Speed of an unloaded wheel at full duty.
        stall_torque_n_m: Torque at a blocked wheel at full duty.
        friction_torque_n_m: Dry friction of motor and gear, already deducted from both figures above.
    """

    supply_v: Annotated[float, Field(ge=1, le=24)] = SUPPLY_VOLTAGE
    no_load_speed_rad_s: Annotated[float, Field(ge=5, le=1000)] = MOTOR_NO_LOAD_SPEED
    stall_torque_n_m: Annotated[float, Field(ge=0.0005, le=0.2)] = MOTOR_STALL_TORQUE
    friction_torque_n_m: Annotated[float, Field(ge=0, le=0.05)] = MOTOR_FRICTION_TORQUE

    @property
    def constant(self) -> float:
        """Torque at the wheel per current [N m/A], which is also voltage per speed [V s/rad]."""
        share = self.stall_torque_n_m / (self.stall_torque_n_m + self.friction_torque_n_m)
        return self.supply_v / self.no_load_speed_rad_s * share

    @property
    def resistance(self) -> float:
        """Resistance of the winding [ohm]."""
        return self.supply_v * self.constant / (self.stall_torque_n_m + self.friction_torque_n_m)


class Calibration(TomlTable):
    """Sensors, wheels and motors of one robot; headings [deg] counter-clockwise from the front, as for N.

    No reading exceeds `largest_count`, that of the converter.
    """

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    source: str
    largest_count: Annotated[int, Field(ge=1, le=2**16 - 1)] = COUNTS_LIMIT
    heading_deg: Annotated[tuple[_Heading, ...], _PerSensor]
    proximity: ProximityCalibration
    ambient: AmbientCalibration
    wheels: WheelCalibration = WheelCalibration()
    motors: MotorCalibration = MotorCalibration()
    ground: GroundCalibration | None = None

    @model_validator(mode="after")
    def _check_counts(self) -> Self:
        """Check that counts are in range, floors below, and other levels at most at, their upper limits."""
        if misfits := [
            problem
            for table in ("proximity", "ambient", "ground")
            for key, value in cast(Iterable[tuple[str, object]], getattr(self, table) or ())
            if key.endswith("_counts") and key != "quantum_counts" and value is not None
            for problem in _out_of_range(self.largest_count, table, key, value)
        ]:
            raise Problems(misfits)
        ambient, proximity = self.ambient, self.proximity
        levels = (
            ("ambient", "floor_counts", ambient.floor_counts, "dark_counts", ambient.dark_counts),
            ("ambient", "dark_counts", ambient.dark_counts, "ceiling_counts", ambient.ceiling_counts),
            ("proximity", "idle_counts", proximity.idle_counts, "limit_counts", proximity.limit_counts),
            ("proximity", "floor_counts", proximity.floor_counts, "limit_counts", proximity.limit_counts),
            ("proximity", "quantum_counts", proximity.quantum_counts, "limit_counts", proximity.limit_counts),
        )
        problems = [
            Problem.of((table, key), f"{table}: {key} = {value:g}", f"below {limit_key} = {limit:g}", value)
            for table, key, value, limit_key, limit in levels
            if value > limit - (key == "floor_counts")
        ]
        lists = {
            (table, key): cast(tuple[float, ...], value)
            for table, values in (("", self), ("proximity", proximity), ("ambient", ambient))
            for key, value in cast(Iterable[tuple[str, object]], values)
            if isinstance(value, tuple)
        }
        n_sensors = mode(map(len, lists.values()))
        text = f"a list of {n_sensors} numbers, one per sensor"
        problems += [
            Problem.of((table, key) if table else (key,), f"{table}: {key}" if table else key, text, value)
            for (table, key), value in lists.items()
            if len(value) != n_sensors
        ]
        if self.largest_count > COUNTS_LIMIT and "limit_counts" not in proximity.model_fields_set:
            text = "proximity: limit_counts is missing"
            problems.append(Problem.of(("proximity", "limit_counts"), text, f"at most {self.largest_count}"))
        if problems:
            raise Problems(problems)
        return self


def _out_of_range(largest: int, table: str, key: str, value: object) -> Iterator[Problem]:
    """Yield the problems of counts out of the range of a converter: of a number, or of numbers in a list."""
    lowest = {("proximity", "limit_counts"): 1, ("proximity", "floor_counts"): -largest}.get((table, key), 0)
    low, high = (-largest, 2 * largest) if key == "threshold_counts" else (lowest, largest)
    numbers = cast(tuple[float, ...], value if isinstance(value, tuple) else (value,))
    expected = f"{'an integer' if isinstance(value, int) else 'a number'} from {low} to {high}"
    if (table, key) == ("proximity", "noise_counts"):
        expected += ", or a list of numbers, one per sensor"
        numbers = numbers if len({*numbers}) > 1 else numbers[:1]  # one for all sensors
    elif isinstance(value, tuple):
        expected = "a list of numbers, one per sensor"
    for index, number in enumerate(numbers):
        if not low <= number <= high:
            place, name = ((index,), f"{key} {index + 1}") if len(numbers) > 1 else ((), key)
            yield Problem.of((table, key, *place), f"{table}: {name} = {number:g}", expected)


COMMON_GAIN_SPREAD = 0.3
"""Standard deviation of the logarithm of a gain common to a robot's sensors (assumed: the two Kheperas known,
with half the scale at 24 and 33 mm, give 0.4; no known robot has a range above 33 mm)."""

HEADING_SPREAD_DEG = 3.4
"""Standard deviation of a heading [deg]: of the sampled robot's headings from left-right symmetry, which is
3.4 degrees for emitters and for receivers, in different directions."""

RADIUS_SPREAD, BASE_SPREAD = 0.015, 0.015
"""Relative standard deviations of the wheels' mean radius and of the wheel base: half of the ranges 7.5 to
7.96 mm and 52 to 54 mm that simulators use and users measure."""

INEQUALITY_SPREAD = 0.004
"""Standard deviation of `right_over_left` (assumed: after 30 s of driving, robots then miss home by the
published 50 to 100 mm, and 8 in 10 by less than 100 mm; `studies.home_test`)."""

FRICTION_SPREAD, NO_LOAD_SPREAD, STALL_SPREAD, GEAR_SPREAD = 0.1, 0.05, 0.1, 0.2
"""Relative standard deviations of the tyres' friction, the motors' no-load speed and stall torque, and the
gears' friction (assumed; simulators' tyres differ by 0.9 to 1.2)."""

_MAX_DEVIATIONS = 4.0
"""Standard deviations at which the random deviations of wheels and motors are clipped."""


def vary(calibration: Calibration, rng: np.random.Generator) -> Calibration:
    """Return a robot of the same model: sensors, wheels and motors drawn around a calibration."""
    n_sensors = len(calibration.heading_deg)
    spreads = np.array([[GAIN_SPREAD], [calibration.proximity.threshold_spread]])
    gains, thresholds = 1 + spreads * rng.standard_normal((2, n_sensors))
    lamp_gains = 1 + LAMP_SPREAD * rng.standard_normal(n_sensors)
    heading_errors = HEADING_SPREAD_DEG * rng.standard_normal((2, n_sensors))
    common_gain = np.exp(COMMON_GAIN_SPREAD * rng.standard_normal())
    deviations = np.clip(rng.standard_normal(7), -_MAX_DEVIATIONS, _MAX_DEVIATIONS).tolist()
    radius, base, inequality, friction, no_load, stall, gear = deviations
    proximity, ambient = calibration.proximity, calibration.ambient
    wheels, motors = calibration.wheels, calibration.motors
    return _change(
        calibration,
        heading_deg=_shift(calibration.heading_deg, heading_errors[0]),
        proximity=_change(
            proximity,
            gain_counts_mm2=_scale(proximity.gain_counts_mm2, gains, common_gain),
            threshold_counts=_scale(proximity.threshold_counts, thresholds),
        ),
        ambient=_change(
            ambient,
            heading_deg=_shift(ambient.heading_deg, heading_errors[1]),
            gain_counts_mm2_per_w=_scale(ambient.gain_counts_mm2_per_w, lamp_gains),
        ),
        wheels=_change(
            wheels,
            radius_mm=wheels.radius_mm * (1 + RADIUS_SPREAD * radius),
            right_over_left=wheels.right_over_left + INEQUALITY_SPREAD * inequality,
            base_mm=wheels.base_mm * (1 + BASE_SPREAD * base),
            friction=wheels.friction * (1 + FRICTION_SPREAD * friction),
        ),
        motors=_change(
            motors,
            no_load_speed_rad_s=motors.no_load_speed_rad_s * (1 + NO_LOAD_SPREAD * no_load),
            stall_torque_n_m=motors.stall_torque_n_m * (1 + STALL_SPREAD * stall),
            friction_torque_n_m=motors.friction_torque_n_m * (1 + GEAR_SPREAD * gear),
        ),
    )


def _change(table: _Table, **values: object) -> _Table:
    """Return a table with other values."""
    return table.model_copy(update=values)


def _scale(values: tuple[float, ...], factors: NDArray[np.float64], common: float = 1.0) -> tuple[float, ...]:
    """Return values times factors of at least 0.2, and times a common factor."""
    return tuple((np.array(values) * np.maximum(factors, 0.2) * common).tolist())


def _shift(values: tuple[float, ...], shifts: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple((np.array(values) + shifts).tolist())


def names() -> list[str]:
    """Return the names of the built-in calibrations."""
    return toml_files.names("calibration")


def read(name: str, users: tuple[Path, ...] = ()) -> tuple[Calibration, str]:
    """Return a calibration by bare name or path, and its text: that of its file, without a `base` complete.

    Bare names are those of `names`, and of the usual calibrations of installed models. `users` are the files
    whose `base` this is.

    Raises:
        CalibrationError: The file is missing or unusable; one line per problem.
    """
    usual = {model.calibration_name: model.calibration for model in installed_models().values()}
    text, source = toml_files.read("calibration", name, CalibrationError, usual)
    data = toml_files.parse(text, source, CalibrationError)
    if "base" not in data:
        return toml_files.check(Calibration, data, source, CalibrationError, text), text
    base_name, path = data.pop("base"), toml_files.path_of("calibration", name, usual).resolve()
    is_bare = base_name in usual or base_name in names()
    base_path = base_name if is_bare else str(path.parent / str(base_name))
    if not isinstance(base_name, str) or not toml_files.path_of("calibration", base_path, usual).is_file():
        reason, expected = f"base = {toml_files.format_value(base_name)}", "a calibration's name or path"
        raise CalibrationError(f"{reason}: no such file", file=source, expected=expected)
    if path in users:
        raise CalibrationError(f'base = "{base_name}": a circle; expected another file', file=source)
    base, base_text = read(base_path, (*users, path))
    tables: toml_files.Table = base.model_dump(exclude_unset=True)
    for key, value in data.items():
        is_table = isinstance(value, dict) and isinstance(tables.get(key), dict)
        tables[key] = tables[key] | value if is_table else value
    calibration = toml_files.check(Calibration, tables, source, CalibrationError, text)
    return calibration, toml_files.edit(base_text, base, calibration)


def read_for(name: str, model: RobotModel) -> Calibration:
    """Return a calibration of a robot of a model, by bare name or path.

    Raises:
        CalibrationError: As `read`; or the calibration is of a robot with other sensors, or the model's usual
            one has other wheels than its body.
    """
    measured, n_ground = read(name)[0], len(model.body.ground_positions)
    n_measured_ground = 0 if measured.ground is None else len(measured.ground.white_counts)
    n_around = len(model.body.sensor_positions)
    if (len(measured.heading_deg), n_measured_ground) != (n_around, n_ground):
        raise CalibrationError(
            f'{name}: of another robot than model = "{model.name}"; expected a calibration with {n_around} '
            f"sensors around and {n_ground or 'no'} sensors of the ground"
        )
    wheels, body = measured.wheels, model.body
    for key, value, field in (
        ("radius_mm", wheels.radius_mm, "wheel_radius"),
        ("base_mm", wheels.base_mm, "wheel_base"),
    ):
        expected = 1000 * getattr(body, field)
        if name == model.calibration and not math.isclose(value, expected, rel_tol=1e-6):
            raise CalibrationError(
                f"{name}: wheels: {key} = {value:g}; expected {expected:g}, as body.{field} of model "
                f"{model.name}"
            )
    return measured
