"""Numbers of a Khepera IV, and its channels in a log: names of their numbers, and their unit in brackets."""

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
