"""Control of the Khepera IV's motors, once in 10 ms: PID, speed profile and position, on integers.

A motor is N_MOTOR numbers of a sequence, from an index on. The functions are `compilable`.

The law and its scale follow from four step responses of a real robot, all to a speed of 500 (recording): with
Kp 10 alone the speed settles at 199, with Kp 40 at 370; Kp 10 and Ki 10 peak at 750; Kp 10 and Ki 1 settle.
A PWM of (Kp e + Ki sum(e) + Kd (e - last e)) / 8 reproduces all four, on wheels with a first-order lag (time
constant 195 ms), a no-load speed of 0.625 pulses/10 ms per unit of PWM, and friction that lowers it by 36.
"""

from enum import IntEnum
from typing import NamedTuple

from khep_twin.board.kernel import clip, divide, square_root
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.registers import Control
from khep_twin.sensing.buffers import Vector

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


class Settings(NamedTuple):
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


class Motor(IntEnum):
    """Numbers of a motor."""

    POSITION = 0  # position of its wheel [pulses]
    SPEED = 1  # in the last control period [pulses/10 ms]
    PWM = 2  # -PWM_LIMIT to PWM_LIMIT
    ON_TARGET = 3  # 1 when its last move is complete
    RAMP = 4  # present speed order of a ramp [pulses/10 ms]
    WAIT = 5  # control periods until the next change of the ramp
    ERROR = 6  # last error of the controller [pulses/10 ms]
    ERROR_SUM = 7


N_MOTOR = len(Motor)

LEFT_PWM, RIGHT_PWM = int(Motor.PWM), N_MOTOR + int(Motor.PWM)
"""Indices of the PWM of both motors."""

# Plain integers, as each use of an enum as an index costs a look-up.
_POSITION, _SPEED, _PWM, _ON_TARGET, _RAMP, _WAIT, _ERROR, _ERROR_SUM = range(N_MOTOR)
_SPEED_CONTROL, _PROFILE, _MOVE, _OPEN = map(int, list(Control)[1:])


@compilable
def stop(motors: Vector[int], motor: int) -> None:
    """Reset the controller of a motor, and set its PWM to 0."""
    motors[motor + _PWM] = motors[motor + _RAMP] = motors[motor + _WAIT] = 0
    motors[motor + _ERROR] = motors[motor + _ERROR_SUM] = 0


@compilable
def control_motor(motors: Vector[int], motor: int, settings: Settings, control: int, order: int) -> None:
    """Run one control period of a motor.

    Args:
        motors: Numbers of the motors, changed in place.
        motor: Index of its first number.
        settings: Settings.
        control: Control type.
        order: Speed [pulses/10 ms], position [pulses] or PWM, by the control type.
    """
    if control == _SPEED_CONTROL:
        _regulate(motors, motor, settings, order)
    elif control == _PROFILE:
        _ramp_to(motors, motor, settings, order)
        _regulate(motors, motor, settings, motors[motor + _RAMP])
    elif control == _MOVE:
        _approach(motors, motor, settings, order - motors[motor + _POSITION])
    elif control == _OPEN:
        stop(motors, motor)
        motors[motor + _PWM] = clip(order, PWM_LIMIT)
    else:
        stop(motors, motor)


@compilable
def _regulate(motors: Vector[int], motor: int, settings: Settings, order: int) -> None:
    """Set the PWM for a speed; the sum of errors is limited to full PWM (anti-windup)."""
    error = order - motors[motor + _SPEED]
    if settings.ki:
        limit = PWM_LIMIT * GAIN_SCALE // settings.ki
        motors[motor + _ERROR_SUM] = clip(motors[motor + _ERROR_SUM] + error, limit)
    control_sum = settings.kp * error + settings.ki * motors[motor + _ERROR_SUM]
    control_sum += settings.kd * (error - motors[motor + _ERROR])
    motors[motor + _ERROR] = error
    motors[motor + _PWM] = clip(divide(control_sum, GAIN_SCALE), PWM_LIMIT)


@compilable
def _ramp_to(motors: Vector[int], motor: int, settings: Settings, order: int) -> None:
    """Change the ramp's speed by one step towards an order, unless it waits.

    A ramp from rest starts at the minimum speed, a ramp to rest ends there, and both hold it for
    HOLD_TICKS.
    """
    if motors[motor + _WAIT]:
        motors[motor + _WAIT] -= 1
        return
    ramp, min_speed = motors[motor + _RAMP], settings.least_accelerating
    is_reversal = ramp * order <= 0
    if ramp == 0:
        motors[motor + _RAMP] = clip(order, min_speed)
        motors[motor + _WAIT] = HOLD_TICKS if order else 0
    elif is_reversal and abs(ramp) <= min_speed:
        motors[motor + _RAMP] = 0
    else:
        goal = order
        if is_reversal:
            goal = min_speed if ramp > 0 else -min_speed
        ramp += clip(goal - ramp, max(settings.acceleration, 1))
        motors[motor + _RAMP] = ramp
        holds = is_reversal and ramp == goal
        motors[motor + _WAIT] = HOLD_TICKS if holds else settings.acceleration_divider


@compilable
def _approach(motors: Vector[int], motor: int, settings: Settings, distance: int) -> None:
    """Follow a trapezoidal speed profile to a target at a distance [pulses], and stop there."""
    margin = settings.position_margin
    if abs(distance) <= (_LOST_MARGINS if motors[motor + _ON_TARGET] else 1) * margin:
        motors[motor + _ON_TARGET] = 1
        stop(motors, motor)
        return
    motors[motor + _ON_TARGET] = 0
    step, period = max(settings.acceleration, 1), settings.acceleration_divider + 1
    # A ramp down from a speed v takes v (v + a) / (2 a) times its period.
    remaining = max(abs(distance) - LEAD_TICKS * abs(motors[motor + _SPEED]), 0)
    braking_speed = (square_root(step * step + 8 * step * remaining // period) - step) // 2
    wait, ramp = motors[motor + _WAIT], motors[motor + _RAMP]
    approach_speed = ramp if distance > 0 else -ramp
    next_speed = max(approach_speed + (0 if wait else step), settings.least_accelerating)
    motors[motor + _WAIT] = wait - 1 if wait else period - 1
    speed = max(min(next_speed, braking_speed, settings.position_speed), settings.least_decelerating)
    motors[motor + _RAMP] = speed if distance > 0 else -speed
    _regulate(motors, motor, settings, motors[motor + _RAMP])
