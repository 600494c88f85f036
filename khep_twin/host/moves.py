"""Lengths of moves in pulses of the wheels.

The wheels follow the board's speed profile (command J), and the board reports the arrival (command K).
"""

import math

from khep_twin.units import PULSE_LENGTH, WHEEL_BASE

TARGET_LIMIT_PULSES = 2**23 - 2
"""Farthest target of command C (manual, appendix A)."""


def way_pulses(distance: float) -> int:
    """Return the pulses of both wheels along a straight path [m]."""
    return round(check_finite("distance", distance) / PULSE_LENGTH)


def turn_pulses(angle: float, wheel_base: float = WHEEL_BASE) -> int:
    """Return the pulses of the right wheel, minus those of the left, for a turn in place [rad]."""
    return round(check_finite("angle", angle) * wheel_base / 2 / PULSE_LENGTH)


def check_finite(name: str, value: float) -> float:
    """Return a value; raise ValueError unless it is finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name} = {value}; expected a finite number")
    return value
