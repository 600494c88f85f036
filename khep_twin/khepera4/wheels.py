"""Wheels of a Khepera IV off the ground: what its motors do without a body, in closed form."""

import math

LAG_S = 0.195
"""Time constant of a wheel's speed [s] (recording: see `motor_control`)."""

FREE_SPEED = 0.625
"""Speed per unit of PWM without friction [pulses/10 ms] (recording)."""

FRICTION = 36.0
"""Dry friction of motor and gear, as a speed [pulses/10 ms] (recording)."""

_TICK_S = 0.010
_LOST = 1 - math.exp(-_TICK_S / LAG_S)
"""Part of the difference from the free speed that a control period takes away."""


class Wheels:
    """Two wheels off the ground.

    Attributes:
        pulses: Pulses of the encoders, left and right.
        speeds: Speeds, left and right [pulses/10 ms].
    """

    def __init__(self) -> None:
        self.speeds, self._places = [0.0, 0.0], [0.0, 0.0]

    @property
    def pulses(self) -> tuple[int, int]:
        """Pulses of the encoders since power-up, left and right."""
        left, right = map(round, self._places)
        return left, right

    def turn(self, pwm: tuple[int, int]) -> tuple[int, int]:
        """Turn for a control period of 10 ms at these PWMs; return the pulses of the encoders."""
        for side in range(2):
            drive, before = FREE_SPEED * pwm[side], self.speeds[side]
            friction = math.copysign(FRICTION if before else min(abs(drive), FRICTION), before or drive)
            after = before + _LOST * (drive - friction - before)
            self.speeds[side] = 0.0 if after * before < 0 and abs(drive) <= FRICTION else after
            self._places[side] += self.speeds[side]
        return self.pulses
