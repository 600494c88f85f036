"""The dsPIC of the Khepera IV: its registers on the I2C bus, and its control of the motors.

    dspic = Dspic()
    dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + (500).to_bytes(2, "little") * 2)
    dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))
    left, right = dspic.tick(0, 0)

A write is a register number, followed by the bytes for it and for the following registers; a read continues
through the register map (library). `tick` and `reset` are `compilable`; `Dspic` is the bus to their state.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from khep_twin.board.kernel import wrap
from khep_twin.board.memory import read_signed, write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4 import registers
from khep_twin.robots.khepera4.motor_control import LEFT_PWM, N_MOTOR, RIGHT_PWM, Motor, control_motor, stop
from khep_twin.robots.khepera4.registers import RESET_VALUES, WRITABLE, Control, DspicRegister
from khep_twin.sensing.buffers import Vector

N_INFRARED, N_ULTRASONIC = 12, 5
"""Infrared sensors: back left, left, front left, front, front right, right, back right, back, and of the
ground left, front left, front right, right. Ultrasonic ones: left, front left, front, front right, right
(library)."""

N_MEMORY = registers.N_BYTES + registers.BATTERY_BYTES

_POSITION_ORDERS = {*range(DspicRegister.POSITION_ORDER_LEFT, DspicRegister.SPEED_LEFT)}
"""Bytes of the orders that start a move."""

_RESET_BYTES = tuple(
    (int(register) + offset, byte)
    for register, content in RESET_VALUES.items()
    for offset, byte in enumerate(content)
)
"""Registers that are not 0 after a reset."""

_SPEED, _POSITION, _ON_TARGET = map(int, (Motor.SPEED, Motor.POSITION, Motor.ON_TARGET))
_CONTROL, _OPEN_LOOP, _MOVE = int(DspicRegister.CONTROL), int(Control.OPEN_LOOP), int(Control.POSITION)
_FIRST_KEPT = int(DspicRegister.AMBIENT)
_SPEED_ORDER, _PWM_ORDER = int(DspicRegister.SPEED_ORDER_LEFT), int(DspicRegister.PWM_ORDER_LEFT)
_POSITION_ORDER, _TARGET_FLAGS = int(DspicRegister.POSITION_ORDER_LEFT), int(DspicRegister.ON_TARGET)
_LEFT_SPEED, _LEFT_POSITION = int(DspicRegister.SPEED_LEFT), int(DspicRegister.POSITION_LEFT)


class DspicState(NamedTuple):
    """State of a dsPIC.

    Attributes:
        memory: Bytes of the registers and of the battery gauge (N_MEMORY,).
        motors: Numbers of the left and the right motor (2 * N_MOTOR,).
        counts: Pulses of the encoders at the last control period, left and right (2,).
        powered: 1 if the supply suffices; otherwise the bus gets no reply (1,).
    """

    memory: Vector[int]
    motors: Vector[int]
    counts: Vector[int]
    powered: Vector[int]


def power_up() -> DspicState:
    """Return the state at power-up."""
    memory, motors = np.zeros(N_MEMORY, np.int64), np.zeros(2 * N_MOTOR, np.int64)
    state = DspicState(memory, motors, np.zeros(2, np.int64), np.ones(1, np.int64))
    reset(state)
    return state


@compilable
def reset(dspic: DspicState) -> None:
    """Return to the state at power-up, except for the last readings of sensors and gauge."""
    for register in range(_FIRST_KEPT):
        dspic.memory[register] = 0
    for register, byte in _RESET_BYTES:
        dspic.memory[register] = byte
    for number in range(2 * N_MOTOR):
        dspic.motors[number] = 0


@compilable
def tick(dspic: DspicState, left_pulses: int, right_pulses: int) -> None:
    """Run a control period of 10 ms with the encoders' pulses since power-up."""
    memory, motors = dspic.memory, dspic.motors
    control, first_order, size = memory[_CONTROL], _SPEED_ORDER, 2
    if control == _MOVE:
        first_order, size = _POSITION_ORDER, 4
    elif control == _OPEN_LOOP:
        first_order = _PWM_ORDER
    for side in range(2):
        motor, pulses = side * N_MOTOR, right_pulses if side else left_pulses
        motors[motor + _SPEED] = pulses - dspic.counts[side]
        motors[motor + _POSITION] = wrap(motors[motor + _POSITION] + motors[motor + _SPEED])
        order = read_signed(memory, first_order + side * size, size)
        control_motor(motors, motor, memory, control, order)
        dspic.counts[side] = pulses
    update_registers(dspic)


@compilable
def update_registers(dspic: DspicState) -> None:
    """Set the registers of the motors' state."""
    memory, motors = dspic.memory, dspic.motors
    memory[_TARGET_FLAGS] = motors[_ON_TARGET] | motors[N_MOTOR + _ON_TARGET] << 1
    for side in range(2):
        write_number(memory, _LEFT_SPEED + 2 * side, 2, motors[side * N_MOTOR + _SPEED])
        write_number(memory, _LEFT_POSITION + 4 * side, 4, motors[side * N_MOTOR + _POSITION])


class Dspic:
    """The bus to a dsPIC.

    Args:
        state: Its state; by default at power-up.

    Attributes:
        before_read: Function that is called with the first register of a read and the end of the read.
        state: Its state.
    """

    def __init__(self, state: DspicState | None = None) -> None:
        self.before_read: Callable[[int, int], None] = lambda first, end: None
        self.state = state or DspicState(*(cast(Any, array).data for array in power_up()))
        self._memory: Any = self.state.memory

    @property
    def is_powered(self) -> bool:
        """True if the supply suffices; otherwise the bus gets no reply."""
        return bool(self.state.powered[0])

    def reset(self) -> None:
        """Return to the state at power-up, except for the last readings of sensors and gauge."""
        reset(self.state)

    def write(self, message: bytes) -> None:
        """Execute a write: a register number, and the bytes for it and the following registers."""
        if not message:
            return
        memory, motors = self.state.memory, self.state.motors
        control = memory[_CONTROL]
        for register, byte in enumerate(message[1:], message[0]):
            if register in WRITABLE or register == DspicRegister.ULTRASONIC_ENABLED:
                memory[register] = byte
        written_registers = range(message[0], message[0] + len(message) - 1)
        if DspicRegister.RESET_ENCODERS in written_registers:
            motors[_POSITION] = motors[N_MOTOR + _POSITION] = 0
            update_registers(self.state)
        if not _POSITION_ORDERS.isdisjoint(written_registers):
            motors[_ON_TARGET] = motors[N_MOTOR + _ON_TARGET] = 0
        # The control type in force keeps the controllers' sums (assumed): the server writes it with each D.
        if memory[_CONTROL] != control:
            stop(motors, 0)
            stop(motors, N_MOTOR)

    def read(self, register: int, count: int) -> bytes:
        """Return bytes from a register on, zeros after the end of the map (assumed)."""
        self.before_read(register, register + count)
        content = bytes(self._memory[register : register + count].tolist())
        return content + bytes(count - len(content))

    def tick(self, left_pulses: int, right_pulses: int) -> tuple[int, int]:
        """Run a control period of 10 ms with the encoders' pulses since power-up; return both motors' PWM."""
        tick(self.state, left_pulses, right_pulses)
        return self.pwm

    @property
    def pwm(self) -> tuple[int, int]:
        """PWM of the left and the right motor."""
        return self.state.motors[LEFT_PWM], self.state.motors[RIGHT_PWM]

    @property
    def leds(self) -> bytes:
        """Red, green and blue of the LEDs front left, front right and back, 0 to 63 (9,)."""
        return bytes(self._memory[DspicRegister.LEDS : DspicRegister.LEDS + 9].tolist())
