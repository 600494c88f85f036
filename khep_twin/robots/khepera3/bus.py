"""Devices of a Khepera III on its I2C bus: dsPIC, two motor controllers and real-time clock.

    bus = Bus(state, version=(3, 0))
    bus.dspic.write(b"\\x02N")
    count = bus.dspic.read(1)[0]
    letter, *numbers = bus.dspic.read(count)

A message to the dsPIC is a command: the number of all bytes, a letter and arguments. Its reply is a frame: the
number of the bytes after the second one, a filler (0 assumed), the letter and data. A read uses up one byte more
than it returns, as both ways of reading show: one byte and then the rest (library), or all at once (toolbox).

A message to a motor controller is a register and a byte for it (toolbox); further bytes have no effect
(assumed). A read returns the byte of the last register; the highest byte of a number latches the others (assumed).
"""

from collections.abc import Callable, Iterable

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.robots.khepera3.channels import GROUND, RING
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.motor_control import N_MOTOR, Motor, halt, read_number, write_number
from khep_twin.robots.khepera3.registers import (
    CLOCK,
    DSPIC,
    MOTORS,
    N_BYTES,
    SETTINGS,
    Mode,
    MotorRegister,
    Setting,
)
from khep_twin.robots.khepera3.state import (
    AVERAGE,
    CAPACITY,
    CURRENT,
    LEDS,
    N_ECHO,
    N_ULTRASONIC,
    POWERED,
    SCAN_MS,
    SETTING,
    TIMER_ZERO_MS,
    USED,
    Khepera3State,
    power_up_memory,
)

NOISE = 1800
"""Noise of each ultrasonic reading (the manual's example)."""

ECHO_COUNT_SETTING = 254
"""Index of a setting by which the toolbox sets the number of echoes."""

_TEMPERATURE = 25.0
"""Temperature of the battery [degree C] (assumed)."""

_READ_ONLY = {
    *(MotorRegister.VERSION, MotorRegister.STATUS),
    *range(MotorRegister.SPEED, MotorRegister.SPEED + 4),
    *range(MotorRegister.CURRENT - 2, MotorRegister.OUTPUT + 2),  # with the shortest sample time
}
_LATCHES = {
    MotorRegister.POSITION: (4, Motor.POSITION),
    MotorRegister.SPEED: (4, Motor.SPEED),
    MotorRegister.CURRENT: (2, Motor.CURRENT),
    MotorRegister.OUTPUT: (2, Motor.PWM),
}
"""Registers of measured numbers: their size, and the number."""
_LATCHES_BY_LAST = {first + size - 1: (first, size, number) for first, (size, number) in _LATCHES.items()}


class MotorController:
    """One of the motor controllers.

    Args:
        state: State of the robot.
        side: 0 left, 1 right.
    """

    def __init__(self, state: Khepera3State, side: int) -> None:
        self._state, self._first, self._motor = state, side * N_BYTES, side * N_MOTOR
        self._register = 0

    @property
    def is_powered(self) -> bool:
        """True if the supply suffices; otherwise the bus gets no reply."""
        return bool(self._state.board[POWERED])

    def write(self, message: bytes) -> None:
        """Select a register, and write a byte to it if the message has one."""
        if not message:
            return
        self._register = message[0]
        if len(message) == 1 or self._register >= N_BYTES or self._register in _READ_ONLY:
            return
        memory, motors, register, byte = self._state.memory, self._state.controllers, message[0], message[1]
        place = self._first + register
        if register == MotorRegister.CONTROL and byte != memory[place]:
            halt(motors, self._motor)
        memory[place] = byte
        if register == MotorRegister.MODE:
            self.enter(byte)
        elif register == MotorRegister.SET_POINT:
            motors[self._motor + Motor.SET_POINT] = read_number(memory, place, 4)
            motors[self._motor + Motor.ON_TARGET] = 0
        elif register == MotorRegister.POSITION:
            motors[self._motor + Motor.POSITION] = read_number(memory, place, 4)

    def read(self, count: int) -> bytes:
        """Return the byte of the selected register, `count` times."""
        memory = self._state.memory
        if self._register >= N_BYTES:
            return bytes(count)
        if self._register in _LATCHES_BY_LAST:
            first, size, number = _LATCHES_BY_LAST[self._register]
            write_number(memory, self._first + first, size, self._state.controllers[self._motor + number])
        return bytes([memory[self._first + self._register]]) * count

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

    def enter(self, mode: int) -> None:
        """Enter a mode. A search of limits ends at once, and settings are not saved (assumed)."""
        memory, motors = self._state.memory, self._state.controllers
        if mode == Mode.STOP:
            motors[self._motor + Motor.HELD] = motors[self._motor + Motor.POSITION]
        elif mode == Mode.RESET:
            for index, byte in enumerate(power_up_memory()[:N_BYTES]):
                memory[self._first + index] = int(byte)
            for index in range(N_MOTOR):
                motors[self._motor + index] = 0
        elif mode in (Mode.SAVE, Mode.SEARCH):
            memory[self._first + MotorRegister.MODE] = Mode.IDLE


class Dspic:
    """The dsPIC.

    Args:
        state: State of the robot.
        version: Version and revision of its firmware.

    Attributes:
        before_read: Function that is called before readings are read, with the command's letter.
        time_ms: Function that returns the present time [ms].
    """

    def __init__(self, state: Khepera3State, version: tuple[int, int]) -> None:
        self._state, self._version = state, version
        self.before_read: Callable[[str], None] = lambda letter: None
        self.time_ms: Callable[[], int] = lambda: 0
        self._frame = b""

    @property
    def is_powered(self) -> bool:
        """True if the supply suffices; otherwise the bus gets no reply."""
        return bool(self._state.board[POWERED])

    @property
    def vehicle_gain(self) -> int:
        """Gain of the vehicle of letter A in the configuration."""
        return int(self._state.board[SETTING + Setting.VEHICLE_GAIN])

    def write(self, message: bytes) -> None:
        """Execute a command; one of another length than its first byte says has no effect (assumed)."""
        if message and message[0] == len(message):
            reply = self.execute(message[1:])
            self._frame = bytes([len(reply), 0]) + reply if reply else b""

    def read(self, count: int) -> bytes:
        """Return the next bytes of the frame, zeros after its end (assumed)."""
        content, self._frame = self._frame[:count], self._frame[count + 1 :]
        return content.ljust(count, b"\0")

    def execute(self, command: bytes) -> bytes:
        """Execute a command, a letter and bytes; return the reply, or nothing for an unknown one (assumed)."""
        handler = getattr(self, f"_on_{chr(command[0]).lower()}", None) if 65 <= command[0] <= 90 else None
        data = None if handler is None else handler(command[1:])
        return b"" if data is None else bytes([command[0] + 32]) + data

    def _on_b(self, arguments: bytes) -> bytes:
        return _words(self._version)

    def _on_c(self, arguments: bytes) -> bytes | None:
        """Set a setting by its index, a filler and a value with the high byte first."""
        if len(arguments) < 3:
            return None
        index, value = arguments[0], int.from_bytes(arguments[1:3], "big")
        if index == ECHO_COUNT_SETTING:
            index = Setting.N_ECHOES
        if index < len(SETTINGS):
            self._state.board[SETTING + index] = value
        return b""

    def _on_g(self, arguments: bytes) -> bytes | None:
        """Return the reading of an ultrasonic sensor, by its number from 1."""
        if not arguments or not 1 <= arguments[0] <= N_ULTRASONIC:
            return None
        self.before_read("G")
        sensor = arguments[0] - 1
        is_active = self._state.board[SETTING + Setting.ULTRASONIC] >> sensor & 1
        start = sensor * N_ECHO
        reading = [int(number) * is_active for number in self._state.echoes[start : start + N_ECHO]]
        echoes = (
            _words(reading[echo : echo + 2]) + _word(reading[echo + 2], 4) for echo in range(1, N_ECHO, 3)
        )
        return _word(reading[0]) + b"".join(echoes) + _word(NOISE)

    def _on_k(self, arguments: bytes) -> bytes | None:
        """Set an LED by its number: off, on or toggled."""
        if len(arguments) < 2:
            return None
        led, state = arguments[:2]
        if led < 2:
            self._state.board[LEDS + led] = 1 - self._state.board[LEDS + led] if state == 2 else int(state > 0)
        return b""

    def _on_n(self, arguments: bytes) -> bytes:
        return self._infrared("N", "proximity")

    def _on_o(self, arguments: bytes) -> bytes:
        return self._infrared("O", "ambient")

    def _on_v(self, arguments: bytes) -> bytes | None:
        """Return a value of the battery, by its kind: whole part, and fraction in 1/10,000."""
        battery = self._state.battery
        level = charge_level(battery[USED], CAPACITY)
        values = (
            *(cells_voltage(level), -battery[CURRENT], -battery[AVERAGE], level * CAPACITY / 3.6),
            *(_TEMPERATURE, 100 * level),
        )
        if not arguments or arguments[0] >= len(values):
            return None
        value = values[arguments[0]]
        whole, fraction = divmod(round(abs(value) * 10_000), 10_000)
        # Sign and magnitude: the highest bit of the whole part (library).
        return _words((whole | (value < 0) << 15, fraction))

    def _on_z(self, arguments: bytes) -> bytes:
        self.before_read("Z")
        self._state.board[TIMER_ZERO_MS] = self.time_ms()
        return b""

    def _infrared(self, letter: str, channel: str) -> bytes:
        """Return the readings of a channel, and their time [ms]."""
        self.before_read(letter)
        registers, board, first = self._state.registers, self._state.board, FIRST[channel]
        readings = (int(registers[first + sensor]) for sensor in range(len(RING) + len(GROUND)))
        return _words(readings) + _word(max(board[SCAN_MS] - board[TIMER_ZERO_MS], 0), 4)


class RealTimeClock:
    """Real-time clock: seconds, minutes and hours since the start in decimal digits, in registers 0 to 2 (assumed).

    Args:
        time_ms: Function that returns the present time [ms].
    """

    is_powered = True

    def __init__(self, time_ms: Callable[[], int]) -> None:
        self._time_ms = time_ms
        self._register = 0

    def write(self, message: bytes) -> None:
        """Select a register; the clock cannot be set (assumed)."""
        self._register = message[0] if message else self._register

    def read(self, count: int) -> bytes:
        """Return bytes from the selected register on, zeros after the hours."""
        seconds = self._time_ms() // 1000
        fields = seconds % 60, seconds // 60 % 60, seconds // 3600 % 24
        content = bytes(field // 10 << 4 | field % 10 for field in fields)
        return content[self._register : self._register + count].ljust(count, b"\0")


class Bus:
    """All devices.

    Args:
        state: State of the robot.
        version: Version and revision of the dsPIC's firmware.

    Attributes:
        dspic: The dsPIC.
        motors: Motor controllers, left and right.
        clock: Real-time clock.
    """

    def __init__(self, state: Khepera3State, version: tuple[int, int]) -> None:
        self.dspic = Dspic(state, version)
        self.motors = MotorController(state, 0), MotorController(state, 1)
        self.clock = RealTimeClock(lambda: self.dspic.time_ms())

    @property
    def devices(self) -> dict[int, "Dspic | MotorController | RealTimeClock"]:
        """Devices by their addresses."""
        return {DSPIC: self.dspic, **dict(zip(MOTORS, self.motors, strict=True)), CLOCK: self.clock}


def _word(number: int, size: int = 2) -> bytes:
    """Return the bytes of a number, truncated as in C."""
    return (int(number) & (1 << 8 * size) - 1).to_bytes(size, "little")


def _words(numbers: Iterable[int]) -> bytes:
    return b"".join(map(_word, numbers))
