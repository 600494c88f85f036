"""Calibrations: sensors, wheels and motors of one named robot, as numbers in a TOML file.

Two Kheperas differ by 40 % in range, so a calibration belongs to one robot and names its source. The files in
assets/calibration are used by bare name, others by path. `sensors` explains the numbers.
"""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from khep_twin.errors import CalibrationError, Problem
from khep_twin.files import toml_files
from khep_twin.files.toml_files import Name, Problems, TomlTable
from khep_twin.units import (
    COUNTS_LIMIT,
    DUTY_LIMIT,
    MOTOR_FRICTION_TORQUE,
    MOTOR_NO_LOAD_SPEED,
    MOTOR_STALL_TORQUE,
    N_SENSORS,
    SUPPLY_VOLTAGE,
    WHEEL_BASE,
    WHEEL_RADIUS,
)

_Gain = Annotated[float, Field(gt=0, le=1e8)]
_Counts = Annotated[float, Field(ge=0, le=COUNTS_LIMIT)]
_Threshold = Annotated[float, Field(ge=-COUNTS_LIMIT, le=2 * COUNTS_LIMIT)]
_Exponent = Annotated[float, Field(ge=0, le=20)]
_Offset = Annotated[float, Field(ge=0.01, le=50)]
_LampOffset = Annotated[float, Field(ge=-100, le=50)]
_Heading = Annotated[float, Field(ge=-360, le=360)]
_Eight = Field(
    min_length=N_SENSORS, max_length=N_SENSORS, description="a list of eight numbers, one per sensor"
)


class ProximityCalibration(TomlTable):
    """Reflected light; per-sensor values in the order of N.

    Attributes:
        gain_counts_mm2: Counts per light reflected by the reference wall.
        threshold_counts: Counts that are subtracted; below 0 the reading with nothing in reach.
        offset_mm: Offset of the chip behind the sensor's face.
        lobe_exponent: Exponent of the cosine off the sensor's axis.
        incidence_exponent: Exponent of the cosine between ray and surface normal.
        limit_counts: Highest reading.
        floor_counts: Lowest reading, also where ambient light saturates the sensor.
        quantum_counts: Step between readings.
        noise_counts: Standard deviation of one reading.
        idle_counts: Mean of the noise with nothing in reach.
    """

    gain_counts_mm2: Annotated[tuple[_Gain, ...], _Eight]
    threshold_counts: Annotated[tuple[_Threshold, ...], _Eight]
    offset_mm: Annotated[tuple[_Offset, ...], _Eight]
    lobe_exponent: Annotated[tuple[_Exponent, ...], _Eight]
    incidence_exponent: Annotated[tuple[_Exponent, ...], _Eight]
    limit_counts: Annotated[int, Field(ge=1, le=COUNTS_LIMIT)] = COUNTS_LIMIT
    floor_counts: Annotated[int, Field(ge=0, le=COUNTS_LIMIT)] = 0
    quantum_counts: Annotated[int, Field(ge=1, le=64)] = 1
    noise_counts: _Counts
    idle_counts: _Counts


class AmbientCalibration(TomlTable):
    """Light of lamps; per-sensor values in the order of O.

    Attributes:
        heading_deg: Heading of each receiver, counter-clockwise from ahead.
        gain_counts_mm2_per_w: Counts per light of a lamp.
        lobe_exponent: Exponent of the cosine off the receiver's axis.
        diffuse: Diffuse part of the sensitivity.
        offset_mm: Offset in the light's inverse square law.
        dark_counts: Reading in the dark.
        floor_counts: Reading in the brightest light.
        ceiling_counts: Highest reading, noise included.
        noise_counts: Standard deviation of one reading.
    """

    heading_deg: Annotated[tuple[_Heading, ...], _Eight]
    gain_counts_mm2_per_w: Annotated[tuple[_Gain, ...], _Eight]
    lobe_exponent: Annotated[tuple[_Exponent, ...], _Eight]
    diffuse: Annotated[float, Field(ge=0, le=1)] = 0.0
    offset_mm: _LampOffset = 0.0
    dark_counts: _Counts
    floor_counts: _Counts
    ceiling_counts: Annotated[int, Field(ge=0, le=COUNTS_LIMIT)]
    noise_counts: _Counts


class WheelCalibration(TomlTable):
    """Both wheels; the robot's own firmware knows only their pulses.

    Attributes:
        radius_mm: Radius of a wheel.
        base_mm: Distance between the wheels' contacts with the floor.
    """

    radius_mm: Annotated[float, Field(ge=6, le=9)] = WHEEL_RADIUS * 1000
    base_mm: Annotated[float, Field(ge=40, le=60)] = WHEEL_BASE * 1000


class MotorCalibration(TomlTable):
    """Both motors, as seen at the wheels, at a supply of 5 V.

    Attributes:
        no_load_speed_rad_s: Speed of an unloaded wheel at full duty.
        stall_torque_n_m: Torque at a blocked wheel at full duty.
        friction_torque_n_m: Dry friction of motor and gear; full duty overcomes it in both figures above.
    """

    no_load_speed_rad_s: Annotated[float, Field(ge=20, le=1000)] = MOTOR_NO_LOAD_SPEED
    stall_torque_n_m: Annotated[float, Field(ge=0.0005, le=0.2)] = MOTOR_STALL_TORQUE
    friction_torque_n_m: Annotated[float, Field(ge=0, le=0.05)] = MOTOR_FRICTION_TORQUE

    @property
    def constant(self) -> float:
        """Torque at the wheel per current [N m/A], which is also voltage per speed [V s/rad]."""
        used = self.stall_torque_n_m / (self.stall_torque_n_m + self.friction_torque_n_m)
        return SUPPLY_VOLTAGE / self.no_load_speed_rad_s * used

    @property
    def resistance(self) -> float:
        """Resistance of the winding [ohm]."""
        return SUPPLY_VOLTAGE * self.constant / (self.stall_torque_n_m + self.friction_torque_n_m)

    @property
    def dead_duty(self) -> float:
        """Duty below which friction holds an unloaded wheel at rest."""
        return DUTY_LIMIT * self.friction_torque_n_m / (self.stall_torque_n_m + self.friction_torque_n_m)


class Calibration(TomlTable):
    """One robot's sensors, wheels and motors; headings [deg] counter-clockwise from ahead, in N's order."""

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    source: str
    heading_deg: Annotated[tuple[_Heading, ...], _Eight]
    proximity: ProximityCalibration
    ambient: AmbientCalibration
    wheels: WheelCalibration = WheelCalibration()
    motors: MotorCalibration = MotorCalibration()

    @model_validator(mode="after")
    def _levels_are_in_order(self) -> Self:
        light, near = self.ambient, self.proximity
        levels = (
            ("ambient", "floor_counts", light.floor_counts, "dark_counts", light.dark_counts),
            ("ambient", "dark_counts", light.dark_counts, "ceiling_counts", light.ceiling_counts),
            ("proximity", "idle_counts", near.idle_counts, "limit_counts", near.limit_counts),
            ("proximity", "floor_counts", near.floor_counts, "limit_counts", near.limit_counts),
            ("proximity", "quantum_counts", near.quantum_counts, "limit_counts", near.limit_counts),
        )
        problems = [
            Problem.of((table, key), f"{table}: {key} = {value:g}", f"below {other} = {limit:g}", value)
            for table, key, value, other, limit in levels
            if value > limit - (key == "floor_counts")
        ]
        if problems:
            raise Problems(problems)
        return self


GAIN_SPREAD, THRESHOLD_SPREAD, LAMP_SPREAD = 0.13, 0.14, 0.055
"""Relative standard deviations of gain and threshold over the eight sensors of the sampled robot, and of
their gain for lamps (4 to 7 % measured)."""


def varied(calibration: Calibration, rng: np.random.Generator) -> Calibration:
    """Return a robot of the same make with random gain, threshold and gain for lamps of each sensor."""
    gains, thresholds = 1 + np.array([[GAIN_SPREAD], [THRESHOLD_SPREAD]]) * rng.standard_normal(
        (2, N_SENSORS)
    )
    proximity, ambient = calibration.proximity, calibration.ambient
    factors = {"gain_counts_mm2": gains, "threshold_counts": thresholds}
    changed = {
        name: tuple(
            float(value * max(factor, 0.2))
            for value, factor in zip(getattr(proximity, name), row, strict=True)
        )
        for name, row in factors.items()
    }
    lamps = tuple(
        gain * max(1 + LAMP_SPREAD * float(factor), 0.2)
        for gain, factor in zip(ambient.gain_counts_mm2_per_w, rng.standard_normal(N_SENSORS), strict=True)
    )
    return calibration.model_copy(
        update={
            "proximity": proximity.model_copy(update=changed),
            "ambient": ambient.model_copy(update={"gain_counts_mm2_per_w": lamps}),
        }
    )


def names() -> list[str]:
    """Return the names of the calibrations that ship with the package."""
    return toml_files.names("calibration")


def read(name: str) -> tuple[Calibration, str]:
    """Return a calibration by bare name or path, and the text of its file.

    Raises:
        CalibrationError: The file is missing or unusable; one line per problem.
    """
    text, source = toml_files.read("calibration", name, CalibrationError)
    return toml_files.validate(Calibration, text, source, CalibrationError), text
