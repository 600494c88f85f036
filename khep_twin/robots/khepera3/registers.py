"""Addresses on the I2C bus, registers of a motor controller, and letters of the dsPIC (library)."""

from enum import IntEnum, IntFlag

DSPIC, MOTORS, CLOCK = 0x31, (0x29, 0x2A), 0x68
"""Addresses of the dsPIC, of the left and right motor controller, and of the real-time clock."""

N_BYTES = 0x80
"""Bytes of a motor controller's map; unused ones are 0 (assumed)."""


class MotorRegister(IntEnum):
    """First byte of each register of a motor controller; numbers of several bytes are little-endian."""

    VERSION = 0x00  # high nibble version, low nibble revision
    MODE = 0x28
    SOURCE = 0x29  # of the set point: 0 the bus, 1 analog, 2 to 4 waves
    HARDWARE_OPTIONS = 0x2A
    SOFTWARE_OPTIONS = 0x2B
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
    CURRENT = 0x5A  # 2 bytes [mA] (unit assumed)
    OUTPUT = 0x5C  # 2 bytes, of the controller
    LEAST_SPEED = 0x5E  # 2 bytes, of a profile
    MARGIN = 0x60  # [pulses]
    POSITION_GAINS = 0x61  # Kp, Kd, Ki, 2 bytes each
    TOP_SPEED = 0x6D  # 2 bytes, of a move by a profile


class Mode(IntEnum):
    """Mode of a motor controller."""

    IDLE = 0
    NORMAL = 1
    STOP = 2  # holds its position
    SLEEP = 3
    RESET = 4
    SAVE = 5  # the settings, after the key 0x55, 0xAA
    SEARCH = 6  # the soft stops


class Control(IntEnum):
    """Control type of a motor in normal mode."""

    OPEN_LOOP = 0
    POSITION = 1
    POSITION_PROFILE = 2
    SPEED = 3
    SPEED_PROFILE = 4
    CURRENT = 5
    ZERO_FRICTION = 6  # not built into the robot


class Option(IntFlag):
    """Software options of a motor controller."""

    DERIVE_MEASURED = 1
    ANTI_WINDUP = 2
    STOP_AT_LOWEST = 4
    STOP_AT_HIGHEST = 8
    ERROR_AT_STOPS = 16
    STOP_WHEN_BLOCKED = 32
    LIMIT_CURRENT = 64  # not built into the robot
    INVERTED = 128


class Status(IntFlag):
    """Status of a motor controller."""

    MOVING = 1
    POSITIVE = 2
    ON_TARGET = 4
    NEAR_TARGET = 8
    SATURATED = 16
    ANTI_WINDUP = 32
    CURRENT_CONTROL = 64
    AT_STOP = 128


BLOCKED_ERROR, STOP_ERROR = 16, 8
"""Errors of a blocked motor and of a soft stop; the control is off while there is an error."""

SINGLE_COUNT = 8
"""Hardware option that counts one edge of the encoder instead of four."""

DEFAULTS = {
    MotorRegister.VERSION: (0x68, 1),  # 6.8, from which the toolbox writes the gains below
    MotorRegister.SPEED_GAINS: (620, 2),
    MotorRegister.SPEED_GAINS + 2: (3, 2),
    MotorRegister.SPEED_GAINS + 4: (10, 2),
    MotorRegister.SAMPLE_TIME: (1550, 2),
    MotorRegister.BLOCKED_TIME: (10, 1),
    MotorRegister.LOWEST: (-10_000, 4),
    MotorRegister.HIGHEST: (10_000, 4),
    MotorRegister.ACCELERATION: (30, 1),
    MotorRegister.CURRENT_LIMIT: (500, 2),
    MotorRegister.MARGIN: (6, 1),
    MotorRegister.POSITION_GAINS: (600, 2),
    MotorRegister.POSITION_GAINS + 2: (20, 2),
    MotorRegister.POSITION_GAINS + 4: (30, 2),
    MotorRegister.TOP_SPEED: (15_000, 2),
}
"""Value and size of registers that are not 0 at power-up: those that most programs write (assumed)."""


class Setting(IntEnum):
    """Index in the configuration of the dsPIC, which its letter C sets (manual)."""

    ULTRASONIC = 0  # mask of the active sensors, bit 0 left
    N_ECHOES = 1  # greatest number of echoes
    N_PULSES = 2  # not modelled
    UNUSED = 3
    INFRARED = 4  # mask of the active sensors, bit 0 back left
    VEHICLE_GAIN = 5
    UPPER_BODY = 6  # not modelled


SETTINGS = (0b00100, 3, 0, 0, 0xFFFF, 12, 1)
"""Configuration at power-up (manual)."""
