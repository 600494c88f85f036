"""Control of the Khepera IV's motors, once in 10 ms: PID, speed profile and position, on integers.

The law and its scale follow from four step responses of a real robot, all to a speed of 500 (recording): with
Kp 10 alone the speed settles at 199, with Kp 40 at 370; Kp 10 and Ki 10 peak at 750; Kp 10 and Ki 1 settle.
A PWM of (Kp e + Ki sum(e) + Kd (e - last e)) / 8 reproduces all four, on wheels with a first-order lag (time
constant 195 ms), a no-load speed of 0.625 pulses/10 ms per unit of PWM, and friction that lowers it by 36.
"""

import math
from dataclasses import dataclass

from khep_twin.board.kernel import clip, divide
from khep_twin.khepera4.registers import Control

PWM_LIMIT = 2940
"""Full PWM (manual)."""

GAIN_SCALE = 8
"""Divisor of the gains (assumed: step responses determine only its ratio to the speed per PWM)."""

HOLD_TICKS = 6
"""Control periods for which a ramp holds its minimum speed, 60 ms (manual, figure of the profile)."""

LEAD_TICKS = 1
"""Control periods by which a move brakes early (assumed: with it the manual's move of 70,000 pulses in 3.05 s
takes 3.01 s and ends within 10 pulses; with 2 it takes 3.24 s)."""

_LOST_MARGINS = 10
"""Distance from a reached target at which it counts as lost, in margins (assumed)."""


@dataclass(slots=True)
class Settings:
    """Settings of both motors, named as the registers."""

    kp: int
    ki: int
    kd: int
    acceleration: int
    acceleration_divider: int
    least_accelerating: int
    least_decelerating: int
    position_margin: int
    position_speed: int


@dataclass(slots=True)
class Motor:
    """One motor.

    Attributes:
        position: Position of its wheel [pulses].
        speed: Speed in the last control period [pulses/10 ms].
        pwm: PWM, -PWM_LIMIT to PWM_LIMIT.
        is_on_target: Whether its last move is complete.
        ramp: Present speed order of a ramp [pulses/10 ms].
        wait: Control periods until the next change of the ramp.
        error: Last error of the controller [pulses/10 ms].
        error_sum: Sum of the errors.
    """

    position: int = 0
    speed: int = 0
    pwm: int = 0
    is_on_target: bool = False
    ramp: int = 0
    wait: int = 0
    error: int = 0
    error_sum: int = 0

    def stop(self) -> None:
        """Reset the controller, and set the PWM to 0."""
        self.pwm = self.ramp = self.wait = self.error = self.error_sum = 0

    def tick(self, settings: Settings, control: Control, order: int) -> None:
        """Run one control period.

        Args:
            settings: Settings.
            control: Control type.
            order: Speed [pulses/10 ms], position [pulses] or PWM, by the control type.
        """
        if control is Control.SPEED:
            self._regulate(settings, order)
        elif control is Control.SPEED_PROFILE:
            self._ramp_to(settings, order)
            self._regulate(settings, self.ramp)
        elif control is Control.POSITION:
            self._approach(settings, order - self.position)
        elif control is Control.OPEN_LOOP:
            self.stop()
            self.pwm = clip(order, PWM_LIMIT)
        else:
            self.stop()

    def _regulate(self, settings: Settings, order: int) -> None:
        """Set the PWM for a speed; the sum of errors is limited to full PWM (anti-windup)."""
        error = order - self.speed
        if settings.ki:
            self.error_sum = clip(self.error_sum + error, PWM_LIMIT * GAIN_SCALE // settings.ki)
        control_sum = settings.kp * error + settings.ki * self.error_sum + settings.kd * (error - self.error)
        self.error = error
        self.pwm = clip(divide(control_sum, GAIN_SCALE), PWM_LIMIT)

    def _ramp_to(self, settings: Settings, order: int) -> None:
        """Change the ramp's speed by one step towards an order, unless it waits.

        A ramp from rest starts at the minimum speed, a ramp to rest ends there, and both hold it for
        HOLD_TICKS.
        """
        if self.wait:
            self.wait -= 1
            return
        min_speed = settings.least_accelerating
        is_reversal = self.ramp * order <= 0
        if self.ramp == 0:
            self.ramp = clip(order, min_speed)
            self.wait = HOLD_TICKS if order else 0
        elif is_reversal and abs(self.ramp) <= min_speed:
            self.ramp = 0
        else:
            goal = (min_speed if self.ramp > 0 else -min_speed) if is_reversal else order
            self.ramp += clip(goal - self.ramp, max(settings.acceleration, 1))
            self.wait = HOLD_TICKS if is_reversal and self.ramp == goal else settings.acceleration_divider

    def _approach(self, settings: Settings, distance: int) -> None:
        """Follow a trapezoidal speed profile to a target at a distance [pulses], and stop there."""
        margin = settings.position_margin
        self.is_on_target = abs(distance) <= (_LOST_MARGINS if self.is_on_target else 1) * margin
        if self.is_on_target:
            self.stop()
            return
        step, period = max(settings.acceleration, 1), settings.acceleration_divider + 1
        # A ramp down from a speed v takes v (v + a) / (2 a) times its period.
        remaining = max(abs(distance) - LEAD_TICKS * abs(self.speed), 0)
        braking_speed = (math.isqrt(step * step + 8 * step * remaining // period) - step) // 2
        approach_speed = self.ramp if distance > 0 else -self.ramp
        next_speed = max(approach_speed + (0 if self.wait else step), settings.least_accelerating)
        self.wait = self.wait - 1 if self.wait else period - 1
        speed = max(min(next_speed, braking_speed, settings.position_speed), settings.least_decelerating)
        self.ramp = speed if distance > 0 else -speed
        self._regulate(settings, self.ramp)
