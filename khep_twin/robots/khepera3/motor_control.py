"""Control of one wheel by its motor controller, once in 10 ms, on integers. The functions are `compilable`.

Speed and position follow

    PWM = (Kp e + Ki n sum(e) + Kd (e - last e) / n) / scale

with the n samples of a control period. The sample time of 1550 ticks, 2.48 ms (assumed), gives the usual Kp
620 and Ki 10 a reset time of 154 ms. The scales are assumed: with them speed and position settle.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from khep_twin.board.kernel import clip, divide, square_root, wrap
from khep_twin.board.memory import read_signed, write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera3 import registers
from khep_twin.robots.khepera3.registers import ControlType, MotorRegister, Option, PicMode, Status
from khep_twin.sensing.buffers import Vector
from khep_twin.units import TICK_NS

_SPEED_SCALE, _POSITION_SCALE, _SUM_SCALE, _SUM_PART = 10_240, 640, 4, 8
"""Divisors of the gains of speed and position; further divisor of the sum of position errors, and part of the
PWM to which it is limited (assumed)."""

_TICKS = TICK_NS // 1600
"""Timer's ticks in a control period."""

_SPEED_STEP, _BRAKING = 10, round(2000 / registers.PULSES_PER_SPEED)
"""Change of a profile's speed in a control period, and its double square per pulse, for each unit of
acceleration: 30 reaches 15,000 in 0.5 s (a public program)."""

_LEAD, _LEAST_APPROACH, _NEAR_MARGINS = 5, 600, 10
"""Control periods by which a move brakes early, its least speed, and distance at which a target is near, in
margins (assumed)."""


class Pic(IntEnum):
    """Numbers of a motor controller; signs are those of the controller."""

    POSITION = 0  # [pulses]
    SPEED = 1
    PWM = 2
    CURRENT = 3  # [mA]
    SET_POINT = 4  # in force
    HOLD_POSITION = 5  # position to hold in mode STOP [pulses]
    ON_TARGET = 6  # 1 when its last move is complete
    RAMP = 7  # present speed order of a profile
    ERROR = 8  # last error
    ERROR_SUM = 9
    BLOCKED = 10  # control periods without motion at too much current
    PULSES = 11  # of the encoder at the last control period


class MotorState(NamedTuple):
    """State of a motor controller.

    Attributes:
        memory: Bytes of its registers (registers.N_BYTES,).
        numbers: Numbers of `Pic` (n,).
        mounting: Sign of forward motion: 1, or -1 for the left motor, which is mounted the other way round.
    """

    memory: Vector[int]
    numbers: Vector[int]
    mounting: int


def power_up(mounting: int) -> MotorState:
    """Return the state at power-up."""
    state = MotorState(np.zeros(registers.N_BYTES, np.int64), np.zeros(len(Pic), np.int64), mounting)
    reset(state)
    return state


def reset(motor: MotorState) -> None:
    """Return to the state at power-up, except for the pulses of the encoder."""
    for register in range(registers.N_BYTES):
        motor.memory[register] = 0
    for number in range(Pic.PULSES):
        motor.numbers[number] = 0
    for register, size, value in registers.DEFAULTS:
        write_number(motor.memory, register, size, value)


@compilable
def direction(motor: MotorState) -> int:
    """Return the controller's sign of forward motion."""
    return -motor.mounting if motor.memory[MotorRegister.OPTIONS] & Option.INVERTED else motor.mounting


@compilable
def measured_speed(pulse_rate: float) -> int:
    """Return the measured speed of a wheel by its pulses per second, 0 below the slowest (assumed)."""
    ticks = int(registers.SPEED_NUMERATOR * registers.PULSES_PER_SPEED / max(abs(pulse_rate), 1e-3))
    speed = registers.SPEED_NUMERATOR // max(ticks, 1) if ticks < 0x10000 else 0
    return speed if pulse_rate > 0 else -speed


@compilable
def set_order(motor: MotorState, control: int, order: int) -> None:
    """Set control type and set point of a motor in normal mode."""
    if motor.memory[MotorRegister.CONTROL] != control or motor.memory[MotorRegister.MODE] != PicMode.NORMAL:
        halt(motor)
    motor.memory[MotorRegister.MODE] = PicMode.NORMAL
    motor.memory[MotorRegister.CONTROL] = control
    motor.numbers[Pic.SET_POINT] = wrap(order)
    motor.numbers[Pic.ON_TARGET] = 0
    write_number(motor.memory, MotorRegister.SET_POINT, 4, order)


@compilable
def halt(motor: MotorState) -> None:
    """Reset the control, and set the PWM to 0."""
    numbers = motor.numbers
    numbers[Pic.PWM] = numbers[Pic.RAMP] = numbers[Pic.ERROR] = numbers[Pic.ERROR_SUM] = 0


@compilable
def control_motor(motor: MotorState) -> None:
    """Run one control period of a motor."""
    memory, numbers = motor.memory, motor.numbers
    mode, control = memory[MotorRegister.MODE], memory[MotorRegister.CONTROL]
    order = numbers[Pic.SET_POINT]
    if mode == PicMode.STOP:
        control, order = ControlType.POSITION.value, numbers[Pic.HOLD_POSITION]
    if (mode != PicMode.NORMAL and mode != PicMode.STOP) or memory[MotorRegister.ERRORS]:
        halt(motor)
    elif control == ControlType.OPEN_LOOP:
        numbers[Pic.PWM] = clip(order, registers.PWM_LIMIT)
    elif control == ControlType.POSITION:
        _hold(motor, order - numbers[Pic.POSITION])
    elif control == ControlType.POSITION_PROFILE:
        _approach(motor, order - numbers[Pic.POSITION])
    elif control == ControlType.SPEED:
        _regulate(motor, order)
    elif control == ControlType.SPEED_PROFILE:
        step = memory[MotorRegister.ACCELERATION] * _SPEED_STEP
        numbers[Pic.RAMP] += clip(order - numbers[Pic.RAMP], step)
        _regulate(motor, numbers[Pic.RAMP])
    elif control == ControlType.CURRENT:
        numbers[Pic.PWM] = clip(numbers[Pic.PWM] + order - numbers[Pic.CURRENT], registers.PWM_LIMIT)
    else:
        halt(motor)
    status = _protect(motor)
    memory[MotorRegister.STATUS] = status | _status_of(motor, control, order)


@compilable
def _regulate(motor: MotorState, order: int) -> None:
    """Set the PWM for a speed; a wheel at rest that shall rest gets none (assumed)."""
    if order == 0 and motor.numbers[Pic.SPEED] == 0:
        halt(motor)
    else:
        error = order - motor.numbers[Pic.SPEED]
        _drive(motor, MotorRegister.SPEED_GAINS.value, error, _SPEED_SCALE, 1, 1)


@compilable
def _hold(motor: MotorState, distance: int) -> None:
    """Set the PWM for a position at a distance [pulses]; only small errors are summed (assumed)."""
    numbers, margin = motor.numbers, motor.memory[MotorRegister.MARGIN]
    numbers[Pic.ON_TARGET] = 1 if abs(distance) <= margin else 0
    if distance == 0 or abs(distance) > _NEAR_MARGINS * margin:
        numbers[Pic.ERROR_SUM] = 0
    gains = MotorRegister.POSITION_GAINS.value
    _drive(motor, gains, distance, _POSITION_SCALE, _SUM_SCALE, _SUM_PART)


@compilable
def _drive(motor: MotorState, gains: int, error: int, scale: int, sum_scale: int, sum_part: int) -> None:
    """Set the PWM by an error; the sum of errors is limited to a part of the PWM (anti-windup)."""
    memory, numbers, error = motor.memory, motor.numbers, clip(error, 2**31 - 1)
    kp, kd = read_signed(memory, gains, 2), read_signed(memory, gains + 2, 2)
    ki = read_signed(memory, gains + 4, 2)
    sample_time = max(read_signed(memory, MotorRegister.SAMPLE_TIME, 2) & 0xFFFF, 1)
    change = divide(ki * error * _TICKS, sample_time)
    limit = registers.PWM_LIMIT * scale * sum_scale // sum_part
    numbers[Pic.ERROR_SUM] = clip(numbers[Pic.ERROR_SUM] + change, limit) if ki else 0
    output = kp * error + divide(numbers[Pic.ERROR_SUM], sum_scale)
    output += divide(kd * (error - numbers[Pic.ERROR]) * sample_time, _TICKS)
    numbers[Pic.ERROR] = error
    numbers[Pic.PWM] = clip(divide(output, scale), registers.PWM_LIMIT)


@compilable
def _approach(motor: MotorState, distance: int) -> None:
    """Follow a trapezoidal speed profile to a target at a distance [pulses], and stop there."""
    memory, numbers = motor.memory, motor.numbers
    n_margins = _NEAR_MARGINS if numbers[Pic.ON_TARGET] else 1
    if abs(distance) <= n_margins * memory[MotorRegister.MARGIN]:
        if not numbers[Pic.ON_TARGET]:
            halt(motor)
        _hold(motor, distance)
        numbers[Pic.ON_TARGET] = 1
        return
    numbers[Pic.ON_TARGET] = 0
    acceleration, towards = max(memory[MotorRegister.ACCELERATION], 1), 1 if distance > 0 else -1
    lead = int(_LEAD * abs(numbers[Pic.SPEED]) * (registers.PULSES_PER_SPEED * TICK_NS * 1e-9))
    braking_speed = square_root(max(_BRAKING * acceleration * (abs(distance) - lead), 1))
    least_speed = max(read_signed(memory, MotorRegister.LEAST_SPEED, 2) & 0xFFFF, _LEAST_APPROACH)
    next_speed = max(towards * numbers[Pic.RAMP] + acceleration * _SPEED_STEP, least_speed)
    top = read_signed(memory, MotorRegister.TOP_SPEED, 2) & 0xFFFF
    numbers[Pic.RAMP] = towards * min(next_speed, max(braking_speed, least_speed), top)
    _regulate(motor, numbers[Pic.RAMP])


@compilable
def _protect(motor: MotorState) -> int:
    """Stop a motor at a soft stop, and one that is blocked, as the options say; return its status."""
    memory, numbers, status = motor.memory, motor.numbers, 0
    options, pwm, position = memory[MotorRegister.OPTIONS], numbers[Pic.PWM], numbers[Pic.POSITION]
    is_low = pwm < 0 and position < read_signed(memory, MotorRegister.LOWEST, 4)
    is_high = pwm > 0 and position > read_signed(memory, MotorRegister.HIGHEST, 4)
    if (is_low and options & Option.STOP_AT_LOWEST) or (is_high and options & Option.STOP_AT_HIGHEST):
        halt(motor)
        status = Status.AT_STOP.value
        memory[MotorRegister.ERRORS] |= registers.STOP_ERROR if options & Option.ERROR_AT_STOPS else 0
    limit = read_signed(memory, MotorRegister.CURRENT_LIMIT, 2) & 0xFFFF
    is_blocked = numbers[Pic.SPEED] == 0 and abs(numbers[Pic.CURRENT]) > limit
    numbers[Pic.BLOCKED] = numbers[Pic.BLOCKED] + 1 if is_blocked else 0
    if options & Option.STOP_WHEN_BLOCKED and numbers[Pic.BLOCKED] > memory[MotorRegister.BLOCKED_TIME]:
        memory[MotorRegister.ERRORS] |= registers.BLOCKED_ERROR
        halt(motor)
    return status


@compilable
def _status_of(motor: MotorState, control: int, order: int) -> int:
    """Return the status of a motor by its motion."""
    numbers, margin = motor.numbers, motor.memory[MotorRegister.MARGIN]
    speed, status = numbers[Pic.SPEED], 0
    if speed:
        status |= Status.MOVING
    if speed > 0:
        status |= Status.POSITIVE
    if control == ControlType.POSITION or control == ControlType.POSITION_PROFILE:
        distance = abs(order - numbers[Pic.POSITION])
        is_reached, is_near = numbers[Pic.ON_TARGET] != 0, distance <= _NEAR_MARGINS * margin
    else:
        # By the resolution of the measured speed.
        is_reached = is_near = abs(order - speed) <= speed * speed // registers.SPEED_NUMERATOR + 1
    if is_reached:
        status |= Status.ON_TARGET
    if is_near:
        status |= Status.NEAR_TARGET
    if abs(numbers[Pic.PWM]) >= registers.PWM_LIMIT:
        status |= Status.SATURATED
        if motor.memory[MotorRegister.OPTIONS] & Option.ANTI_WINDUP:
            status |= Status.ANTI_WINDUP
    if control == ControlType.CURRENT:
        status |= Status.CURRENT_CONTROL
    return status
