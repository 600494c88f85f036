"""Speeds of the Braitenberg vehicle of letter A (library)."""

from collections.abc import Sequence
from operator import mul

from khep_twin.board.kernel import divide

_LEFT_WEIGHTS = 2, 2, 2, 5, -12, -4, -2, 2, 4
_RIGHT_WEIGHTS = 2, -2, -4, -12, 5, 2, 2, 2, 4
_THRESHOLD, _SATURATION, _LARGEST = 100, 1000, 450
_GAIN, _DIVISOR, _FORWARD, _LEAST, _UNIT = 12, 30, 20, 10, 256
"""Weights of nine sensors; counts below which readings have no effect, and above which they have the largest
one; gain at power-up (manual) and divisor; speed without obstacles and least speed, in a unit of 256."""


def vehicle_speeds(proximity: Sequence[int], gain: int = _GAIN) -> tuple[int, int]:
    """Return the speeds of the left and right wheel by nine readings.

    kh3server passes the readings 1 to 9, so that of the right ground sensor takes the place of the last. The
    firmware has the same law with the gain of its configuration (assumed).
    """
    inputs = [
        0 if count < _THRESHOLD else _LARGEST if count > _SATURATION else (count - _THRESHOLD) // 2
        for count in proximity
    ]
    left, right = (
        divide(gain * sum(map(mul, weights, inputs)), _GAIN * _DIVISOR) + _FORWARD
        for weights in (_LEFT_WEIGHTS, _RIGHT_WEIGHTS)
    )
    return _UNIT * _at_least_least(left), _UNIT * _at_least_least(right)


def _at_least_least(speed: int) -> int:
    return max(speed, _LEAST) if speed >= 0 else min(speed, -_LEAST)
