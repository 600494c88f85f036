"""Speeds of the Braitenberg vehicle of kh3server's letter A (library)."""

from collections.abc import Sequence

from khep_twin.board.kernel import divide

_LEFT_WEIGHTS = 2, 2, 2, 5, -12, -4, -2, 2, 4
_RIGHT_WEIGHTS = 2, -2, -4, -12, 5, 2, 2, 2, 4
_THRESHOLD, _SATURATION, _LARGEST = 100, 1000, 450
_DIVISOR, _FORWARD, _LEAST, _UNIT = 30, 20, 10, 256
"""Weights of nine sensors; counts below which readings have no effect, and above which they have the largest
one; speed without obstacles and least speed, in a unit of 256."""


def vehicle_speeds(proximity: Sequence[int]) -> tuple[int, int]:
    """Return the speeds of the left and right wheel by nine readings.

    The server passes the readings 1 to 9, so the one of the right ground sensor takes the place of the last.
    """
    inputs = [
        0 if count < _THRESHOLD else _LARGEST if count > _SATURATION else (count - _THRESHOLD) // 2
        for count in proximity
    ]
    left, right = (
        divide(sum(map(int.__mul__, weights, inputs)), _DIVISOR) + _FORWARD
        for weights in (_LEFT_WEIGHTS, _RIGHT_WEIGHTS)
    )
    return _UNIT * _at_least_least(left), _UNIT * _at_least_least(right)


def _at_least_least(speed: int) -> int:
    return max(speed, _LEAST) if speed >= 0 else min(speed, -_LEAST)
