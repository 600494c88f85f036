"""Registers of the dsPIC, the microcontroller of the Khepera IV, on its I2C bus (library)."""

from enum import IntEnum

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
