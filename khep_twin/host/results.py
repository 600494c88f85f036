"""Results of commands: named tuples, with units."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from khep_twin.units import PULSE_LENGTH, speed


class Versions(NamedTuple):
    """Command B: versions of the robot's software, e.g. ("5.02", "5.01")."""

    bios: str
    """Version of the BIOS."""
    protocol: str
    """Version of the serial protocol."""


class Speeds(NamedTuple):
    """Command E: measured speeds of the wheels [pulses/10 ms], 8 mm/s each."""

    left: int
    right: int

    @property
    def si(self) -> tuple[float, float]:
        """Speeds [m/s]."""
        return speed(self.left), speed(self.right)


class Wheels(NamedTuple):
    """Speeds [m/s] or positions [m] of the wheels of a `ProfileRobot`."""

    left: float
    right: float


class Positions(NamedTuple):
    """Command H: position counters of the wheels [pulses], 0.08 mm each."""

    left: int
    right: int

    @property
    def si(self) -> tuple[float, float]:
        """Positions [m]."""
        return self.left * PULSE_LENGTH, self.right * PULSE_LENGTH


class SensorCounts(NamedTuple):
    """Commands N and O: eight counts, by name, by number or by `Sensor`, in the manual's order.

    Proximity is 0 (nothing) to 1023 (touching), ambient light about 500 (dark) to 50 (bright).
    """

    left_90: int
    left_45: int
    left_10: int
    right_10: int
    right_45: int
    right_90: int
    back_right: int
    back_left: int


class MotorMode(IntEnum):
    """Modes of a motor's controller, numbered as by command K of ROM 5.02; those of 4.06 are translated."""

    SPEED = 0
    POSITION = 1
    PWM = 2


@dataclass(frozen=True, slots=True)
class WheelStatus:
    """One wheel's motion control, as command K reports it.

    Attributes:
        on_target: True if the target is reached, and after a reset.
        mode: Mode of the motor, translated from the number in the robot's ROM.
        error: Error of the controller [pulses in position mode, pulses/10 ms in speed mode].
    """

    on_target: bool
    mode: MotorMode
    error: int


class MotionStatus(NamedTuple):
    """Command K: motion control of both wheels."""

    left: WheelStatus
    right: WheelStatus

    @property
    def on_target(self) -> bool:
        """True if both wheels have reached their targets."""
        return self.left.on_target and self.right.on_target


class Distances(NamedTuple):
    """Command G: distances by five ultrasonic sensors [m].

    0 is an object nearer than the range, infinity no object in it, None a sensor that is off.
    """

    left: float | None
    front_left: float | None
    front: float | None
    front_right: float | None
    right: float | None


class Battery(NamedTuple):
    """Command V: state of the battery.

    Voltage [V]; current and average current, below 0 while it is discharged [A]; remaining charge [mAh];
    temperature [degrees Celsius]; remaining part, 0 to 1; whether a charger is plugged in, None if unknown.
    """

    voltage: float
    current: float
    average_current: float
    charge_mah: float
    temperature_celsius: float
    level: float
    is_charging: bool | None = None
