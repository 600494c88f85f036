"""Fitness of one control period, as published in evolutionary robotics.

The functions accept numbers or arrays, and are compiled unchanged for numbers. The fitness of an episode is
the mean over its control periods.
"""

from typing import Any

import numpy as np

from khep_twin.compilable import compilable

Number = Any
"""A number, or an array of numbers (n,)."""

TOP_SPEED_PULSES = 20
"""Speed that counts as 1 in the fitness [pulses/10 ms]: twice that of the robot's demo (assumed)."""

WALL_COUNTS_SHARE = 0.5
"""Reading of a side sensor, as a part of its limit, for the best wall following (assumed)."""


@compilable
def obstacle_avoidance(left_pulses: Number, right_pulses: Number, proximity: Number) -> Number:
    """Return Floreano and Mondada's fitness (1994): V (1 - sqrt(dV)) (1 - i).

    V is the mean of both wheels' absolute speeds, dV the absolute difference of their signed speeds, both as
    parts of their maximum, and i the largest proximity reading, 0 to 1.

    Args:
        left_pulses: Speed of the left wheel [pulses/10 ms].
        right_pulses: Speed of the right wheel [pulses/10 ms].
        proximity: Largest proximity as a part of its limit.
    """
    left, right = _normalise(left_pulses), _normalise(right_pulses)
    return (abs(left) + abs(right)) / 2 * (1 - square_root(abs(left - right) / 2)) * (1 - proximity)


@compilable
def homing(left_pulses: Number, right_pulses: Number, proximity: Number) -> Number:
    """Return Floreano and Mondada's fitness (1996) outside the home, V (1 - i), with the same V and i."""
    return (abs(_normalise(left_pulses)) + abs(_normalise(right_pulses))) / 2 * (1 - proximity)


@compilable
def light_seeking(darkest: Number, dark: Number, floor: Number) -> Number:
    """Return the light at the brightest receiver, 0 in the dark to 1 (ours).

    Args:
        darkest: Lowest ambient reading; low is bright [counts].
        dark: Reading in the dark [counts].
        floor: Reading in the brightest light [counts].
    """
    return clip((dark - darkest) / (dark - floor), 0.0, 1.0)


@compilable
def wall_following(left_pulses: Number, right_pulses: Number, side: Number) -> Number:
    """Return the fitness of driving along a wall: V (1 - sqrt(dV)) (1 - |s - s0| / s0), at least 0 (ours).

    Args:
        left_pulses: Speed of the left wheel [pulses/10 ms]; only forward motion counts.
        right_pulses: Speed of the right wheel [pulses/10 ms]; only forward motion counts.
        side: Larger reading s of the two lateral sensors, as a part of the limit; s0 is half of the limit.
    """
    left, right = _normalise(left_pulses), _normalise(right_pulses)
    along = clip(left + right, 0.0, 2.0) / 2 * (1 - square_root(abs(left - right) / 2))
    return along * clip(1 - abs(side - WALL_COUNTS_SHARE) / WALL_COUNTS_SHARE, 0.0, 1.0)


@compilable
def effort(left_pulses: Number, right_pulses: Number) -> Number:
    """Return the control effort, the mean of the squares of both speeds as parts of their maximum, 0 to 1.

    It equals the energy in the reward of Grillotti and Cully (2023), relative to that at full speed.
    """
    left, right = _normalise(left_pulses), _normalise(right_pulses)
    return (left * left + right * right) / 2


@compilable
def _normalise(pulses: Number) -> Number:
    """Return a speed as a part of the top speed, -1 to 1."""
    return clip(pulses / TOP_SPEED_PULSES, -1.0, 1.0)


@compilable
def square_root(number: Number) -> Number:
    """Return the square root."""
    return np.sqrt(number)


@compilable
def clip(number: Number, low: float, high: float) -> Number:
    """Return a number clipped to limits."""
    return np.minimum(np.maximum(number, low), high)
