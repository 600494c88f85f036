"""Devices of a Khepera III on its I2C bus: dsPIC, two motor controllers and real-time clock.

    bus = Bus(state, KHEPERA_3)
    bus.dspic.write(bytes([2, ord("N")]))
    count = bus.dspic.read(1)[0]
    letter, *numbers = bus.dspic.read(count)

A message to the dsPIC is a command: the number of all bytes, a letter and arguments. Its reply is a frame:
the number of bytes after the second one, a filler (0 assumed), the letter and data. A read uses up one byte
more than it returns, as both ways of reading show: one byte and then the rest (library), or all in one
(toolbox).

A message to a motor controller is a register and a byte for it (toolbox); further bytes have no effect
(assumed). A read returns the byte of the last register; that of the highest byte of a number latches the
others (assumed).
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partialmethod

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.board.memory import read_signed, write_number
from khep_twin.programs.computer import Slave
from khep_twin.robots.khepera3 import registers, state
from khep_twin.robots.khepera3.model import FIRST, SERVER
from khep_twin.robots.khepera3.motor_control import MotorState, Pic, halt, reset
from khep_twin.robots.khepera3.registers import GROUND, RING, MotorRegister, PicMode, Setting
from khep_twin.robots.khepera3.state import N_ECHO, SETTING, Khepera3State
from khep_twin.robots.model import RobotModel

FRAMES = {
    **{"B": "<2H", "C": "<", "G": f"<H{5 * 'HHI'}H", "K": "<", "N": "<11hI", "O": "<11HI", "V": "<2H"},
    **{"Z": "<"},
}
"""Layout of the data in the dsPIC's replies, by the letter of the command."""

_N_ARGUMENTS = {**dict.fromkeys("BNOZ", 0), "G": 1, "V": 1, "K": 2, "C": 3}
_N_INFRARED = len(RING) + len(GROUND)

_NOISE, _TEMPERATURE = 1800, 25.0
"""Noise of each ultrasonic reading (the manual's example), and temperature [degree C] (assumed)."""

_ECHO_COUNT_SETTING = 254
"""Index of a setting by which the toolbox sets the number of echoes."""

_LATCHES = {
    MotorRegister.POSITION + 3: (4, Pic.POSITION),
    MotorRegister.SPEED + 3: (4, Pic.SPEED),
    MotorRegister.CURRENT + 1: (2, Pic.CURRENT),
    MotorRegister.OUTPUT + 1: (2, Pic.PWM),
}
"""Size of a measured number, and the number, by the register of its highest byte."""

_READ_ONLY = {
    *(MotorRegister.VERSION, MotorRegister.STATUS),
    *range(MotorRegister.SPEED, MotorRegister.SPEED + 4),
    *range(MotorRegister.LEAST_SAMPLE_TIME, MotorRegister.LEAST_SPEED),
}


@dataclass
class _Device:
    """A device that the robot's supply feeds."""

    robot: Khepera3State

    @property
    def is_powered(self) -> bool:
        """True if the supply suffices; otherwise the bus gets no reply."""
        return bool(self.robot.board[state.POWERED])


@dataclass
class MotorController(_Device):
    """One of the motor controllers."""

    motor: MotorState
    register: int = 0
    """Selected register."""

    def write(self, message: bytes) -> None:
        """Select a register, and write a byte to it if the message has one."""
        register = self.register = message[0]
        if len(message) == 1 or register >= registers.N_BYTES or register in _READ_ONLY:
            return
        memory, numbers, byte = self.motor.memory, self.motor.numbers, message[1]
        if register == MotorRegister.CONTROL and byte != memory[register]:
            halt(self.motor)
        memory[register] = byte
        if register == MotorRegister.SET_POINT:
            numbers[Pic.SET_POINT] = read_signed(memory, register, 4)
            numbers[Pic.ON_TARGET] = 0
        elif register == MotorRegister.POSITION:
            numbers[Pic.POSITION] = read_signed(memory, register, 4)
        elif register == MotorRegister.MODE and byte == PicMode.STOP:
            numbers[Pic.HOLD_POSITION] = numbers[Pic.POSITION]
        elif register == MotorRegister.MODE and byte == PicMode.RESET:
            reset(self.motor)
        elif register == MotorRegister.MODE and byte in (PicMode.SAVE, PicMode.SEARCH):
            # A search of limits ends immediately, and settings are not saved (assumed).
            memory[register] = PicMode.IDLE

    def read(self, count: int) -> bytes:
        """Return the byte of the selected register, `count` times."""
        register, memory = self.register, self.motor.memory
        if register in _LATCHES:
            size, number = _LATCHES[register]
            write_number(memory, register - size + 1, size, self.motor.numbers[number])
        return bytes([memory[register] if register < registers.N_BYTES else 0]) * count

    def get(self, register: int, size: int) -> int:
        """Return a signed number, read byte by byte from the highest one."""
        number = bytearray()
        for byte in reversed(range(register, register + size)):
            self.write(bytes([byte]))
            number += self.read(1)
        return int.from_bytes(number, "big", signed=True)

    def set(self, register: int, size: int, value: int) -> None:
        """Write a number byte by byte from the highest one, truncated as in C."""
        for offset in reversed(range(size)):
            self.write(bytes([register + offset, value >> 8 * offset & 0xFF]))


@dataclass
class DspicDevice(_Device):
    """The dsPIC."""

    version: Sequence[int]
    """Version and revision of its firmware."""
    before_read: Callable[[str], None] = lambda letter: None
    """Function that is called before readings are read, with the command's letter."""
    time_ms: Callable[[], int] = lambda: 0
    """Function that returns the present time [ms]."""
    frame: bytes = b""
    """Unread part of the last frame."""

    def write(self, message: bytes) -> None:
        """Execute a command; one whose first byte is not its length has no effect (assumed)."""
        if 1 < message[0] == len(message):
            reply = self.execute(message[1:])
            self.frame = bytes([len(reply), 0]) + reply if reply else b""

    def read(self, count: int) -> bytes:
        """Return the next bytes of the frame, zeros after its end (assumed)."""
        content, self.frame = self.frame[:count], self.frame[count + 1 :]
        return content.ljust(count, b"\0")

    def execute(self, command: bytes) -> bytes:
        """Execute a command, a letter and bytes; return the reply, empty for an unknown one (assumed)."""
        letter = chr(command[0])
        values = self.ask(letter, *command[1:])
        return b"" if values is None else letter.lower().encode() + struct.pack(FRAMES[letter], *values)

    def ask(self, letter: str, *arguments: int) -> Sequence[int] | None:
        """Execute a command by its letter; return the numbers in its reply, None for an unknown one."""
        n_arguments = _N_ARGUMENTS.get(letter, len(arguments) + 1)
        if len(arguments) < n_arguments:
            return None
        self.before_read(letter)
        return getattr(self, f"_on_{letter.lower()}")(*arguments[:n_arguments])

    def _on_b(self) -> Sequence[int]:
        return self.version

    def _on_c(self, index: int, high: int, low: int) -> Sequence[int]:
        index = Setting.N_ECHOES if index == _ECHO_COUNT_SETTING else index
        if index < len(registers.SETTINGS):
            self.robot.board[SETTING + index] = high << 8 | low
        return ()

    def _on_g(self, number: int) -> Sequence[int] | None:
        if not 1 <= number <= state.N_ULTRASONIC:
            return None
        is_active = self.robot.board[SETTING + Setting.ULTRASONIC] >> number - 1 & 1
        start = (number - 1) * N_ECHO
        return *(self.robot.echoes[start + index] * is_active for index in range(N_ECHO)), _NOISE

    def _on_k(self, led: int, order: int) -> Sequence[int]:
        """Switch an LED off or on, or toggle it for 2."""
        if led < 2:
            is_lit = self.robot.board[state.LEDS + led]
            self.robot.board[state.LEDS + led] = 1 - is_lit if order == 2 else int(order > 0)
        return ()

    def _on_v(self, kind: int) -> Sequence[int]:
        """Return integer part and fraction in 1/10,000, of degrees in tenths, of a value (manual)."""
        battery = self.robot.battery
        level = charge_level(battery[state.USED], state.CAPACITY)
        values = (
            *((cells_voltage(level), 10_000), (-battery[state.CURRENT], 10_000)),
            *((-battery[state.AVERAGE], 10_000), (level * state.CAPACITY / 3.6, 1)),
            *((_TEMPERATURE, 10), (100 * level, 1)),
        )
        value, parts = values[kind] if kind < len(values) else (0, 1)  # kh3server's $ to others needs one
        integer, fraction = divmod(round(abs(value) * parts), parts)
        # Sign and magnitude: the highest bit of the integer part (library).
        return integer | (value < 0) << 15, fraction

    def _on_z(self) -> Sequence[int]:
        self.robot.board[state.TIMER_ZERO_MS] = self.time_ms()
        return ()

    def _read_infrared(self, channel: str) -> Sequence[int]:
        """Return the readings of a channel, and their time [ms]."""
        readings, board, first = self.robot.registers, self.robot.board, FIRST[channel]
        time_ms = max(board[state.SCAN_MS] - board[state.TIMER_ZERO_MS], 0)
        return *(readings[first + sensor] for sensor in range(_N_INFRARED)), time_ms & 0xFFFFFFFF

    _on_n = partialmethod(_read_infrared, "proximity")
    _on_o = partialmethod(_read_infrared, "ambient")


@dataclass
class RealTimeClock(_Device):
    """Seconds, minutes and hours since the start in decimal digits, from register 0 on (assumed)."""

    dspic: DspicDevice
    """The dsPIC, which has the time."""
    register: int = 0

    def write(self, message: bytes) -> None:
        """Select a register; the clock cannot be set (assumed)."""
        self.register = message[0]

    def read(self, count: int) -> bytes:
        """Return bytes from the selected register on, zeros after the hours."""
        seconds = self.dspic.time_ms() // 1000
        digits = (divmod(field, 10) for field in (seconds % 60, seconds // 60 % 60, seconds // 3600 % 24))
        content = bytes(ten << 4 | one for ten, one in digits)
        return content[self.register : self.register + count].ljust(count, b"\0")


class Bus:
    """Devices of the robot on its bus.

    Args:
        robot: State of the robot.
        model: Its model.

    Attributes:
        robot: State of the robot.
        dspic: The dsPIC.
        motors: Motor controllers, left and right.
        devices: Devices by their addresses.
    """

    def __init__(self, robot: Khepera3State, model: RobotModel) -> None:
        self.robot = robot
        self.dspic = DspicDevice(robot, [*map(int, model.roms[SERVER].bios.split("."))])
        self.motors = MotorController(robot, robot.left), MotorController(robot, robot.right)
        self.devices: dict[int, Slave] = {
            registers.DSPIC: self.dspic,
            **dict(zip(registers.MOTORS, self.motors, strict=True)),
            registers.CLOCK: RealTimeClock(robot, self.dspic),
        }
