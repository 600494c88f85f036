"""Numbers of a Khepera IV: channels in a log, and registers of the dsPIC on its I2C bus (library).

Channels have names of their numbers, and their unit in brackets.
"""

from enum import IntEnum

RING = ("back left", "left", "front left", "front", "front right", "right", "back right", "back")
GROUND = ("ground left", "ground front left", "ground front right", "ground right")
"""Names of the infrared sensors around the robot and of those that look at the floor."""

ULTRASONIC = ("left", "front left", "front", "front right", "right")
"""Names of the ultrasonic sensors, in the order of the registers."""

ULTRASONIC_CODES = TOO_NEAR, NO_ECHO, DISABLED = 0, 1000, 2000
"""Ultrasonic readings without a distance: too near, no echo, disabled (library)."""

BAUD = 115_200
"""Speed of the serial line [baud] (manual, chapter 6)."""

BINARY_BYTES = 128
"""Length of the reply to X."""

COUNTS_PER_G, DEGREES_PER_COUNT = 16_384, 0.066
"""Scales of the accelerometer, 12 bits, shifted left by 4, and of the gyroscope [deg/s] (manual)."""

PACKET_SIZE = 10
"""Values that the accelerometer and the gyroscope send together for each axis, the newest first (manual)."""

LEDS = ("left", "right", "back")
"""Names of the LEDs of three colours, in the order of the registers."""

_WHEEL_LABELS = "left, right, setpoint left, setpoint right"
_AXES = "x, y, z"
_INFRARED = ", ".join((*RING, *GROUND))

CHANNELS = {
    "proximity": f"{_INFRARED} [counts]",
    "ambient": f"{_INFRARED} [counts]",
    "ultrasonic": f"{', '.join(ULTRASONIC)} [cm]",
    "speed": f"{_WHEEL_LABELS} [pulses/10 ms]",
    "position": f"{_WHEEL_LABELS} [pulses]",
    "duty": "left, right [-2940 to 2940]",
    "leds": ", ".join(f"{led} {colour}" for led in LEDS for colour in ("red", "green", "blue"))
    + " [0 to 63]",
    "accelerometer": f"{_AXES} [1/{COUNTS_PER_G} g]",
    "gyroscope": f"{_AXES} [{DEGREES_PER_COUNT} deg/s]",
    "battery": "voltage, current, charge, temperature [9.76 mV; 0.0781 mA; 1.6 mAh; 1/256 degree C]",
    "control": "type, on target, ultrasonic enabled, status LED [register]",
}
"""Label of each channel, in the order of the log's registers."""


ADDRESS = 0x30
"""Address on the I2C bus."""

N_BYTES = 256
"""Bytes of the map; unused bytes are 0 (assumed)."""


class DspicRegister(IntEnum):
    """First byte of each register; numbers of several bytes are little-endian."""

    REVISION = 0x00  # high nibble the letter, from A, low nibble the number
    STATUS_LED = 0x01
    LEDS = 0x02  # red, green, blue of front left, front right and back, 0 to 63 each
    KP = 0x0B
    KI = 0x0C
    KD = 0x0D
    ACCELERATION = 0x0E  # [pulses/10 ms] for each `ACCELERATION_DIVIDER` + 1 control periods
    ACCELERATION_DIVIDER = 0x0F
    LEAST_ACCELERATING = 0x10  # speed at which a ramp up starts [pulses/10 ms]
    LEAST_DECELERATING = 0x11  # speed at which a ramp down ends [pulses/10 ms]
    POSITION_MARGIN = 0x12  # distance from a target at which it is reached [pulses]
    POSITION_SPEED = 0x14  # speed of a move to a target [pulses/10 ms]
    RESET_ENCODERS = 0x16
    CONTROL = 0x17  # `Control` of both motors
    SPEED_ORDER_LEFT = 0x18  # [pulses/10 ms]
    SPEED_ORDER_RIGHT = 0x1A
    PWM_ORDER_LEFT = 0x1C
    PWM_ORDER_RIGHT = 0x1E
    POSITION_ORDER_LEFT = 0x20  # [pulses]
    POSITION_ORDER_RIGHT = 0x24
    SPEED_LEFT = 0x28  # [pulses/10 ms]
    SPEED_RIGHT = 0x2A
    ON_TARGET = 0x2C  # bit 0 left, bit 1 right
    POSITION_LEFT = 0x2D  # [pulses]
    POSITION_RIGHT = 0x31
    AMBIENT = 0x40  # 12 sensors, 2 bytes each
    PROXIMITY = 0x58  # 12 sensors, 2 bytes each
    ULTRASONIC = 0x70  # 5 sensors, 2 bytes each [cm]
    ULTRASONIC_ENABLED = 0x7A  # bit 0 left to bit 4 right
    ACCELEROMETER = 0x80  # x, y, z, 10 values of 2 bytes each, newest first
    GYROSCOPE = 0xC0  # the same
    BATTERY = 0xFD  # 12 bytes, which continue after the map


class Control(IntEnum):
    """Control type of both motors."""

    IDLE = 0
    SPEED = 1
    SPEED_PROFILE = 2
    POSITION = 3
    OPEN_LOOP = 4


WRITABLE = range(DspicRegister.STATUS_LED, DspicRegister.SPEED_LEFT)
"""Bytes that a write changes, besides the mask of the ultrasonic sensors; others are read-only (assumed)."""

BATTERY_BYTES = 12
"""Length of the block of the battery gauge."""

RESET_VALUES = {
    DspicRegister.REVISION: bytes([0x10]),  # revision B, 0 (assumed)
    DspicRegister.KP: bytes([10, 5, 1]),  # gains of the manual's programs
    DspicRegister.ACCELERATION: bytes([3, 0, 20, 1]),
    DspicRegister.POSITION_MARGIN: (10).to_bytes(2, "little"),
    DspicRegister.POSITION_SPEED: (400).to_bytes(2, "little"),
    DspicRegister.ULTRASONIC_ENABLED: bytes([0b11111]),
}
"""Content after a reset; the other bytes are 0 (manual; the same at power-up: assumed)."""
