r"""Programs that answer letters on the line of a Khepera III: its firmware, and kh3server on a KoreBot.

    letters = Letters(Bus(state, (3, 0)), state.vehicle, "3.0")
    reply = letters.receive(b"D,l20000,l-20000\n")

A command is a capital letter and numbers, separated by commas; the reply is the small letter and values. Both
programs set the motors at their start, and have the same letters.

The firmware (manual): replies end in LF CR. A number of more than 8 bits has the prefix d, of more than 16
bits the prefix l. A missing number, or one that is too large for its prefix, is answered with $ and has no
effect; any prefix is accepted, and text after digits ignored (assumed). U, its boot loader, is not modelled.

kh3server (library), to the byte: replies end in CR LF, and discard all input after their command. The first
character of a number with a prefix is blanked, whatever it is, so D,500,500 sets 0 and 0. A number has ten
bytes of memory, 0 before a command here, from which a longer one overflows into the next. A proximity of -1
is 65535. An A while the vehicle drives starts another in it, and an A,2 ends one. A command while it turns in
place is answered at once here.
"""

import re
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.model import KHEPERA_3, SERVER
from khep_twin.robots.khepera3.registers import DEFAULTS, SETTINGS, Control, Mode, MotorRegister, Option
from khep_twin.robots.khepera3.state import LAST_LEFT, LAST_RIGHT, N_STILL, TURNING, WANDERING
from khep_twin.robots.khepera3.wandering import ECHO_SENSORS, echo_readings, next_speeds
from khep_twin.robots.line_server import LONGEST_REQUEST, VehicleServer
from khep_twin.sensing.buffers import Vector

ERROR = b"$"
"""Reply to an unknown or malformed command (library; assumed for the firmware)."""

_ROUND_MS = 20
"""Time of a round of the vehicle (library)."""

_ORDERS = dict(
    zip("DFLP", (Control.SPEED, Control.POSITION_PROFILE, Control.OPEN_LOOP, Control.POSITION), strict=True)
)
_MEASURES = {"E": MotorRegister.SPEED, "R": MotorRegister.POSITION}

_ARGUMENTS = {
    **dict.fromkeys("BEMNORXZ", ""),
    **dict.fromkeys("AGV", "b"),
    **dict.fromkeys("DFIJLP", "pp"),
    **{"C": "bp", "H": "pppp", "K": "bb"},
}
"""Numbers of each command: p with a prefix, of which kh3server blanks the first character."""

_LIMITS = {b"": (-0x80, 0xFF), b"d": (-0x8000, 0xFFFF), b"l": (-(2**31), 2**31 - 1)}
"""Least and largest number with a prefix."""

_PREFIXED, _INTEGER = re.compile(rb"\s*([dl]?)\s*([+-]?[0-9]+)"), re.compile(rb"\s*[+-]?[0-9]+")
_N_NUMBERS, _NUMBER_BYTES = 4, 10

_OPTIONS = Option.ANTI_WINDUP | Option.STOP_WHEN_BLOCKED
"""Options at the start; the other settings are those at power-up (library; assumed for the firmware)."""

_Command = tuple[str, Sequence[int]]
"""Letter and numbers of a command."""


class _Program(NamedTuple):
    """Properties in which the programs differ."""

    parse: Callable[[bytes], _Command | None]
    end: bytes  # of a reply
    silence: bytes | None  # reply to a command that the dsPIC does not answer; None for an error
    answer_ns: int  # time to a reply
    longest: int  # bytes of a request that are read
    discards: bool  # the input after a command
    profile: tuple[int, int]  # speed and acceleration of moves at the start
    proximity: int  # mask of a count of N
    mask: int  # of a value of C
    charge: str  # format of the battery's charge
    nests: bool  # the vehicle, which takes the readings from the second one on


def _parse(request: bytes) -> _Command | None:
    """Return a command of the firmware; None if it is malformed."""
    head, *fields = request.split(b",")
    if (arguments := _ARGUMENTS.get(letter := head.strip().decode("latin-1"))) is None:
        return None
    matches = [match for match in map(_PREFIXED.match, fields[: len(arguments)]) if match]
    numbers, limits = [int(match[2]) for match in matches], [_LIMITS[match[1]] for match in matches]
    is_valid = all(low <= number <= high for number, (low, high) in zip(numbers, limits, strict=True))
    return (letter, numbers) if is_valid and len(numbers) == len(arguments) else None


def _parse_as_server(request: bytes) -> _Command | None:
    """Return a command of kh3server; None for an unknown letter."""
    text = request.partition(b"\0")[0]
    if (arguments := _ARGUMENTS.get(letter := text[:1].decode("latin-1"))) is None:
        return None
    fields = [field for field in text[2:].split(b",") if field][:_N_NUMBERS]
    if letter in "AV" and len(fields) != 1:
        return letter, [-1]
    memory = bytearray(_N_NUMBERS * _NUMBER_BYTES + len(text) + 1)
    starts = range(0, _N_NUMBERS * _NUMBER_BYTES, _NUMBER_BYTES)
    for start, field in zip(starts, fields, strict=False):
        memory[start : start + len(field) + 1] = field + b"\0"
    for start, kind in zip(starts, arguments, strict=False):
        memory[start] = ord(" ") if kind == "p" else memory[start]
    matches = (_INTEGER.match(memory[start:].partition(b"\0")[0]) for start in starts[: len(arguments)])
    low, high = _LIMITS[b"l"]
    return letter, [min(max(int(match[0]), low), high) if match else 0 for match in matches]


_FIRMWARE = _Program(
    _parse, b"\n\r", None, 0, LONGEST_REQUEST, False, (20_000, 64), -1, 0xFFFF, "{:d}", False
)
_SERVER = _Program(
    _parse_as_server, b"\r\n", b"", 3_000_000, 82, True, (15_000, 10), 0xFFFF, 0xFF, "{:03d}", True
)
"""The programs. The firmware's profile: manual; the server's time: an exchange with the dsPIC (a program)."""


class Letters(VehicleServer):
    """The program on the serial line; it starts with the first bytes received.

    Args:
        bus: Devices of the robot.
        vehicle: State of the vehicle (N_VEHICLE,).
        rom: Name of the firmware.
    """

    def __init__(self, bus: Bus, vehicle: Vector[int], rom: str) -> None:
        self._bus, self.program = bus, rom
        self._program = _SERVER if rom == SERVER else _FIRMWARE
        self.answer_ns = self._program.answer_ns
        super().__init__(KHEPERA_3.dialect, self.execute, vehicle)

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        for index, value in enumerate(SETTINGS):
            self._bus.dspic.ask("C", index, *divmod(value, 256))
        for led in range(2):
            self._bus.dspic.ask("K", led, 0)
        self._set(MotorRegister.MODE, 1, Mode.RESET)
        return super().reset()

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return self._bus.dspic.is_powered

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
        if not self._vehicle[WANDERING] or self._bus.dspic.time_ms() % _ROUND_MS:
            return
        readings, positions = self._vehicle_readings(), self._measure("R")
        gain, is_server = self._bus.dspic.vehicle_gain, self._program.nests
        if speeds := next_speeds(self._vehicle, readings, positions, gain, is_server):
            self._order("D", speeds)

    def execute(self, request: bytes) -> bytes:
        """Execute a command by the tables, or by its method, `_on_a` for A; return its reply."""
        command = self._program.parse(request)
        reply = None if command is None else self._run(*command)
        if isinstance(reply, bytes):
            return reply
        if command is None or reply is None:
            return ERROR + self._program.end
        return ",".join([command[0].lower(), *map(str, reply)]).encode() + self._program.end

    def _run(self, letter: str, values: Sequence[int]) -> Sequence[object] | bytes | None:
        """Execute a command; return the values of its reply, a binary reply, or None for an error."""
        if letter in _ORDERS:
            return self._order(letter, values)
        if letter in _MEASURES:
            return self._measure(letter)
        if handler := getattr(self, f"_on_{letter.lower()}", None):
            return handler(values)
        arguments = [value & 0xFF for value in values]
        if letter == "C":
            arguments[1:] = divmod(values[1] & self._program.mask, 256)
        reply = self._bus.dspic.ask(letter, *arguments)
        return self._program.silence if reply is None else reply

    def _on_a(self, values: Sequence[int]) -> Sequence[int] | None:
        vehicle, (mode,), nests = self._vehicle, values, self._program.nests
        if mode in (0, 1):
            drives = vehicle[WANDERING] + 1 if nests else mode + 1
            vehicle[WANDERING], vehicle[TURNING], vehicle[N_STILL] = drives, 0, 0
            vehicle[LAST_LEFT], vehicle[LAST_RIGHT] = self._measure("R")
            return ()
        if vehicle[WANDERING] and (nests or mode == 2):
            vehicle[WANDERING] = vehicle[WANDERING] - 1 if nests else 0
            self._set(MotorRegister.MODE, 1, Mode.STOP)
        return () if mode == 2 else None

    def _on_h(self, values: Sequence[int]) -> Sequence[int]:
        kind, kp, ki, kd = values
        first = MotorRegister.POSITION_GAINS if kind else MotorRegister.SPEED_GAINS
        for index, gain in enumerate((kp, kd, ki)):
            self._set(first + 2 * index, 2, gain)
        return ()

    def _on_i(self, values: Sequence[int]) -> Sequence[int]:
        return self._set(MotorRegister.POSITION, 4, *values)

    def _on_j(self, values: Sequence[int]) -> Sequence[int]:
        self._set(MotorRegister.TOP_SPEED, 2, values[0])
        return self._set(MotorRegister.ACCELERATION, 1, values[1])

    def _on_m(self, values: Sequence[int]) -> Sequence[int]:
        self._set(MotorRegister.MODE, 1, Mode.IDLE)
        for register, size, value in DEFAULTS:
            self._set(register, size, value)
        self._set(MotorRegister.HARDWARE_OPTIONS, 1, 0)
        self._set(MotorRegister.OPTIONS, 1, _OPTIONS | Option.INVERTED, _OPTIONS)
        self._set(MotorRegister.ERRORS, 1, 0)
        return self._on_j(self._program.profile)

    def _on_n(self, values: Sequence[int]) -> Sequence[int]:
        *counts, time_ms = self._bus.dspic.ask("N") or (0,)
        return *(count & self._program.proximity for count in counts), time_ms

    def _on_v(self, values: Sequence[int]) -> Sequence[object] | None:
        """Return a value of the battery, by its kind: 0 voltage [V] to 5 charge [%]."""
        kind = values[0] & 0xFFFF
        if kind > 5:
            return None
        integer, fraction = self._bus.dspic.ask("V", kind) or (0, 0)
        sign = "-" if kind in (1, 2) and integer & 0x8000 else ""
        if kind in (3, 5):
            return [self._program.charge.format(integer) if kind == 3 else integer]
        return f"{sign}{integer & 0x7FFF if sign else integer}", fraction

    def _on_x(self, values: Sequence[int]) -> bytes:
        proximity, ambient = (self._bus.dspic.execute(letter)[1:] for letter in (b"N", b"O"))
        motors = struct.pack("<4i", *self._measure("E"), *self._measure("R"))
        return b"".join([b"x", proximity[:22], ambient[:22], motors, ambient[22:], b"\n\r"])

    def _order(self, letter: str, orders: Sequence[int]) -> Sequence[int]:
        """Set mode, control type and set points of the motors."""
        self._set(MotorRegister.MODE, 1, Mode.NORMAL)
        self._set(MotorRegister.CONTROL, 1, _ORDERS[letter])
        return self._set(MotorRegister.SET_POINT, 4, *orders)

    def _set(self, register: int, size: int, *values: int) -> Sequence[int]:
        """Set a register of both motors, to one value or two; return the values of an empty reply."""
        for motor, value in zip(self._bus.motors, (values[0], values[-1]), strict=True):
            motor.set(register, size, value)
        return ()

    def _measure(self, letter: str) -> tuple[int, int]:
        """Return the speeds or positions of both motors."""
        left, right = self._bus.motors
        return left.get(_MEASURES[letter], 4), right.get(_MEASURES[letter], 4)

    def _vehicle_readings(self) -> Sequence[int]:
        """Return the readings of the infrared sensors, or those of the ultrasonic ones in their place."""
        if self._vehicle[WANDERING] == 1 or self._program.nests:
            return self._on_n(())
        return echo_readings([self._bus.dspic.ask("G", number) or () for number in ECHO_SENSORS])
