"""Fitness of one moment of a robot's life, as the classics of evolutionary robotics have it.

Plain numbers in, plain numbers out, so that they are compiled too. A life's fitness is the mean over its
control periods.
"""

import math

TOP_SPEED_PULSES = 20
"""Speed that counts as 1 in the fitness [pulses/10 ms]: twice that of the robot's own demo (assumed)."""

WALL_COUNTS_SHARE = 0.5
"""Reading of a side sensor, as a part of its limit, at which a wall is followed best (assumed)."""


def obstacle_avoidance(left_pulses: float, right_pulses: float, nearest: float) -> float:
    """Floreano and Mondada's fitness (1994): V (1 - sqrt(dV)) (1 - i).

    V is the mean of both wheels' speeds without their signs, dV the difference of the speeds with their
    signs, both as parts of what there can be, and i the reading of the sensor that is nearest to something,
    0 to 1.

    Args:
        left_pulses: speed of the left wheel [pulses/10 ms].
        right_pulses: speed of the right wheel.
        nearest: largest proximity as a part of its limit.
    """
    left, right = _part(left_pulses), _part(right_pulses)
    return (abs(left) + abs(right)) / 2 * (1 - math.sqrt(abs(left - right) / 2)) * (1 - nearest)


def homing(left_pulses: float, right_pulses: float, nearest: float) -> float:
    """Floreano and Mondada's fitness (1996) outside the home, V (1 - i), with the same V and i."""
    return (abs(_part(left_pulses)) + abs(_part(right_pulses))) / 2 * (1 - nearest)


def light_seeking(darkest: float, dark: float, floor: float) -> float:
    """How brightly the receiver that sees most light is lit, 0 in the dark to 1 (ours).

    Args:
        darkest: lowest ambient reading; low is bright [counts].
        dark: reading in the dark.
        floor: reading in the brightest light.
    """
    return min(max((dark - darkest) / (dark - floor), 0.0), 1.0)


def wall_following(left_pulses: float, right_pulses: float, side: float) -> float:
    """Straight on, forwards, beside a wall: V (1 - sqrt(dV)) (1 - |s - s0| / s0), not below 0 (ours).

    Args:
        left_pulses: speed of the left wheel [pulses/10 ms]; only forwards counts.
        right_pulses: likewise the right one.
        side: larger reading s of the sensors that look aside, as a part of the limit; s0 is half of it.
    """
    left, right = _part(left_pulses), _part(right_pulses)
    along = max(left + right, 0.0) / 2 * (1 - math.sqrt(abs(left - right) / 2))
    return along * max(1 - abs(side - WALL_COUNTS_SHARE) / WALL_COUNTS_SHARE, 0.0)


def _part(pulses: float) -> float:
    """A speed as a part of the top speed, -1 to 1."""
    return max(-1.0, min(1.0, pulses / TOP_SPEED_PULSES))
