"""Numbers of a Khepera III: channels in a log, addresses on its I2C bus, registers and settings.

Channels have names of their numbers, and their unit in brackets. Motion in a log is positive forwards, by any
options of the motor controllers. A unit of speed is 65,535 x 256 / ticks for the time of 4 pulses in ticks of
1.6 us (manual): 0.149 pulses/s.
"""

from enum import IntEnum

RING = (
    *("back left", "left", "front side left", "front left"),
    *("front right", "front side right", "right", "back right", "back"),
)
GROUND = ("ground right", "ground left")
"""Names of the infrared sensors around the robot and of those that look at the floor (manual)."""

ULTRASONIC = ("left", "front left", "front", "front right", "right")
"""Names of the ultrasonic sensors, in the order of their numbers, 1 to 5."""

NO_ECHO = 0
"""Ultrasonic reading without an echo, or of a sensor that is off (manual)."""

BAUD = 115_200
"""Speed of the serial line and of Bluetooth [baud] (manual)."""

SPEED_NUMERATOR, TICK_S, PULSES_PER_MEASUREMENT = 0xFFFF * 256, 1.6e-6, 4
"""Law of the measured speed: numerator, timer's tick [s], and pulses whose time is measured (manual)."""

PULSES_PER_SPEED = PULSES_PER_MEASUREMENT / (SPEED_NUMERATOR * TICK_S)
"""Speed of one unit [pulses/s]."""

SPEED_UNIT = f"{PULSES_PER_SPEED:.4f} pulses/s"

PWM_LIMIT = 1023
"""PWM at full voltage (manual)."""

_WHEELS, _SETPOINTS = "left, right", "left, right, setpoint left, setpoint right"
_INFRARED = ", ".join((*RING, *GROUND))

CHANNELS = {
    "proximity": f"{_INFRARED} [counts]",
    "ambient": f"{_INFRARED} [counts]",
    "ultrasonic": f"{', '.join(ULTRASONIC)} [cm]",
    "speed": f"{_SETPOINTS} [{SPEED_UNIT}]",
    "position": f"{_SETPOINTS} [pulses]",
    "duty": f"{_WHEELS} [1/{PWM_LIMIT}]",
    "current": f"{_WHEELS} [mA]",
    "leds": "0, 1 [1 when lit]",
    "battery": "voltage, current, charge [mV; mA; mAh]",
    "control": "mode left, mode right, type left, type right, errors left, errors right [register]",
}
"""Label of each channel, in the order of the log's registers."""


DSPIC, MOTORS, CLOCK = 0x31, (0x29, 0x2A), 0x68
"""Addresses of the dsPIC, of the left and right motor controller, and of the real-time clock."""

N_BYTES = 0x80
"""Bytes of a motor controller's map; unused ones are 0 (assumed)."""


class MotorRegister(IntEnum):
    """First byte of each register of a motor controller; numbers of several bytes are little-endian."""

    VERSION = 0x00  # high nibble version, low nibble revision
    MODE = 0x28
    HARDWARE_OPTIONS = 0x2A
    OPTIONS = 0x2B
    CONTROL = 0x2C
    ERRORS = 0x2D
    STATUS = 0x2E
    SET_POINT = 0x2F  # 4 bytes, in force with the lowest, which hosts write last
    POSITION = 0x34  # 4 bytes [pulses]
    SPEED = 0x38  # 4 bytes
    SPEED_GAINS = 0x3E  # Kp, Kd, Ki, 2 bytes each
    SAMPLE_TIME = 0x44  # 2 bytes, in ticks of 1.6 us (assumed)
    BLOCKED_TIME = 0x46  # control periods (assumed)
    LOWEST = 0x4A  # soft stops, 4 bytes each [pulses]
    HIGHEST = 0x4E
    ACCELERATION = 0x52
    CURRENT_LIMIT = 0x56  # 2 bytes [mA] (unit assumed)
    LEAST_SAMPLE_TIME = 0x58
    CURRENT = 0x5A  # 2 bytes [mA] (unit assumed)
    OUTPUT = 0x5C  # 2 bytes, of the controller
    LEAST_SPEED = 0x5E  # 2 bytes, of a profile
    MARGIN = 0x60  # [pulses]
    POSITION_GAINS = 0x61  # Kp, Kd, Ki, 2 bytes each
    TOP_SPEED = 0x6D  # 2 bytes, of a move by a profile


class PicMode(IntEnum):
    """Mode of a motor controller."""

    IDLE = 0
    NORMAL = 1
    STOP = 2  # holds its position
    SLEEP = 3
    RESET = 4
    SAVE = 5  # the settings, after the key 0x55, 0xAA
    SEARCH = 6  # the soft stops


class ControlType(IntEnum):
    """Control type of a motor in normal mode; the last one, zero friction, is not built into the robot."""

    OPEN_LOOP = 0
    POSITION = 1
    POSITION_PROFILE = 2
    SPEED = 3
    SPEED_PROFILE = 4
    CURRENT = 5


class Option(IntEnum):
    """Bits of the software options of a motor controller."""

    ANTI_WINDUP = 2
    STOP_AT_LOWEST = 4
    STOP_AT_HIGHEST = 8
    ERROR_AT_STOPS = 16
    STOP_WHEN_BLOCKED = 32
    INVERTED = 128


class Status(IntEnum):
    """Bits of the status of a motor controller."""

    MOVING = 1
    POSITIVE = 2
    ON_TARGET = 4
    NEAR_TARGET = 8
    SATURATED = 16
    ANTI_WINDUP = 32
    CURRENT_CONTROL = 64
    AT_STOP = 128


STOP_ERROR, BLOCKED_ERROR = 8, 16
"""Errors of a soft stop and of a blocked motor; the control is off while there is an error."""

SINGLE_COUNT = 8
"""Hardware option that counts one edge of the encoder instead of four."""

DEFAULTS = (
    (MotorRegister.VERSION, 1, 0x68),  # 6.8, from which the toolbox writes the gains below
    *((MotorRegister.SPEED_GAINS + 2 * index, 2, gain) for index, gain in enumerate((620, 3, 10))),
    (MotorRegister.SAMPLE_TIME, 2, 1550),
    (MotorRegister.BLOCKED_TIME, 1, 10),
    (MotorRegister.LOWEST, 4, -10_000),
    (MotorRegister.HIGHEST, 4, 10_000),
    (MotorRegister.ACCELERATION, 1, 64),
    (MotorRegister.CURRENT_LIMIT, 2, 500),
    (MotorRegister.MARGIN, 1, 6),
    *((MotorRegister.POSITION_GAINS + 2 * index, 2, gain) for index, gain in enumerate((600, 20, 30))),
    (MotorRegister.TOP_SPEED, 2, 20_000),
)
"""Size and value of registers that are not 0 at power-up: acceleration and top speed by the manual, others as
most programs write them (assumed)."""


class Setting(IntEnum):
    """Index in the configuration of the dsPIC, which its letter C sets (manual)."""

    ULTRASONIC = 0  # mask of the active sensors, bit 0 left
    N_ECHOES = 1  # greatest number of echoes
    INFRARED = 4  # mask of the active sensors, bit 0 back left
    VEHICLE_GAIN = 5


SETTINGS = (0b00100, 3, 0, 0, 0xFFFF, 12, 1)
"""Configuration at power-up (manual); the upper body, the last one, has no effect in the twin."""
