"""Moments of a robot whose infrared sensors convert together, and whose ultrasonic sensors take turns.

A moment is recorded in the step, and evaluated when its readings are read; eager robots evaluate a burst at
once. `robots.measuring_core` has the functions.
"""

from typing import Any

RobotState = Any
"""State of a robot: a named tuple of a class in `robots.core.CORES`, or its record in compiled code."""

INFRARED, BURST, ECHO = 0, 1, 2
"""Moments of a robot: of its infrared sensors, of the last burst, and of the last complete burst of each
ultrasonic sensor, from ECHO on."""

NONE = -1
"""No time of a moment; no ultrasonic sensor."""
