"""Programs that answer letters on the serial line of a Khepera III: its firmware, and kh3server on a KoreBot.

    letters = Letters(Bus(state, (3, 0)), state.vehicle, "3.0")
    reply = letters.receive(b"D,l20000,l-20000\n")

A command is a capital letter and numbers, separated by commas; the reply is the small letter and values. Both
programs have the same letters, and set the motors at their start.

The firmware (manual): replies end in LF CR. A number of more than 8 bits has the prefix d, of more than 16 bits
the prefix l. A missing number, or one that is too large for its prefix, is answered with $ and has no effect;
any prefix is accepted, and text after the digits is ignored (assumed). U, its boot loader, is not modelled.

kh3server (library), to the byte: replies end in CR LF, and discard all input after their command. The first
character of a number with a prefix is blanked, whatever it is, so D,500,500 sets 0 and 0. Each number has ten
bytes of memory, from which a longer one overflows into the next; all are 0 before each command here. Values
that the server takes as unsigned remain so: a proximity of -1 is 65535. An A while the vehicle drives starts a
second one in it, and each A,2 ends one. Commands are answered here also while the vehicle turns in place.
"""

import re
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from khep_twin.firmware import FirmwareState
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.channels import RING, ULTRASONIC
from khep_twin.robots.khepera3.model import KHEPERA_3, SERVER
from khep_twin.robots.khepera3.registers import SETTINGS, Control, Mode, MotorRegister, Option, Setting
from khep_twin.robots.khepera3.state import (
    LAST_LEFT,
    LAST_RIGHT,
    N_STILL,
    N_VEHICLE,
    TURNING,
    WANDERING,
)
from khep_twin.robots.khepera3.vehicle import vehicle_speeds
from khep_twin.robots.line_server import LONGEST_REQUEST, LineServer
from khep_twin.sensing.buffers import Vector

ERROR = b"$"
"""Reply to an unknown or malformed command (library; assumed for the firmware)."""

BINARY_BYTES = 67
"""Bytes of X's reply."""

_ROUND_MS, _TURN_SPEEDS, _BLOCKED, _N_STUCK, _MOVED_PULSES = 20, (12_800, -12_800), 250, 5, 700
"""Parameters of the vehicle besides those of `vehicle_speeds` (library): time of a round; speeds of a turn in
place, in which it remains while a front reading is higher than 250, and which it begins after so many rounds
in which it moved less than 700 pulses."""

_FAR_CM, _COUNTS_PER_CM = 70, 20
"""Vehicle with ultrasonic sensors: distance with a reading of 0, and its rise, to 1000 at 20 cm (assumed)."""

_ECHO_SENSORS = (1, 2, 3, 3, 4, 5)
"""Number of the ultrasonic sensor in place of each infrared one, from the left to the right one (assumed)."""

_ORDERS = {
    "D": Control.SPEED,
    "F": Control.POSITION_PROFILE,
    "L": Control.OPEN_LOOP,
    "P": Control.POSITION,
}
_MEASURES = {"E": MotorRegister.SPEED, "R": MotorRegister.POSITION}

_FRAMES = {"B": "<2H", "C": "<", "G": "<H" + 5 * "HHi" + "H", "K": "<", "O": "<11HI", "Z": "<"}
"""Layout of the dsPIC's replies that are passed on, besides N."""

_ARGUMENTS = {
    **dict.fromkeys("BEMNORXZ", ""),
    **dict.fromkeys("AGV", "b"),
    **dict.fromkeys("DFIJLP", "pp"),
    **{"C": "bp", "H": "pppp", "K": "bb"},
}
"""Arguments of each command: p with a prefix, of which kh3server blanks the first character."""

_LIMITS = {b"": (-0x80, 0xFF), b"d": (-0x8000, 0xFFFF), b"l": (-(2**31), 2**31 - 1)}
"""Least and largest number by its prefix."""

_NUMBER = re.compile(rb"\s*([dl]?)\s*([+-]?[0-9]+)")
_N_ARGUMENTS, _ARGUMENT_BYTES = 4, 10

_SETTINGS = (
    (MotorRegister.MODE, 1, Mode.IDLE),
    (MotorRegister.SAMPLE_TIME, 2, 1550),
    (MotorRegister.MARGIN, 1, 6),
    (MotorRegister.HARDWARE_OPTIONS, 1, 0),
    (MotorRegister.SOFTWARE_OPTIONS, 1, Option.ANTI_WINDUP | Option.STOP_WHEN_BLOCKED),
    (MotorRegister.ERRORS, 1, 0),
    (MotorRegister.BLOCKED_TIME, 1, 10),
    (MotorRegister.CURRENT_LIMIT, 2, 500),
    (MotorRegister.LOWEST, 4, -10_000),
    (MotorRegister.HIGHEST, 4, 10_000),
)
"""Register, size and value of each setting at the start (library; assumed for the firmware)."""

_GAINS = (MotorRegister.SPEED_GAINS, 620, 10, 3), (MotorRegister.POSITION_GAINS, 600, 30, 20)
"""First register and Kp, Ki, Kd of both controllers."""

_Command = tuple[str, Sequence[int]]


class _Program(NamedTuple):
    """Properties in which the programs differ.

    Attributes:
        parse: Function that returns letter and numbers of a request; None if it is malformed.
        end: End of a reply.
        silence: Reply to a command that the dsPIC does not answer; None for an error.
        answer_ns: Time from a command to its reply [ns].
        longest: Bytes of a request that are read.
        discards: Whether a reply discards the input after its command.
        profile: Speed and acceleration of moves.
        proximity: Layout of the dsPIC's reply to N.
        mask: Bits of a value of C.
        capacity: Format of the battery's charge.
        first_sensor: First reading of the vehicle.
        nests: Whether the vehicle starts in itself again, always with infrared sensors.
    """

    parse: Callable[[bytes], _Command | None]
    end: bytes
    silence: bytes | None
    answer_ns: int
    longest: int
    discards: bool
    profile: tuple[int, int]
    proximity: str
    mask: int
    capacity: str
    first_sensor: int
    nests: bool


def _parse(request: bytes) -> _Command | None:
    """Return a command of the firmware."""
    head, *fields = request.strip().split(b",")
    if (arguments := _ARGUMENTS.get(letter := head.decode("latin-1"))) is None:
        return None
    numbers = [(match[1], int(match[2])) for match in map(_NUMBER.match, fields[: len(arguments)]) if match]
    is_valid = all(_LIMITS[prefix][0] <= number <= _LIMITS[prefix][1] for prefix, number in numbers)
    return (letter, [number for _, number in numbers]) if is_valid and len(numbers) == len(arguments) else None


def _parse_as_server(request: bytes) -> _Command | None:
    """Return a command of kh3server, whatever follows its letter."""
    text = request.partition(b"\0")[0]
    if (arguments := _ARGUMENTS.get(letter := text[:1].decode("latin-1"))) is None:
        return None
    fields, memory = [field for field in text[2:].split(b",") if field][:_N_ARGUMENTS], bytearray(256)
    for start, field in zip(range(0, 256, _ARGUMENT_BYTES), fields, strict=False):
        memory[start : start + len(field) + 1] = field + b"\0"
    values: list[int] = []
    low, high = _LIMITS[b"l"]
    for index, kind in enumerate(arguments):
        start = index * _ARGUMENT_BYTES
        if kind == "p":
            memory[start] = ord(" ")
        match = _NUMBER.match(memory[start:].partition(b"\0")[0])
        values.append(min(max(int(match[2]), low), high) if match and not match[1] else 0)
    return letter, [-1] if letter in "AV" and len(fields) != 1 else values


_FIRMWARE = _Program(
    _parse, b"\n\r", None, 0, LONGEST_REQUEST, False, (20_000, 64), "<11hI", 0xFFFF, "{:d}", 0, False
)
_SERVER = _Program(
    _parse_as_server, b"\r\n", b"", 3_000_000, 82, True, (15_000, 10), "<11HI", 0xFF, "{:03d}", 1, True
)
"""The programs. The firmware's profile: manual; the server's time: that of 31 bytes on the bus (a program)."""


class Letters(LineServer):
    """The program on the serial line; it starts with the first bytes received.

    Args:
        bus: Devices of the robot.
        vehicle: State of the vehicle (N_VEHICLE,).
        rom: Name of the firmware.
    """

    def __init__(self, bus: Bus, vehicle: Vector[int], rom: str) -> None:
        self._bus, self._vehicle, self.program = bus, vehicle, rom
        self._program = _SERVER if rom == SERVER else _FIRMWARE
        self.answer_ns = self._program.answer_ns
        super().__init__(KHEPERA_3.dialect, self.execute)
        self.forget()

    def forget(self) -> None:
        """End the program; it restarts with the next bytes."""
        super().forget()
        self._is_running = False
        for index in range(N_VEHICLE):
            self._vehicle[index] = 0

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        for index, value in enumerate(SETTINGS):
            self._bus.dspic.execute(b"C%c%c%c" % (index, value >> 8, value & 0xFF))
        for led in range(2):
            self._bus.dspic.execute(b"K%c\0" % led)
        for motor in self._bus.motors:
            motor.enter(Mode.RESET)
        return super().reset()

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return self._bus.dspic.is_powered

    def state(self) -> FirmwareState:
        """Return the state without that of the vehicle."""
        return super().state()._replace(running=self.program if self._is_running else "")

    def set_state(self, state: FirmwareState) -> None:
        """Restore a state without that of the vehicle.

        Raises:
            ValueError: It is of another robot.
        """
        super().set_state(state._replace(running=state.running or self.program))
        self._is_running = bool(state.running)

    def receive(self, data: bytes) -> bytes:
        """Receive bytes; return the replies to the commands that they complete."""
        if not self.powered:
            return b""
        if not self._is_running:
            self._is_running = True
            self._on_m(())
        messages, line = self._framing.split(self._line + data, to_robot=True)
        self._line, replies = line[: self._program.longest], b""
        for request in filter(None, messages):
            replies += self.execute(request[: self._program.longest])
            if replies and self._program.discards:
                self._line = b""
                break
        return replies

    def tick(self) -> None:
        """Run the vehicle of A for a control period."""
        vehicle = self._vehicle
        if not vehicle[WANDERING] or self._bus.dspic.time_ms() % _ROUND_MS:
            return
        readings = self._vehicle_readings()
        front = RING.index("front left")
        if vehicle[TURNING] and max(readings[front : front + 2]) > _BLOCKED:
            return
        positions = self._measure("R")
        is_still = all(map(self._is_near, positions, (vehicle[LAST_LEFT], vehicle[LAST_RIGHT])))
        vehicle[N_STILL] = vehicle[N_STILL] + 1 if is_still else 0
        vehicle[TURNING] = vehicle[N_STILL] > _N_STUCK
        if vehicle[TURNING] or not is_still:
            vehicle[N_STILL], vehicle[LAST_LEFT], vehicle[LAST_RIGHT] = 0, *positions
        first, gain = self._program.first_sensor, self._bus.dspic.setting(Setting.VEHICLE_GAIN)
        sensors = readings[first : first + len(RING)]
        speeds = vehicle_speeds(sensors) if self._program.nests else vehicle_speeds(sensors, gain)
        self._order("D", _TURN_SPEEDS if vehicle[TURNING] else speeds)

    def execute(self, request: bytes) -> bytes:
        """Execute a command by the tables, or by its method, `_on_a` for A; return its reply."""
        reply, letter = None, ""
        if command := self._program.parse(request):
            letter, values = command
            reply = self._run(letter, values)
        if isinstance(reply, bytes):
            return reply
        text = ERROR if reply is None else ",".join([letter.lower(), *map(str, reply)]).encode()
        return text + self._program.end

    def _run(self, letter: str, values: Sequence[int]) -> Sequence[object] | bytes | None:
        """Execute a command; return the values of its reply, a binary reply, or None for an error."""
        if letter in _ORDERS:
            return self._order(letter, values)
        if letter in _MEASURES:
            return self._measure(letter)
        if handler := getattr(self, f"_on_{letter.lower()}", None):
            return handler(values)
        arguments = bytes(value & 0xFF for value in values)
        if letter == "C":  # of its value, the high byte is the first
            arguments = arguments[:1] + (values[1] & self._program.mask).to_bytes(2, "big")
        return self._ask(letter, arguments) or self._program.silence

