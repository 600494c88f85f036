"""Constants of the robot, each with its source, and the unit conversions.

Sources, as cited below:
    manual      Khepera User Manual 5.02, K-Team, 1999 (section or appendix)
    manual II   Khepera II User Manual 1.1, K-Team, 2002
    simulators  values on which Michel's, Player's, Webots' and KiKS' models of the robot agree
    assumed     no source; chosen to reproduce the sourced behaviour

`assets/khepera.xml` repeats the geometry and mass; a test asserts that they arrive in the compiled model.
"""

import math
from enum import IntEnum, IntFlag

from khep_twin.compilable import compilable

# Time --------------------------------------------------------------------------------------------------

STEP_NS = 2_500_000
"""Step of the physics and of one conversion in the sensor scan [ns] (manual, 3.1.5: 2.5 ms)."""

TICK_NS = 10_000_000
"""Period of the motor controllers [ns] (manual, 3.1.3: 10 ms)."""

SCAN_NS = 20_000_000
"""Period of the scan of all eight sensors [ns] (manual, 3.1.5: 20 ms)."""

SCAN_STEPS = SCAN_NS // STEP_NS
"""Steps of a scan, each with a conversion."""

# Body --------------------------------------------------------------------------------------------------

BODY_RADIUS = 0.0275
"""Half the diameter of 55 mm [m] (manual, specification; simulators)."""

BODY_HEIGHT = 0.030
"""Height of the body [m] (manual, specification)."""

MASS = 0.070
"""Mass of the robot with batteries [kg] (about 70 g: K-Team's data sheet)."""

CENTRE_OF_MASS_HEIGHT = 0.008
"""Height of the centre of mass [m] (assumed: batteries at the bottom; Webots has 5 mm, half the height is
15 mm)."""

CENTRE_OF_MASS_BEHIND = 0.0005
"""Distance of the centre of mass behind the axle [m] (assumed: exactly above it, the robot would rock between
its supports at every change of duty)."""

SUPPORT_POSITION = 0.022
"""Distance of the two sliding supports before and behind the centre [m] (assumed)."""

SUPPORT_CLEARANCE = 50e-6
"""Height of the front support above the floor while wheels and back support stand on it [m] (assumed: the
wheels carry nearly all of the robot, 98 %)."""

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

# Wheels and encoders -----------------------------------------------------------------------------------

PULSES_PER_TURN = 600
"""Encoder pulses per turn of a wheel: 24 per motor turn times gear 25:1 (manual, 3.1.3)."""

PULSE_LENGTH = 80e-6
"""Travel of a wheel per pulse [m]: 0.08 mm (manual, appendix A). The same manual's 12 pulses per mm gives
0.0833 mm; the protocol's own examples and the toolbox use 0.08."""

WHEEL_RADIUS = PULSES_PER_TURN * PULSE_LENGTH / (2 * math.pi)
"""Radius of a wheel [m]: 7.64 mm, so that a pulse is exactly 0.08 mm."""

WHEEL_WIDTH = 0.003
"""Width of a wheel [m] (simulators)."""

WHEEL_MASS = 0.004
"""Mass of a wheel [kg] (assumed)."""

WHEEL_BASE = 0.052
"""Distance of the two wheels' contact points [m] (52 to 53 mm: simulators, ruler)."""

TYRE_FRICTION = 0.9
"""Friction of rubber tyres on the floor (0.9 to 1.2: simulators)."""

# Motors ------------------------------------------------------------------------------------------------

SUPPLY_VOLTAGE = 5.0
"""Voltage of the charger, for which the motors' figures hold [V] (assumed: four NiCd cells give 5.3 to 4.2 V
over most of the manual's figure 14)."""

MOTOR_NO_LOAD_SPEED = 150.0
"""Wheel speed at full duty without load [rad/s] (assumed: so that the manual's maximum of 127 pulses per
10 ms, 133 rad/s, can be held)."""

MOTOR_STALL_TORQUE = 0.010
"""Torque at a blocked wheel at full duty [N m] (assumed: well above the 2.4 mN m at which a tyre slips)."""

MOTOR_FRICTION_TORQUE = 0.0005
"""Dry friction of motor and gear, seen at the wheel [N m] (assumed: 5 % of the stall torque; a motor of that
size has 3 % by its data sheet, FAULHABER 0816 SR, and the gear its share)."""

ROTOR_INERTIA = 1e-6
"""Inertia of the motor's rotor, seen at the wheel through the gear [kg m^2] (assumed: with the robot's mass
the wheels then follow their voltage within 50 ms)."""

DUTY_LIMIT = 255
"""Full duty of the motors' pulse-width modulation (manual, appendix A, command P)."""

# Sensors -----------------------------------------------------------------------------------------------

N_SENSORS = 8
"""Number of infrared sensors of a Khepera; `Body.sensor_positions` has those of each model."""


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

    @property
    def key(self) -> str:
        """Name in models, tables and observations, for example "left_90"."""
        return self.name.lower()

    @property
    def label(self) -> str:
        """Name for readers, for example "left 90"."""
        return self.key.replace("_", " ")


SENSOR_LABELS = tuple(sensor.label for sensor in Sensor)
"""Names of the sensors for readers, in the order of the replies."""

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
"""Position of each sensor's face, x forward and y left of the robot's centre [m] (simulators)."""

SENSOR_HEIGHT = 0.0134
"""Height of the sensors above the ground [m] (manual, side view)."""

IDLE_CURRENT = 0.2364
"""Current of the robot with its motors at rest [A]: 180 mAh that last 45 minutes (manual, 2.3) are 240 mA, of
which the motors take 3.6 mA at 10 pulses per 10 ms, the speed of the ROM's demonstration (assumed)."""


SENSOR_HEADINGS = tuple(math.radians(heading_deg) for heading_deg in (88, 45, 8, -8, -45, -88, 180, 180))
"""Heading of each sensor, counter-clockwise from straight ahead [rad] (a lamp far away, measured on one
robot and made symmetric)."""

BULB_RADIUS = 0.010
"""Radius of a lamp [m] (that of the lamp with which the calibration `khepera1` was sampled)."""

COUNTS_LIMIT = 1023
"""Largest count of the 10-bit converter (manual, 3.1.5)."""

# Supply ------------------------------------------------------------------------------------------------

CONVERTER_COUNTS_PER_VOLT = 1024 / 4.096
"""Scale of the 10-bit converter [counts/V] (manual, appendix A, command I: 1024 is 4.09 V)."""

PROCESSOR_VOLTAGE = 4.0
"""Voltage below which the processor fails and the motors still turn [V] (manual, 2.3 on the battery)."""

# Gripper -----------------------------------------------------------------------------------------------

GRIPPER_NUMBER = 1
"""Number of the gripper on the T bus (public host programs)."""

ARM_UP = 152
"""Highest position of the gripper's arm (public host programs keep to 152 to 255)."""

ARM_DOWN = 255
"""Position of the arm with the fingers at the floor (public host programs)."""

FINGERS_OPEN = 200
"""Position of the fingers with the widest gap, 55 mm; 0 is closed (simulators)."""

# Radio -------------------------------------------------------------------------------------------------

RADIO_NUMBER = 4
"""Number of the radio turret on the T bus (simulators)."""

RADIO_BYTES = 16
"""Most bytes of a radio message (K-Team's manual of the radio base, 1999)."""

RADIO_ALL = -1
"""Radio number that addresses all radio turrets at once (manual of the radio base)."""


class RadioStatus(IntFlag):
    """Status bits of the radio turret (the first three: simulators; the last: assumed)."""

    READY = 1
    """It is not sending."""
    RECEIVED = 2
    """A received message waits to be read."""
    FAILED = 4
    """The last message was not acknowledged."""
    OVERRUN = 8
    """Since the last read a message found the buffer of received ones full."""


# Light ------------------------------------------------------------------------------------------------

ROOM_LUX = 300.0
"""Illuminance by a room's own light [lx] (assumed: an office)."""

# Linear vision -----------------------------------------------------------------------------------------

K213_NUMBER = 2
"""Number of the K213 linear vision turret on the T bus (public host programs)."""

K213_PIXELS = 64
"""Pixels of its line image (its manual, as public sources have it)."""

K213_EYE_AHEAD, K213_EYE_HEIGHT = 0.012, 0.040
"""Place of its lens, in front of the robot's centre [m] (assumed) and above the floor [m] (simulators)."""

K213_PERIODS_MS = (0, 50, 100, 150, 250, 500, 1000, 5000)
"""Period of a scan for each parameter of its order U [ms]; 0 for one by the light (simulators)."""

# Serial line -------------------------------------------------------------------------------------------

BITS_PER_BYTE = 11
"""Bits per byte: one start, eight data and two stop bits (manual, 3.2)."""

# Conversions -------------------------------------------------------------------------------------------


def speed(speed_pulses: float) -> float:
    """Convert a speed in the protocol's pulses per 10 ms to [m/s]."""
    return speed_pulses * PULSE_LENGTH / (TICK_NS * 1e-9)


@compilable
def wheel_pulses(angle: float) -> int:
    """Return the encoder's count at a wheel angle [rad]; angle 0 is in the middle of a pulse."""
    return math.floor(angle * (PULSES_PER_TURN / (2 * math.pi)) + 0.5)


@compilable
def duty_voltage(duty: int, supply_voltage: float) -> float:
    """Return the mean motor voltage [V] of a duty of -255 to 255."""
    return duty * (supply_voltage / DUTY_LIMIT)


@compilable
def supply_current(duty: int, motor_current: float) -> float:
    """Return the supply current [A] of a motor's current [A] at a duty; braking feeds nothing back."""
    return max(duty * motor_current / DUTY_LIMIT, 0.0)


@compilable
def supply_counts(supply_voltage: float) -> int:
    """Return the converter's reading of a supply voltage [V]: half of it (assumed)."""
    return round(supply_voltage / 2 * CONVERTER_COUNTS_PER_VOLT)


def metres(length_mm: float) -> float:
    """Convert a length of a playpen file [mm] to [m]."""
    return length_mm / 1000


def radians(angle_deg: float) -> float:
    """Convert an angle of a playpen file [deg] to [rad]."""
    return math.radians(angle_deg)


def kilograms(mass_g: float) -> float:
    """Convert a mass of a playpen file [g] to [kg]."""
    return mass_g / 1000
