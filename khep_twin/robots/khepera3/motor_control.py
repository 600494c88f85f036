"""Control of one wheel by its motor controller, once in 10 ms, on integers. The functions are `compilable`.

A controller is N_BYTES bytes of registers and N_MOTOR numbers, each in a sequence from an index on. Speed and
position follow

    PWM = (Kp e + Ki n sum(e) + Kd (e - last e) / n) / scale

with the n samples of a control period of 10 ms. The sample time of 1550 ticks, 2.48 ms (assumed), gives the
usual Kp 620 and Ki 10 a reset time of 154 ms. The scale is assumed: the speed settles without an overshoot.
"""

from enum import IntEnum

from khep_twin.board.kernel import clip, divide, square_root, wrap
from khep_twin.compilable import compilable
from khep_twin.robots.khepera3.channels import PULSES_PER_SPEED, PWM_LIMIT, SPEED_NUMERATOR
from khep_twin.robots.khepera3.registers import (
    BLOCKED_ERROR,
    N_BYTES,
    STOP_ERROR,
    Control,
    Mode,
    MotorRegister,
    Option,
    Status,
)
from khep_twin.sensing.buffers import Vector
from khep_twin.units import TICK_NS

_SPEED_SCALE, _POSITION_SCALE, _CURRENT_GAIN = 320, 32, 20
"""Divisors of the gains of speed and position, and gain of the current [PWM/mA] (assumed)."""

_SUM_SCALE, _SUM_PART = 16, 32
"""Further divisor of the sum of position errors, and part of the PWM to which it is limited (assumed)."""

_TICKS = TICK_NS // 1600
"""Timer's ticks in a control period."""

_SPEED_STEP = 10
"""Change of a profile's speed in a control period by each unit of acceleration: 30 reaches 15,000 in 0.5 s
(a public program)."""

_LEAD = 5
"""Control periods by which a move brakes early (assumed)."""

_LEAST_APPROACH = 600
"""Least speed of a move by a profile (assumed; 256 is the slowest that is measured)."""

_LOST_MARGINS = 10
"""Distance from a reached target at which it counts as lost, in margins (assumed)."""

_NEAR_MARGINS = 10
"""Distance from a target at which the wheel is near it, in margins (assumed)."""


class Motor(IntEnum):
    """Numbers of a motor; signs are those of the controller."""

    POSITION = 0  # [pulses]
    SPEED = 1
    PWM = 2
    CURRENT = 3  # [mA]
    SET_POINT = 4  # in force
    HELD = 5  # position to hold in mode STOP [pulses]
    ON_TARGET = 6  # 1 when its last move is complete
    RAMP = 7  # present speed order of a profile
    ERROR = 8  # last error
    ERROR_SUM = 9
    BLOCKED = 10  # control periods without motion at too much current


N_MOTOR = len(Motor)

_POSITION, _SPEED, _PWM, _CURRENT, _SET_POINT, _HELD = range(6)
_ON_TARGET, _RAMP, _ERROR, _ERROR_SUM, _BLOCKED = range(6, N_MOTOR)
_OPEN_LOOP, _MOVE, _MOVE_PROFILE, _CONSTANT, _RAMPED, _TORQUE = map(int, list(Control)[:6])
_NORMAL, _STOP = int(Mode.NORMAL), int(Mode.STOP)
_MODE, _CONTROL, _ERRORS, _STATUS = (
    int(register)
    for register in (MotorRegister.MODE, MotorRegister.CONTROL, MotorRegister.ERRORS, MotorRegister.STATUS)
)
_SPEED_GAINS, _POSITION_GAINS = int(MotorRegister.SPEED_GAINS), int(MotorRegister.POSITION_GAINS)
_OPTIONS, _SAMPLE_TIME = int(MotorRegister.SOFTWARE_OPTIONS), int(MotorRegister.SAMPLE_TIME)
_LOWEST, _HIGHEST, _MARGIN = int(MotorRegister.LOWEST), int(MotorRegister.HIGHEST), int(MotorRegister.MARGIN)
_ACCELERATION, _TOP_SPEED = int(MotorRegister.ACCELERATION), int(MotorRegister.TOP_SPEED)
_LEAST_SPEED, _BLOCKED_TIME = int(MotorRegister.LEAST_SPEED), int(MotorRegister.BLOCKED_TIME)
_CURRENT_LIMIT, _WINDUP_OPTION = int(MotorRegister.CURRENT_LIMIT), int(Option.ANTI_WINDUP)
_SET_POINT_BYTES = int(MotorRegister.SET_POINT)
_BLOCKED_OPTION, _INVERTED = int(Option.STOP_WHEN_BLOCKED), int(Option.INVERTED)
_LOWEST_OPTION, _HIGHEST_OPTION = int(Option.STOP_AT_LOWEST), int(Option.STOP_AT_HIGHEST)
_ERROR_OPTION, _BRAKING = int(Option.ERROR_AT_STOPS), round(2000 / PULSES_PER_SPEED)
_MOVING, _POSITIVE, _REACHED, _NEAR, _SATURATED, _WINDUP, _BY_CURRENT, _AT_STOP = map(int, Status)


@compilable
def read_number(memory: Vector[int], first: int, size: int) -> int:
    """Return a signed number of `size` bytes."""
    number = 0
    for offset in range(size):
        number |= memory[first + offset] << 8 * offset
    return number - ((number >> 8 * size - 1) << 8 * size)


@compilable
def write_number(memory: Vector[int], first: int, size: int, number: int) -> None:
    """Set a number of `size` bytes, truncated as in C."""
    for offset in range(size):
        memory[first + offset] = number >> 8 * offset & 0xFF


@compilable
def direction(memory: Vector[int], side: int) -> int:
    """Return the controller's sign of forward motion; the left motor is mounted the other way round."""
    is_inverted = memory[side * N_BYTES + _OPTIONS] & _INVERTED != 0
    return 1 if is_inverted == (side == 0) else -1


@compilable
def measured_speed(pulse_rate: float) -> int:
    """Return the measured speed of a wheel by its pulses per second, 0 below the slowest (assumed)."""
    ticks = int(SPEED_NUMERATOR * PULSES_PER_SPEED / max(abs(pulse_rate), 1e-3))
    speed = SPEED_NUMERATOR // max(ticks, 1) if ticks < 0x10000 else 0
    return speed if pulse_rate > 0 else -speed


@compilable
def set_order(memory: Vector[int], motors: Vector[int], side: int, control: int, order: int) -> None:
    """Set control type and set point of a motor in normal mode."""
    first, motor = side * N_BYTES, side * N_MOTOR
    if memory[first + _CONTROL] != control or memory[first + _MODE] != _NORMAL:
        halt(motors, motor)
    memory[first + _MODE], memory[first + _CONTROL] = _NORMAL, control
    motors[motor + _SET_POINT] = wrap(order)
    motors[motor + _ON_TARGET] = 0
    write_number(memory, first + _SET_POINT_BYTES, 4, order)


@compilable
def halt(motors: Vector[int], motor: int) -> None:
    """Reset the controller of a motor, and set its PWM to 0."""
    motors[motor + _PWM] = motors[motor + _RAMP] = motors[motor + _ERROR] = motors[motor + _ERROR_SUM] = 0


@compilable
def control_motor(memory: Vector[int], motors: Vector[int], side: int) -> None:
    """Run one control period of a motor.

    Args:
        memory: Registers of both controllers, changed in place.
        motors: Numbers of both motors, changed in place.
        side: 0 left, 1 right.
    """
    first, motor = side * N_BYTES, side * N_MOTOR
    mode, control, order = memory[first + _MODE], memory[first + _CONTROL], motors[motor + _SET_POINT]
    if mode == _STOP:
        control, order = _MOVE, motors[motor + _HELD]
    if (mode != _NORMAL and mode != _STOP) or memory[first + _ERRORS]:
        halt(motors, motor)
    elif control == _OPEN_LOOP:
        halt(motors, motor)
        motors[motor + _PWM] = clip(order, PWM_LIMIT)
    elif control == _MOVE:
        _hold(memory, motors, first, motor, order - motors[motor + _POSITION])
    elif control == _MOVE_PROFILE:
        _approach(memory, motors, first, motor, order - motors[motor + _POSITION])
    elif control == _CONSTANT:
        _regulate(memory, motors, first, motor, order)
    elif control == _RAMPED:
        step = memory[first + _ACCELERATION] * _SPEED_STEP
        motors[motor + _RAMP] += clip(order - motors[motor + _RAMP], step)
        _regulate(memory, motors, first, motor, motors[motor + _RAMP])
    elif control == _TORQUE:
        change = _CURRENT_GAIN * (order - motors[motor + _CURRENT])
        motors[motor + _PWM] = clip(motors[motor + _PWM] + change, PWM_LIMIT)
    else:
        halt(motors, motor)
    _protect(memory, motors, first, motor)
    _report(memory, motors, first, motor, control, order)


@compilable
def _regulate(memory: Vector[int], motors: Vector[int], first: int, motor: int, order: int) -> None:
    """Set the PWM for a speed; a wheel at rest that shall rest gets none (assumed)."""
    if order == 0 and motors[motor + _SPEED] == 0:
        halt(motors, motor)
        return
    error = order - motors[motor + _SPEED]
    _drive(memory, motors, first, first + _SPEED_GAINS, motor, error, _SPEED_SCALE, 1, 1)


@compilable
def _hold(memory: Vector[int], motors: Vector[int], first: int, motor: int, distance: int) -> None:
    """Set the PWM for a position at a distance [pulses]."""
    is_there = abs(distance) <= memory[first + _MARGIN]
    motors[motor + _ON_TARGET] = 1 if is_there else 0
    _drive(memory, motors, first, first + _POSITION_GAINS, motor, distance, _POSITION_SCALE, _SUM_SCALE, _SUM_PART)


@compilable
def _drive(
    memory: Vector[int],
    motors: Vector[int],
    first: int,
    gains: int,
    motor: int,
    error: int,
    scale: int,
    sum_scale: int,
    sum_part: int,
) -> None:
    """Set the PWM by an error; the sum of errors is limited to a part of the PWM (anti-windup)."""
    kp, kd, ki = (
        read_number(memory, gains, 2),
        read_number(memory, gains + 2, 2),
        read_number(memory, gains + 4, 2),
    )
    sample_time = max(read_number(memory, first + _SAMPLE_TIME, 2) & 0xFFFF, 1)
    limit = PWM_LIMIT * scale * sum_scale // sum_part
    if ki:
        change = divide(ki * error * _TICKS, sample_time)
        motors[motor + _ERROR_SUM] = clip(motors[motor + _ERROR_SUM] + change, limit)
    else:
        motors[motor + _ERROR_SUM] = 0
    output = kp * error + divide(motors[motor + _ERROR_SUM], sum_scale)
    output += divide(kd * (error - motors[motor + _ERROR]) * sample_time, _TICKS)
    motors[motor + _ERROR] = error
    motors[motor + _PWM] = clip(divide(output, scale), PWM_LIMIT)


@compilable
def _approach(memory: Vector[int], motors: Vector[int], first: int, motor: int, distance: int) -> None:
    """Follow a trapezoidal speed profile to a target at a distance [pulses], and stop there."""
    margin = memory[first + _MARGIN]
    if abs(distance) <= (_LOST_MARGINS if motors[motor + _ON_TARGET] else 1) * margin:
        motors[motor + _ON_TARGET] = 1
        halt(motors, motor)
        return
    motors[motor + _ON_TARGET] = 0
    acceleration, towards = max(memory[first + _ACCELERATION], 1), 1 if distance > 0 else -1
    lead = int(_LEAD * abs(motors[motor + _SPEED]) * (PULSES_PER_SPEED * TICK_NS * 1e-9))
    braking_speed = square_root(max(_BRAKING * acceleration * (abs(distance) - lead), 1))
    least = max(read_number(memory, first + _LEAST_SPEED, 2) & 0xFFFF, _LEAST_APPROACH)
    top = read_number(memory, first + _TOP_SPEED, 2) & 0xFFFF
    next_speed = max(towards * motors[motor + _RAMP] + acceleration * _SPEED_STEP, least)
    motors[motor + _RAMP] = towards * min(next_speed, max(braking_speed, least), top)
    _regulate(memory, motors, first, motor, motors[motor + _RAMP])


@compilable
def _protect(memory: Vector[int], motors: Vector[int], first: int, motor: int) -> None:
    """Stop a motor at a soft stop, and one that is blocked, as the options say."""
    options, position, pwm = memory[first + _OPTIONS], motors[motor + _POSITION], motors[motor + _PWM]
    is_low = options & _LOWEST_OPTION and pwm < 0 and position < read_number(memory, first + _LOWEST, 4)
    is_high = options & _HIGHEST_OPTION and pwm > 0 and position > read_number(memory, first + _HIGHEST, 4)
    memory[first + _STATUS] = 0
    if is_low or is_high:
        halt(motors, motor)
        memory[first + _STATUS] = _AT_STOP
        if options & _ERROR_OPTION:
            memory[first + _ERRORS] |= STOP_ERROR
    limit = read_number(memory, first + _CURRENT_LIMIT, 2) & 0xFFFF
    is_blocked = motors[motor + _SPEED] == 0 and abs(motors[motor + _CURRENT]) > limit
    motors[motor + _BLOCKED] = motors[motor + _BLOCKED] + 1 if is_blocked else 0
    if options & _BLOCKED_OPTION and motors[motor + _BLOCKED] > memory[first + _BLOCKED_TIME]:
        memory[first + _ERRORS] |= BLOCKED_ERROR
        halt(motors, motor)


@compilable
def _report(
    memory: Vector[int], motors: Vector[int], first: int, motor: int, control: int, order: int
) -> None:
    """Set the status of a motor."""
    speed, is_position = motors[motor + _SPEED], control == _MOVE or control == _MOVE_PROFILE
    status = memory[first + _STATUS]
    status |= (_MOVING if speed else 0) | (_POSITIVE if speed > 0 else 0)
    if is_position:
        status |= _REACHED if motors[motor + _ON_TARGET] else 0
        distance = abs(order - motors[motor + _POSITION])
        status |= _NEAR if distance <= _NEAR_MARGINS * memory[first + _MARGIN] else 0
    elif control == _CONSTANT or control == _RAMPED:
        status |= _REACHED if abs(order - speed) <= speed * speed // SPEED_NUMERATOR + 1 else 0
    if abs(motors[motor + _PWM]) >= PWM_LIMIT:
        status |= _SATURATED | (_WINDUP if memory[first + _OPTIONS] & _WINDUP_OPTION else 0)
    memory[first + _STATUS] = status | (_BY_CURRENT if control == _TORQUE else 0)
