"""Arithmetic of the board: encoders, motor controllers, speed profile and sensor scan.

The whole state of the board is one int64 array: a copy is a snapshot and a stack of arrays is a batch.
All arithmetic is on integers, as on the robot. Numba can compile all functions: they use no objects, floats
or exceptions, and saturate explicitly.

The controllers run every 10 ms (manual, 3.1.3):

    duty = (Kp error + Ki sum(error) + Kd (error - last error)) / SCALE, clipped to +-255

in speed mode on `setpoint - speed`, in position mode on `profile - position`, where the profile is the
trapezoid of the J command: accelerate, cruise, brake over v (v + a) / (2 a). The manual gives the form and
the reset values of the gains but not their scale, which is assumed so that the controllers settle well.
A parameter `wheel` is the first register of a wheel, LEFT or RIGHT.
"""

from enum import IntEnum
from typing import Protocol

from khep_twin.compilable import compilable
from khep_twin.units import DUTY_LIMIT, N_SENSORS


class Registers(Protocol):
    """State of one board (N_REGISTERS,): an int64 array, or a memoryview of one, which is faster to index."""

    def __getitem__(self, register: int, /) -> int: ...

    def __setitem__(self, register: int, value: int, /) -> None: ...


SPEED_GAIN_SCALE = 1024
"""Divisor of the speed controller's gains (assumed)."""

POSITION_GAIN_SCALE = 512
"""Divisor of the position controller's gains (assumed)."""

FRACTION = 256
"""Resolution of the profile [1/pulse]: J's acceleration is in pulses/256 (manual, appendix A)."""

TARGET_TOLERANCE_PULSES = 2
"""Largest error at which a target counts as reached (assumed)."""


class Mode(IntEnum):
    """Control mode of a motor."""

    SPEED = 0
    POSITION = 1
    PWM = 2


class Wheel(IntEnum):
    """Registers of one wheel; the left wheel's start at 0, the right one's at `RIGHT`."""

    ENCODER = 0  # pulses since power-up, as last read [pulses]
    POSITION = 1  # the counter of G and H, wraps at 32 bits [pulses]
    SPEED = 2  # pulses in the last tick [pulses/10 ms]
    MODE = 3
    SPEED_SETPOINT = 4  # [pulses/10 ms]
    TARGET = 5  # [pulses]
    PROFILE_POSITION = 6  # position on the trapezoid [pulses/256]
    PROFILE_SPEED = 7  # [pulses/256 per 10 ms]
    MAX_SPEED = 8  # of the trapezoid [pulses/10 ms]
    ACCELERATION = 9  # of the trapezoid [pulses/256 per (10 ms)^2]
    ERROR = 10  # the controller's input [pulses or pulses/10 ms]
    ERROR_SUM = 11
    ON_TARGET = 12  # 1 when the target is reached
    DUTY = 13  # of the motor's pulse-width modulation, -255 to 255


LEFT = 0
RIGHT = len(Wheel)


class Board(IntEnum):
    """Registers of the whole board, after those of its wheels."""

    SPEED_KP = 2 * RIGHT
    SPEED_KI = 2 * RIGHT + 1
    SPEED_KD = 2 * RIGHT + 2
    POSITION_KP = 2 * RIGHT + 3
    POSITION_KI = 2 * RIGHT + 4
    POSITION_KD = 2 * RIGHT + 5
    LED_0 = 2 * RIGHT + 6
    LED_1 = 2 * RIGHT + 7
    SCAN = 2 * RIGHT + 8  # the sensor that is converted next
    PROXIMITY = 2 * RIGHT + 9  # eight counts, in the order of N
    AMBIENT = 2 * RIGHT + 9 + N_SENSORS  # eight counts, in the order of O
    SUPPLY = 2 * RIGHT + 9 + 2 * N_SENSORS  # half the supply voltage, as converted [counts]
    CURRENT = 2 * RIGHT + 10 + 2 * N_SENSORS  # drawn by the whole robot [mA]


N_REGISTERS = Board.CURRENT + 1

POWERED, DEMO = 0, 1
"""Indices in the state of the processor: flags of the supply and of the running ROM demonstration."""
N_PROCESSOR = 2

# Registers that are read together, left before right and sensors in the order of N.
SPEEDS = [LEFT + Wheel.SPEED, RIGHT + Wheel.SPEED]
SETPOINTS = [LEFT + Wheel.SPEED_SETPOINT, RIGHT + Wheel.SPEED_SETPOINT]
DUTIES = [LEFT + Wheel.DUTY, RIGHT + Wheel.DUTY]
PROXIMITY = [Board.PROXIMITY + sensor for sensor in range(N_SENSORS)]
AMBIENT = [Board.AMBIENT + sensor for sensor in range(N_SENSORS)]

DEMO_WEIGHTS = ((4, -5), (4, -15), (6, -18), (-18, 6), (-15, 4), (-5, 4), (5, 3), (3, 5))
"""Weights of each proximity sensor for the left and right speed in the ROM's demonstration (toolbox)."""

DEMO_DIVISOR = 400
"""Divisor of the weighted counts, which gives pulses/10 ms (toolbox)."""

DEMO_SPEED_PULSES = 10
"""Speed of the demonstration without obstacles [pulses/10 ms] (toolbox)."""

RESET_VALUES = (
    (int(Board.SPEED_KP), 3800),
    (int(Board.SPEED_KI), 800),
    (int(Board.SPEED_KD), 100),
    (int(Board.POSITION_KP), 3000),
    (int(Board.POSITION_KI), 20),
    (int(Board.POSITION_KD), 4000),
    (LEFT + Wheel.MAX_SPEED, 20),
    (LEFT + Wheel.ACCELERATION, 64),
    (LEFT + Wheel.ON_TARGET, 1),
    (RIGHT + Wheel.MAX_SPEED, 20),
    (RIGHT + Wheel.ACCELERATION, 64),
    (RIGHT + Wheel.ON_TARGET, 1),
)
"""Registers that are not 0 after a reset, and their values (manual, appendix A)."""

# Plain integers, as each use of an enum as an index costs a look-up.
_ENCODER, _POSITION, _SPEED, _MODE, _SPEED_SETPOINT, _TARGET = 0, 1, 2, 3, 4, 5
_PROFILE_POSITION, _PROFILE_SPEED, _MAX_SPEED, _ACCELERATION = 6, 7, 8, 9
_ERROR, _ERROR_SUM, _ON_TARGET, _DUTY = 10, 11, 12, 13
_SPEED_MODE, _POSITION_MODE, _PWM_MODE = 0, 1, 2
_SPEED_GAINS, _POSITION_GAINS = int(Board.SPEED_KP), int(Board.POSITION_KP)
_SCAN, _PROXIMITY, _AMBIENT, _CHANNELS = int(Board.SCAN), int(Board.PROXIMITY), int(Board.AMBIENT), N_SENSORS
_SUPPLY, _CURRENT = int(Board.SUPPLY), int(Board.CURRENT)


@compilable
def reset(registers: Registers) -> None:
    """Set every register to its reset value, except encoders and conversions, which are kept."""
    for register in range(_SCAN):
        if register not in (LEFT + _ENCODER, RIGHT + _ENCODER):
            registers[register] = 0
    for register, value in RESET_VALUES:
        registers[register] = value


@compilable
def run(registers: Registers, processor: Registers, left_pulses: int, right_pulses: int) -> None:
    """Run one control period, with the ROM's demonstration if it is on; do nothing without power.

    Args:
        registers: State of the board, changed in place.
        processor: State of the processor (N_PROCESSOR,).
        left_pulses: Count of the left encoder since power-up [pulses].
        right_pulses: Count of the right encoder since power-up [pulses].
    """
    if processor[POWERED]:
        tick(registers, left_pulses, right_pulses)
        if processor[DEMO] and registers[_SCAN] == 0:
            wander(registers)


@compilable
def tick(registers: Registers, left_pulses: int, right_pulses: int) -> None:
    """Run one control period: take the encoders' counts since power-up [pulses], set both duties."""
    _control_wheel(registers, LEFT, left_pulses)
    _control_wheel(registers, RIGHT, right_pulses)


@compilable
def convert(registers: Registers, proximity: int, ambient: int) -> None:
    """Store one sensor's two conversions [counts] and advance to the next sensor of the scan."""
    channel = registers[_SCAN]
    registers[_PROXIMITY + channel] = proximity
    registers[_AMBIENT + channel] = ambient
    registers[_SCAN] = (channel + 1) % _CHANNELS


@compilable
def measure(registers: Registers, supply: int, current_ma: int) -> None:
    """Store the measurements of the supply: half its voltage [counts] and the current drawn [mA]."""
    registers[_SUPPLY] = supply
    registers[_CURRENT] = current_ma


@compilable
def wander(registers: Registers) -> None:
    """Run one step of the ROM's Braitenberg demonstration: speed = proximity x weights / 400 + 10."""
    for side in range(2):
        weighted_sum = 0
        for sensor in range(N_SENSORS):
            weighted_sum += DEMO_WEIGHTS[sensor][side] * registers[_PROXIMITY + sensor]
        set_speed(registers, side * RIGHT, divide(weighted_sum, DEMO_DIVISOR) + DEMO_SPEED_PULSES)


@compilable
def set_speed(registers: Registers, wheel: int, speed: int) -> None:
    """Drive a wheel at a speed [pulses/10 ms], with no limit on its acceleration."""
    if registers[wheel + _MODE] != _SPEED_MODE:
        registers[wheel + _ERROR] = 0
        registers[wheel + _ERROR_SUM] = 0
    registers[wheel + _MODE] = _SPEED_MODE
    registers[wheel + _SPEED_SETPOINT] = speed
    registers[wheel + _ON_TARGET] = 0


@compilable
def set_duty(registers: Registers, wheel: int, duty: int) -> None:
    """Drive a motor with a fixed duty of -255 to 255, in open loop."""
    registers[wheel + _MODE] = _PWM_MODE
    registers[wheel + _DUTY] = duty
    registers[wheel + _ERROR] = 0
    registers[wheel + _ON_TARGET] = 0


@compilable
def set_target(registers: Registers, wheel: int, target: int) -> None:
    """Move a wheel to a position [pulses] along the trapezoid, from its current motion."""
    if registers[wheel + _MODE] != _POSITION_MODE:
        registers[wheel + _PROFILE_POSITION] = registers[wheel + _POSITION] * FRACTION
        registers[wheel + _PROFILE_SPEED] = registers[wheel + _SPEED] * FRACTION
        registers[wheel + _ERROR] = 0
        registers[wheel + _ERROR_SUM] = 0
    _unwind(registers, wheel)
    registers[wheel + _MODE] = _POSITION_MODE
    registers[wheel + _TARGET] = target
    registers[wheel + _ON_TARGET] = 0


@compilable
def set_position(registers: Registers, wheel: int, position: int) -> None:
    """Set a wheel's position counter to `position` [pulses]; the end of a move in progress stays the same."""
    _unwind(registers, wheel)
    shift = position - registers[wheel + _POSITION]
    registers[wheel + _POSITION] = position
    registers[wheel + _TARGET] += shift
    registers[wheel + _PROFILE_POSITION] += shift * FRACTION


@compilable
def divide(numerator: int, denominator: int) -> int:
    """Divide integers, truncating towards zero as C does."""
    quotient = abs(numerator) // abs(denominator)
    return quotient if (numerator < 0) == (denominator < 0) else -quotient


@compilable
def square_root(square: int) -> int:
    """Return the integer part of the square root of a number above 0."""
    root, previous_root = square, square + 1
    while root < previous_root:  # Newton's method on integers, from above
        previous_root = root
        root = (root + square // root) // 2
    return previous_root


@compilable
def clip(value: int, limit: int) -> int:
    """Clip `value` to -limit to limit."""
    return min(max(value, -limit), limit)


@compilable
def wrap(value: int) -> int:
    """Wrap `value` to a signed 32-bit number."""
    return (value + 2**31) % 2**32 - 2**31


@compilable
def _control_wheel(registers: Registers, wheel: int, pulses: int) -> None:
    """Run one control period of a wheel, with its encoder's count since power-up [pulses]."""
    speed = pulses - registers[wheel + _ENCODER]
    position = wrap(registers[wheel + _POSITION] + speed)
    registers[wheel + _ENCODER] = pulses
    registers[wheel + _POSITION] = position
    registers[wheel + _SPEED] = speed
    mode = registers[wheel + _MODE]
    if mode == _SPEED_MODE:
        error = registers[wheel + _SPEED_SETPOINT] - speed
        _regulate(registers, wheel, _SPEED_GAINS, SPEED_GAIN_SCALE, error)
    elif mode == _POSITION_MODE:
        _advance_profile(registers, wheel)
        error = wrap(divide(registers[wheel + _PROFILE_POSITION], FRACTION) - position)
        _regulate(registers, wheel, _POSITION_GAINS, POSITION_GAIN_SCALE, error)
        is_profile_done = registers[wheel + _PROFILE_POSITION] == registers[wheel + _TARGET] * FRACTION
        is_profile_done = is_profile_done and registers[wheel + _PROFILE_SPEED] == 0
        # The target is reached at rest, and no longer counts when a push displaces the wheel.
        is_slow = abs(speed) <= 1 or registers[wheel + _ON_TARGET] == 1
        is_near = abs(error) <= TARGET_TOLERANCE_PULSES
        registers[wheel + _ON_TARGET] = 1 if is_profile_done and is_near and is_slow else 0


@compilable
def _regulate(registers: Registers, wheel: int, first_gain: int, scale: int, error: int) -> None:
    """Apply the PID law (gains: three registers); the error sum is limited to full duty (anti-windup)."""
    kp, ki, kd = registers[first_gain], registers[first_gain + 1], registers[first_gain + 2]
    error_sum = clip(registers[wheel + _ERROR_SUM] + error, divide(DUTY_LIMIT * scale, max(ki, 1)))
    control_sum = kp * error + ki * error_sum + kd * (error - registers[wheel + _ERROR])
    registers[wheel + _ERROR] = error
    registers[wheel + _ERROR_SUM] = error_sum
    registers[wheel + _DUTY] = clip(divide(control_sum, scale), DUTY_LIMIT)


@compilable
def _advance_profile(registers: Registers, wheel: int) -> None:
    """Advance the trapezoid by one tick towards the target.

    The speed changes by at most the acceleration. It falls once the remaining distance is at most the
    stopping distance. If the remaining distance is already shorter, the profile overshoots and returns.
    """
    position = registers[wheel + _PROFILE_POSITION]
    speed = registers[wheel + _PROFILE_SPEED]
    acceleration = max(registers[wheel + _ACCELERATION], 1)
    distance = registers[wheel + _TARGET] * FRACTION - position
    direction = 1 if distance >= 0 else -1
    distance *= direction
    speed *= direction
    new_speed = min(speed + acceleration, registers[wheel + _MAX_SPEED] * FRACTION)
    if new_speed > 0:
        n_steps, remainder = new_speed // acceleration, new_speed % acceleration
        if (n_steps + 1) * (n_steps * acceleration + 2 * remainder) > 2 * distance:
            new_speed = _stopping_speed(distance, acceleration)
    new_speed = max(new_speed, speed - acceleration)
    registers[wheel + _PROFILE_POSITION] = position + direction * new_speed
    registers[wheel + _PROFILE_SPEED] = direction * new_speed
    if new_speed == 0 and speed != 0:
        # The load that the error sum compensated in motion ends with the move.
        registers[wheel + _ERROR_SUM] = 0


@compilable
def _stopping_speed(distance: int, acceleration: int) -> int:
    """Return the fastest speed that can stop within a distance: v + (v - a) + (v - 2 a) + ... <= distance.

    With v = n a + r and r < a the distance is (n + 1) (n a / 2 + r). The speeds of later ticks cover the
    remainder, which is below n + 1.
    """
    steps = (square_root(8 * (distance // acceleration) + 1) - 1) // 2
    return steps * acceleration + (distance - acceleration * steps * (steps + 1) // 2) // (steps + 1)


@compilable
def _unwind(registers: Registers, wheel: int) -> None:
    """Shift profile and target to the counter's range after it has wrapped."""
    difference = divide(registers[wheel + _PROFILE_POSITION], FRACTION) - registers[wheel + _POSITION]
    offset = difference - wrap(difference)
    registers[wheel + _TARGET] -= offset
    registers[wheel + _PROFILE_POSITION] -= offset * FRACTION
