"""The robot's constants, each with its source, and the only unit conversions.

Sources, as cited below:
    manual      Khepera User Manual 5.02, K-Team, 1999 (section or appendix)
    manual II   Khepera II User Manual 1.1, K-Team, 2002
    simulators  what Michel's, Player's, Webots' and KiKS' models of the robot agree on
    assumed     no source; chosen so that the sourced behaviour comes out

`assets/khepera.xml` repeats the geometry and mass; a test asserts that they arrive in the compiled model.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

# Time --------------------------------------------------------------------------------------------------

STEP_NS = 2_500_000
"""One step of the physics is one conversion of the sensor scan [ns] (manual, 3.1.5: 2.5 ms)."""

TICK_NS = 10_000_000
"""Period of the motor controllers [ns] (manual, 3.1.3: 10 ms)."""

SCAN_NS = 20_000_000
"""Time in which all eight sensors are converted once [ns] (manual, 3.1.5: 20 ms)."""

# Body --------------------------------------------------------------------------------------------------

BODY_RADIUS = 0.0275
"""Half the diameter of 55 mm [m] (manual, specification; simulators)."""

BODY_HEIGHT = 0.030
"""[m] (manual, specification)."""

MASS = 0.070
"""Whole robot with batteries [kg] (about 70 g: K-Team's data sheet)."""

CENTRE_OF_MASS_HEIGHT = 0.008
"""[m] (assumed: the batteries lie at the bottom, Webots has 5 mm, half the height is 15 mm)."""

SUPPORT_POSITION = 0.022
"""The two sliding supports lie this far before and behind the centre [m] (assumed)."""

# Wheels and encoders -----------------------------------------------------------------------------------

PULSES_PER_TURN = 600
"""Encoder pulses per turn of a wheel: 24 per motor turn times gear 25:1 (manual, 3.1.3)."""

PULSE_LENGTH = 80e-6
"""Way of a wheel per pulse [m]: 0.08 mm (manual, appendix A). The same manual's 12 pulses per mm gives
0.0833 mm; the protocol's own examples and the toolbox use 0.08."""

WHEEL_RADIUS = PULSES_PER_TURN * PULSE_LENGTH / (2 * math.pi)
"""[m]: 7.64 mm, so that a pulse is exactly 0.08 mm."""

WHEEL_WIDTH = 0.003
"""[m] (simulators)."""

WHEEL_MASS = 0.004
"""[kg] (assumed)."""

WHEEL_BASE = 0.052
"""Distance of the two wheels' contact points [m] (52 to 53 mm: simulators, ruler)."""

# Motors ------------------------------------------------------------------------------------------------

SUPPLY_VOLTAGE = 5.0
"""On the charger, and at which the motors' figures hold [V] (assumed: four NiCd cells give 5.3 to 4.2 V over
most of the manual's figure 14)."""

MOTOR_NO_LOAD_SPEED = 150.0
"""Wheel speed at full duty without load [rad/s] (assumed: so that the manual's maximum of 127 pulses per
10 ms, 133 rad/s, can be held)."""

MOTOR_STALL_TORQUE = 0.010
"""Torque at a blocked wheel at full duty [N m] (assumed: well above the 2.4 mN m at which a tyre slips)."""

ROTOR_INERTIA = 1e-6
"""Of the motor's rotor, seen at the wheel through the gear [kg m^2] (assumed: with the robot's mass the
wheels then follow their voltage within 50 ms)."""

DUTY_LIMIT = 255
"""Full duty of the motors' pulse-width modulation (manual, appendix A, command P)."""

# Sensors -----------------------------------------------------------------------------------------------

N_SENSORS = 8


class Sensor(IntEnum):
    """The eight infrared sensors in the order of the replies to N and O (manual, appendix A)."""

    LEFT_90 = 0
    LEFT_45 = 1
    LEFT_10 = 2
    RIGHT_10 = 3
    RIGHT_45 = 4
    RIGHT_90 = 5
    BACK_RIGHT = 6
    BACK_LEFT = 7


SENSOR_POSITIONS = (
    (0.010, 0.024),
    (0.019, 0.017),
    (0.025, 0.006),
    (0.025, -0.006),
    (0.019, -0.017),
    (0.010, -0.024),
    (-0.024, -0.010),
    (-0.024, 0.010),
)
"""Of each sensor's face, x forward and y left of the robot's centre [m] (simulators)."""

SENSOR_HEIGHT = 0.0134
"""Above the ground [m] (manual, side view)."""


@dataclass(frozen=True, slots=True)
class Body:
    """The body of a model of the robot.

    Attributes:
        radius: of it [m].
        mass: of the whole robot [kg].
        support_position: of the sliding supports, before and behind the centre [m].
        sensor_positions: of the sensors' faces, x forward and y left of the centre (8, 2) [m].
        sensor_height: of the sensors above the ground [m].
    """

    radius: float
    mass: float
    support_position: float
    sensor_positions: tuple[tuple[float, float], ...]
    sensor_height: float


BODIES = {
    "khepera1": Body(BODY_RADIUS, MASS, SUPPORT_POSITION, SENSOR_POSITIONS, SENSOR_HEIGHT),
    "khepera2": Body(
        0.035,
        0.080,
        0.0295,
        (
            (0.0133, 0.0266),
            (0.0227, 0.0227),
            (0.0300, 0.0078),
            (0.0300, -0.0078),
            (0.0227, -0.0227),
            (0.0133, -0.0266),
            (-0.0289, -0.0111),
            (-0.0289, 0.0111),
        ),
        0.017,
    ),
}
"""By model. The Khepera II: 70 mm and 80 g (simulators, host libraries), sensors as in its manual's figure 7,
scaled to that diameter, their height after Webots; supports and height like the Khepera's (assumed)."""

SENSOR_HEADINGS = (
    math.radians(88),
    math.radians(45),
    math.radians(8),
    math.radians(-8),
    math.radians(-45),
    math.radians(-88),
    math.radians(180),
    math.radians(180),
)
"""Where each sensor looks, counter-clockwise from straight ahead [rad] (a lamp far away, measured on one
robot and made symmetric)."""

BULB_RADIUS = 0.010
"""Of a lamp [m] (that of the lamp which the calibration `khepera1` was sampled with)."""

COUNTS_LIMIT = 1023
"""Largest count of the 10-bit converter (manual, 3.1.5)."""

# Supply ------------------------------------------------------------------------------------------------

CONVERTER_COUNTS_PER_VOLT = 1024 / 4.096
"""Of the 10-bit converter (manual, appendix A, command I: 1024 is 4.09 V)."""

PROCESSOR_VOLTAGE = 4.0
"""Below it the processor fails and the motors still turn [V] (manual, 2.3 on the battery)."""

IDLE_CURRENT = 0.2
"""Of the robot with its motors at rest [A] (assumed: 180 mAh that last 45 minutes are 240 mA, driving)."""

# Gripper -----------------------------------------------------------------------------------------------

GRIPPER_NUMBER = 1
"""On the T bus (public host programs)."""

ARM_UP = 152
"""Highest place of the gripper's arm (public host programs keep to 152 to 255)."""

ARM_DOWN = 255
"""The arm's place with the fingers at the floor (public host programs)."""

FINGERS_OPEN = 200
"""The fingers' place with the widest gap, 55 mm; 0 is closed (simulators)."""

# Serial line -------------------------------------------------------------------------------------------

BITS_PER_BYTE = 11
"""One start, eight data and two stop bits (manual, 3.2)."""

# Conversions -------------------------------------------------------------------------------------------


def speed(speed_pulses: float) -> float:
    """A speed in pulses per 10 ms as the protocol counts it, in [m/s]."""
    return speed_pulses * PULSE_LENGTH / (TICK_NS * 1e-9)


def wheel_pulses(angle: float) -> int:
    """Whole pulses that the encoder has counted at a wheel angle [rad], which started amid a pulse."""
    return math.floor(angle * (PULSES_PER_TURN / (2 * math.pi)) + 0.5)


def duty_voltage(duty: int, supply_voltage: float) -> float:
    """Mean motor voltage [V] of a duty of -255 to 255."""
    return duty * (supply_voltage / DUTY_LIMIT)


def supply_current(duty: int, motor_current: float) -> float:
    """What a motor's current [A] takes from the supply at a duty [A]; braking gives nothing back."""
    return max(duty * motor_current / DUTY_LIMIT, 0.0)


def supply_counts(supply_voltage: float) -> int:
    """What the converter reads of a supply voltage [V]: half of it (assumed)."""
    return round(supply_voltage / 2 * CONVERTER_COUNTS_PER_VOLT)


def metres(length_mm: float) -> float:
    """A length of a playpen file [mm] in [m]."""
    return length_mm / 1000


def radians(angle_deg: float) -> float:
    """An angle of a playpen file [deg] in [rad]."""
    return math.radians(angle_deg)


def kilograms(mass_g: float) -> float:
    """A mass of a playpen file [g] in [kg]."""
    return mass_g / 1000
