"""Control of the Khepera IV's motors, once in 10 ms: PID, speed profile and position, on integers.

A motor is N_MOTOR numbers of a sequence, from an index on. The functions are `compilable`.

The law and its scale follow from four step responses of a real robot, all to a speed of 500 (recording): with
Kp 10 alone the speed settles at 199, with Kp 40 at 370; Kp 10 and Ki 10 peak at 750; Kp 10 and Ki 1 settle.
A PWM of (Kp e + Ki sum(e) + Kd (e - last e)) / 8 reproduces all four, on wheels with a first-order lag (time
constant 195 ms), a no-load speed of 0.625 pulses/10 ms per unit of PWM, and friction that lowers it by 36.
"""

from enum import IntEnum

from khep_twin.board.kernel import clip, divide, square_root
from khep_twin.board.memory import read_signed
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.registers import Control, DspicRegister
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
_KP, _KI, _KD, _STEP, _DIVIDER, _LEAST_UP, _LEAST_DOWN = range(
    DspicRegister.KP, DspicRegister.POSITION_MARGIN
)
_MARGIN, _TOP_SPEED = int(DspicRegister.POSITION_MARGIN), int(DspicRegister.POSITION_SPEED)


@compilable
def stop(motors: Vector[int], motor: int) -> None:
    """Reset the controller of a motor, and set its PWM to 0."""
    motors[motor + _PWM] = motors[motor + _RAMP] = motors[motor + _WAIT] = 0
    motors[motor + _ERROR] = motors[motor + _ERROR_SUM] = 0


@compilable
def control_motor(motors: Vector[int], motor: int, memory: Vector[int], control: int, order: int) -> None:
    """Run one control period of a motor.

    Args:
        motors: Numbers of the motors, changed in place.
        motor: Index of its first number.
        memory: Registers of the dsPIC, which have the settings of both motors.
        control: Control type.
        order: Speed [pulses/10 ms], position [pulses] or PWM, by the control type.
    """
    if control == _SPEED_CONTROL:
        _regulate(motors, motor, memory, order)
    elif control == _PROFILE:
        _ramp_to(motors, motor, memory, order)
        _regulate(motors, motor, memory, motors[motor + _RAMP])
    elif control == _MOVE:
        _approach(motors, motor, memory, order - motors[motor + _POSITION])
    elif control == _OPEN:
        stop(motors, motor)
        motors[motor + _PWM] = clip(order, PWM_LIMIT)
    else:
        stop(motors, motor)


@compilable
def _regulate(motors: Vector[int], motor: int, memory: Vector[int], order: int) -> None:
    """Set the PWM for a speed; the sum of errors is limited to full PWM (anti-windup)."""
    error = order - motors[motor + _SPEED]
    if memory[_KI]:
        limit = PWM_LIMIT * GAIN_SCALE // memory[_KI]
        motors[motor + _ERROR_SUM] = clip(motors[motor + _ERROR_SUM] + error, limit)
    control_sum = memory[_KP] * error + memory[_KI] * motors[motor + _ERROR_SUM]
    control_sum += memory[_KD] * (error - motors[motor + _ERROR])
    motors[motor + _ERROR] = error
    motors[motor + _PWM] = clip(divide(control_sum, GAIN_SCALE), PWM_LIMIT)


@compilable
def _ramp_to(motors: Vector[int], motor: int, memory: Vector[int], order: int) -> None:
    """Change the ramp's speed by one step towards an order, unless it waits.

    A ramp from rest starts at the minimum speed, a ramp to rest ends there, and both hold it for
    HOLD_TICKS.
    """
    if motors[motor + _WAIT]:
        motors[motor + _WAIT] -= 1
        return
    ramp, min_speed = motors[motor + _RAMP], memory[_LEAST_UP]
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
        ramp += clip(goal - ramp, max(memory[_STEP], 1))
        motors[motor + _RAMP] = ramp
        holds = is_reversal and ramp == goal
        motors[motor + _WAIT] = HOLD_TICKS if holds else memory[_DIVIDER]


@compilable
def _approach(motors: Vector[int], motor: int, memory: Vector[int], distance: int) -> None:
    """Follow a trapezoidal speed profile to a target at a distance [pulses], and stop there."""
    margin = read_signed(memory, _MARGIN, 2)
    if abs(distance) <= (_LOST_MARGINS if motors[motor + _ON_TARGET] else 1) * margin:
        motors[motor + _ON_TARGET] = 1
        stop(motors, motor)
        return
    motors[motor + _ON_TARGET] = 0
    step, period = max(memory[_STEP], 1), memory[_DIVIDER] + 1
    # A ramp down from a speed v takes v (v + a) / (2 a) times its period.
    remaining = max(abs(distance) - LEAD_TICKS * abs(motors[motor + _SPEED]), 0)
    braking_speed = (square_root(step * step + 8 * step * remaining // period) - step) // 2
    wait, ramp = motors[motor + _WAIT], motors[motor + _RAMP]
    approach_speed = ramp if distance > 0 else -ramp
    next_speed = max(approach_speed + (0 if wait else step), memory[_LEAST_UP])
    motors[motor + _WAIT] = wait - 1 if wait else period - 1
    speed = max(min(next_speed, braking_speed, read_signed(memory, _TOP_SPEED, 2)), memory[_LEAST_DOWN])
    motors[motor + _RAMP] = speed if distance > 0 else -speed
    _regulate(motors, motor, memory, motors[motor + _RAMP])
