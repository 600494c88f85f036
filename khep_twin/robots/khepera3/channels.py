"""Numbers of a Khepera III, and its channels in a log: names of their numbers, and their unit in brackets.

Motion in a log is positive forwards, by any options of the motor controllers. A unit of speed is 65,535 x 256
/ ticks for the time of 4 pulses in ticks of 1.6 us (manual): 0.149 pulses/s.
"""

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
