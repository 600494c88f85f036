"""Speeds of the Braitenberg vehicle of kh4server (library)."""

from collections.abc import Sequence

from khep_twin.board.kernel import divide

_LEFT_WEIGHTS, _RIGHT_WEIGHTS = (2, 3, 4, -7, -4, -3, -2, 1), (-2, -3, -4, -9, 4, 3, 2, 1)
_FORWARD_SPEED, _MIN_SPEED = 200, 10
_SATURATION, _THRESHOLD, _GAIN_DIVISOR = 500, 80, 3
"""Weights of the eight sensors; speed without obstacles and minimum speed [pulses/10 ms]; counts at which
readings saturate, and below which they have no effect."""


def vehicle_speeds(proximity: Sequence[int]) -> tuple[int, int]:
    """Return the speeds of the left and right wheel [pulses/10 ms] by the eight readings around the robot."""
    inputs = [0 if count < _THRESHOLD else (min(count, _SATURATION) - _THRESHOLD) // 2 for count in proximity]
    left, right = (
        divide(sum(map(int.__mul__, weights, inputs)), _GAIN_DIVISOR) + _FORWARD_SPEED
        for weights in (_LEFT_WEIGHTS, _RIGHT_WEIGHTS)
    )
    return _at_least_minimum(left), _at_least_minimum(right)


def _at_least_minimum(speed: int) -> int:
    return max(speed, _MIN_SPEED) if speed >= 0 else min(speed, -_MIN_SPEED)
