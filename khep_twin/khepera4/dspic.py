"""The dsPIC of the Khepera IV: its registers on the I2C bus, and its control of the motors.

    dspic = Dspic()
    dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + (500).to_bytes(2, "little") * 2)
    dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))
    left, right = dspic.tick(0, 0)

A write is a register number, followed by the bytes for it and for the following registers; a read continues
through the register map (library).
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple

from khep_twin.board.kernel import wrap
from khep_twin.khepera4.motor_control import GAIN_SCALE, PWM_LIMIT, Motor, Settings
from khep_twin.khepera4.registers import (
    BATTERY_BYTES,
    N_BYTES,
    RESET_VALUES,
    WRITABLE,
    Control,
    DspicRegister,
)
from khep_twin.simulation.number_reader import LARGEST, NumberReader

N_INFRARED, N_ULTRASONIC = 12, 5
"""Infrared sensors: back left, left, front left, front, front right, right, back right, back, and of the
ground left, front left, front right, right. Ultrasonic ones: left, front left, front, front right, right
(library)."""

_POSITION_ORDERS = {*range(DspicRegister.POSITION_ORDER_LEFT, DspicRegister.SPEED_LEFT)}
"""Bytes of the orders that start a move."""


class Dspic:
    """A dsPIC with its motors.

    Attributes:
        before_read: Function that is called with the first register of a read and the end of the read.
        counts: Pulses of the encoders at the last control period, left and right.
        is_powered: Whether the supply suffices; otherwise the bus gets no reply.
    """

    def __init__(self) -> None:
        self.before_read: Callable[[int, int], None] = lambda first, end: None
        self._memory = bytearray(N_BYTES + BATTERY_BYTES)
        self.counts = 0, 0
        self.is_powered = True
        self.reset()

    def reset(self) -> None:
        """Return to the state at power-up, except for the last readings of sensors and gauge."""
        self._memory[: DspicRegister.AMBIENT] = bytes(DspicRegister.AMBIENT)
        for register, content in RESET_VALUES.items():
            self._memory[register : register + len(content)] = content
        self._left, self._right = Motor(), Motor()

    def write(self, message: bytes) -> None:
        """Execute a write: a register number, and the bytes for it and the following registers."""
        if not message:
            return
        for register, byte in enumerate(message[1:], message[0]):
            if register in WRITABLE or register == DspicRegister.ULTRASONIC_ENABLED:
                self._memory[register] = byte
        written_registers = range(message[0], message[0] + len(message) - 1)
        if DspicRegister.RESET_ENCODERS in written_registers:
            self._left.position = self._right.position = 0
            self._update_registers()
        if set(written_registers) & _POSITION_ORDERS:
            self._left.is_on_target = self._right.is_on_target = False
        if DspicRegister.CONTROL in written_registers:
            self._left.stop()
            self._right.stop()

    def read(self, register: int, count: int) -> bytes:
        """Return bytes from a register on, zeros after the end of the map (assumed)."""
        self.before_read(register, register + count)
        content = bytes(self._memory[register : register + count])
        return content + bytes(count - len(content))

    def tick(self, left_pulses: int, right_pulses: int) -> tuple[int, int]:
        """Run a control period of 10 ms with the encoders' pulses since power-up; return both motors' PWM."""
        counts = left_pulses, right_pulses
        control_type = self._memory[DspicRegister.CONTROL]
        control = Control(control_type) if control_type <= Control.OPEN_LOOP else Control.IDLE
        settings = self._read_settings()
        order_registers = {
            Control.POSITION: (DspicRegister.POSITION_ORDER_LEFT, 4),
            Control.OPEN_LOOP: (DspicRegister.PWM_ORDER_LEFT, 2),
        }
        left_order, size = order_registers.get(control, (DspicRegister.SPEED_ORDER_LEFT, 2))
        for side, motor in enumerate((self._left, self._right)):
            motor.speed = counts[side] - self.counts[side]
            motor.position = wrap(motor.position + motor.speed)
            motor.tick(settings, control, self._read_signed(left_order + side * size, size))
        self.counts = counts
        self._update_registers()
        return self._left.pwm, self._right.pwm

    def set_words(self, register: DspicRegister, values: Sequence[int]) -> None:
        """Set registers of 2 bytes each to readings, from a register on."""
        content = b"".join((value & 0xFFFF).to_bytes(2, "little") for value in values)
        self._memory[register : register + len(content)] = content

    def set_battery(self, block: bytes) -> None:
        """Set the block of the battery gauge (12 bytes)."""
        if len(block) != BATTERY_BYTES:
            raise ValueError(f"a battery block of {len(block)} bytes; expected {BATTERY_BYTES}")
        self._memory[DspicRegister.BATTERY : DspicRegister.BATTERY + BATTERY_BYTES] = block

    def read_words(self, register: int, count: int) -> list[int]:
        """Read unsigned registers of 2 bytes."""
        self.before_read(register, register + 2 * count)
        return self.words(register, count)

    def words(self, register: int, count: int) -> list[int]:
        """Return unsigned registers of 2 bytes, without a call of `before_read`."""
        return [self._memory[i] | self._memory[i + 1] << 8 for i in range(register, register + 2 * count, 2)]

    @property
    def motor_numbers(self) -> tuple[Sequence[int], Sequence[int], Sequence[int]]:
        """Speeds and their orders, positions and their orders, left before right, and PWM."""
        left, right = self._left, self._right
        speeds = [self._read_signed(DspicRegister.SPEED_ORDER_LEFT + at, 2) for at in (0, 2)]
        positions = [self._read_signed(DspicRegister.POSITION_ORDER_LEFT + at, 4) for at in (0, 4)]
        return (
            (left.speed, right.speed, *speeds),
            (left.position, right.position, *positions),
            (left.pwm, right.pwm),
        )

    def state(self) -> list[int]:
        """Return the complete state."""
        return [*self.counts, *astuple(self._left), *astuple(self._right), *self._memory]

    def set_state(self, numbers: NumberReader[int]) -> None:
        """Restore a state.

        Raises:
            ValueError: It has fewer numbers, or one is outside its range.
        """
        left, right = numbers.take("pulses of the encoders", 2)
        self.counts = left, right
        self._left, self._right = _read_motor(numbers), _read_motor(numbers)
        self._memory[:] = bytes(numbers.take("byte of the registers", len(self._memory), 0, 255))

    @property
    def leds(self) -> bytes:
        """Red, green and blue of the LEDs front left, front right and back, 0 to 63 (9,)."""
        return bytes(self._memory[DspicRegister.LEDS : DspicRegister.LEDS + 9])

    @property
    def ultrasonic_enabled(self) -> int:
        """Mask of the enabled ultrasonic sensors, bit 0 left to bit 4 right."""
        return self._memory[DspicRegister.ULTRASONIC_ENABLED]

    def _read_settings(self) -> Settings:
        kp, ki, kd, *profile = self._memory[DspicRegister.KP : DspicRegister.LEAST_DECELERATING + 1]
        step, divider, accelerating, decelerating = profile
        margin = self._read_signed(DspicRegister.POSITION_MARGIN, 2)
        speed = self._read_signed(DspicRegister.POSITION_SPEED, 2)
        return Settings(kp, ki, kd, step, divider, accelerating, decelerating, margin, speed)

    def _read_signed(self, register: int, size: int) -> int:
        return int.from_bytes(self._memory[register : register + size], "little", signed=True)

    def _update_registers(self) -> None:
        """Set the registers of the motors' state."""
        left, right, registers = self._left, self._right, self._memory
        registers[DspicRegister.ON_TARGET] = left.is_on_target | right.is_on_target << 1
        for left_register, size, values in (
            (DspicRegister.SPEED_LEFT, 2, (left.speed, right.speed)),
            (DspicRegister.POSITION_LEFT, 4, (left.position, right.position)),
        ):
            for side, value in enumerate(values):
                start = left_register + side * size
                registers[start : start + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")


_MOTOR_RANGES = {
    "position": (-(2**31), 2**31 - 1),
    "speed": (-LARGEST, LARGEST),
    "pwm": (-PWM_LIMIT, PWM_LIMIT),
    "is_on_target": (0, 1),
    "ramp": (-(2**15), 2**15),
    "wait": (0, 255),
    "error": (-LARGEST, LARGEST),
    "error_sum": (-PWM_LIMIT * GAIN_SCALE, PWM_LIMIT * GAIN_SCALE),
}
"""Range of each number of a motor's state."""


def _read_motor(numbers: NumberReader[int]) -> Motor:
    """Return a motor from the numbers of its state."""
    values = {name: numbers.take(f"motor's {name}", 1, *limits)[0] for name, limits in _MOTOR_RANGES.items()}
    is_on_target = bool(values.pop("is_on_target"))
    return Motor(**values, is_on_target=is_on_target)
