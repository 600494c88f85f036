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
from khep_twin.board.memory import read_signed, write_number
from khep_twin.robots.khepera3.channels import GROUND, RING
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.motor_control import Motor, MotorState, halt, reset
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
)

NOISE = 1800
"""Noise of each ultrasonic reading (the manual's example)."""

ECHO_COUNT_SETTING = 254
"""Index of a setting by which the toolbox sets the number of echoes."""

_TEMPERATURE = 25.0
"""Temperature of the battery [degree C] (assumed)."""

_LATCHES = {
    MotorRegister.POSITION + 3: (4, Motor.POSITION),
    MotorRegister.SPEED + 3: (4, Motor.SPEED),
    MotorRegister.CURRENT + 1: (2, Motor.CURRENT),
    MotorRegister.OUTPUT + 1: (2, Motor.PWM),
}
"""Size of a measured number, and the number, by the register of its highest byte."""

_READ_ONLY = {
    *(MotorRegister.VERSION, MotorRegister.STATUS),
    *range(MotorRegister.SPEED, MotorRegister.SPEED + 4),
    *range(MotorRegister.LEAST_SAMPLE_TIME, MotorRegister.LEAST_SPEED),
}


class MotorController:
    """One of the motor controllers.

    Args:
        robot: State of the robot.
        state: State of the controller.
    """

    def __init__(self, robot: Khepera3State, state: MotorState) -> None:
        self._robot, self._state = robot, state
        self._register = 0

    @property
    def is_powered(self) -> bool:
        """True if the supply suffices; otherwise the bus gets no reply."""
        return bool(self._robot.board[POWERED])

    def write(self, message: bytes) -> None:
        """Select a register, and write a byte to it if the message has one."""
        register = self._register = message[0]
        if len(message) == 1 or register >= N_BYTES or register in _READ_ONLY:
            return
        memory, numbers, byte = self._state.memory, self._state.numbers, message[1]
        if register == MotorRegister.CONTROL and byte != memory[register]:
            halt(self._state)
        memory[register] = byte
        if register == MotorRegister.SET_POINT:
            numbers[Motor.SET_POINT] = read_signed(memory, register, 4)
            numbers[Motor.ON_TARGET] = 0
        elif register == MotorRegister.POSITION:
            numbers[Motor.POSITION] = read_signed(memory, register, 4)
        elif register == MotorRegister.MODE and byte == Mode.STOP:
            numbers[Motor.HELD] = numbers[Motor.POSITION]
        elif register == MotorRegister.MODE and byte == Mode.RESET:
            reset(self._state)
        elif register == MotorRegister.MODE and byte in (Mode.SAVE, Mode.SEARCH):
            # A search of limits ends at once, and settings are not saved (assumed).
            memory[register] = Mode.IDLE

    def read(self, count: int) -> bytes:
        """Return the byte of the selected register, `count` times."""
        register, memory = self._register, self._state.memory
        if register in _LATCHES:
            size, number = _LATCHES[register]
            write_number(memory, register - size + 1, size, self._state.numbers[number])
        return bytes([memory[register] if register < N_BYTES else 0]) * count

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
        if 1 < message[0] == len(message):
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
        reading = [self._state.echoes[start + index] * is_active for index in range(N_ECHO)]
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
            self._state.board[LEDS + led] = (
                1 - self._state.board[LEDS + led] if state == 2 else int(state > 0)
            )
        return b""

    def _on_n(self, arguments: bytes) -> bytes:
        return self._infrared("N", "proximity")

    def _on_o(self, arguments: bytes) -> bytes:
        return self._infrared("O", "ambient")

    def _on_v(self, arguments: bytes) -> bytes | None:
        """Return a value of the battery, by its kind: whole part, and fraction in 1/10,000, of degrees in tenths (manual)."""
        battery = self._state.battery
        level = charge_level(battery[USED], CAPACITY)
        values = (
            *((cells_voltage(level), 10_000), (-battery[CURRENT], 10_000), (-battery[AVERAGE], 10_000)),
            *((level * CAPACITY / 3.6, 1), (_TEMPERATURE, 10), (100 * level, 1)),
        )
        if not arguments or arguments[0] >= len(values):
            return None
        value, parts = values[arguments[0]]
        whole, fraction = divmod(round(abs(value) * parts), parts)
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
        readings = (registers[first + sensor] for sensor in range(len(RING) + len(GROUND)))
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
        self._register = message[0]

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
        self.motors = MotorController(state, state.left), MotorController(state, state.right)
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
