r"""Programs that answer letters on the line of a Khepera III: its firmware, and kh3server on a KoreBot.

    letters = Letters(Bus(state, KHEPERA_3), "3.0")
    reply = letters.receive(b"D,l20000,l-20000\n")

A command is a capital letter and numbers, separated by commas; the reply is the small letter and values. Both
programs set the motors at their start, and have the same letters.

The firmware (manual): replies end in LF CR. A number of more than 8 bits has the prefix d, of more than 16
bits the prefix l. A missing number, or one outside the range of its prefix, is answered with $ and has no
effect; any prefix is accepted, and text after digits ignored (assumed). U, its boot loader, is not modelled.

kh3server (library), to the byte: replies end in CR LF, and discard all input after their command. The first
character of a number with a prefix is blanked, whatever it is, so D,500,500 sets 0 and 0. A number has ten
bytes of memory, 0 before a command here, from which a longer one overflows into the next. A proximity of -1
is 65535. An A while the vehicle drives starts another in it, and an A,2 ends one. A command while it turns in
place is answered immediately here.
"""

import re
import struct
from collections.abc import Sequence

from khep_twin.robots.khepera3 import registers
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.model import KHEPERA_3, SERVER, SERVER_VEHICLE, VEHICLE
from khep_twin.robots.khepera3.registers import ControlType, MotorRegister, Option, PicMode
from khep_twin.robots.khepera3.state import SETTING
from khep_twin.robots.line_server import LONGEST_REQUEST, Command, Reply, VehicleServer
from khep_twin.robots.vehicle import WANDERING

_ORDERS = {
    "D": ControlType.SPEED,
    "F": ControlType.POSITION_PROFILE,
    "L": ControlType.OPEN_LOOP,
    "P": ControlType.POSITION,
}
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

_ECHO_SENSORS, _FAR_CM, _COUNTS_PER_CM = (1, 2, 3, 3, 4, 5), 70, 20
"""Ultrasonic sensors in place of the infrared ones from the left to the right, distance of an echo with a
reading of 0, and its rise, to 1000 at 20 cm (assumed)."""


class Letters(VehicleServer):
    """The firmware on the serial line.

    Args:
        bus: Devices of the robot.
        rom: Name of the firmware.
    """

    end, longest, discards = b"\n\r", LONGEST_REQUEST, False
    vehicle = VEHICLE
    nests = False  # a vehicle in another one, by the infrared sensors
    profile = 20_000, 64  # speed and acceleration of moves at the start (manual)
    charge = "{:d}"  # format of the battery's charge
    silence: bytes | None = None  # reply to a command that the dsPIC does not answer
    count_mask, value_mask = -1, 0xFFFF  # of a count of N, and of a value of C

    def __init__(self, bus: Bus, rom: str) -> None:
        self._bus, self.program = bus, rom
        super().__init__(KHEPERA_3.dialect, self.vehicle, bus.robot.vehicle, lambda: bus.dspic.is_powered)

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        for index, value in enumerate(registers.SETTINGS):
            self._bus.dspic.ask("C", index, *divmod(value, 256))
        for led in range(2):
            self._bus.dspic.ask("K", led, 0)
        self._set(MotorRegister.MODE, 1, PicMode.RESET)
        return super().reset()

    def tick(self) -> None:
        """Run the vehicle of A for a control period; it has rounds of 20 ms (library)."""
        if not self._bus.dspic.time_ms() % 20:
            self._gain = (
                None if self.nests else self._bus.robot.board[SETTING + registers.Setting.VEHICLE_GAIN]
            )
            super().tick()

    def _readings(self) -> Sequence[int]:
        if self._state[WANDERING] == 1 or self.nests:
            return self._on_n(())
        echoes = [self._bus.dspic.ask("G", number) or (0, 0) for number in _ECHO_SENSORS]
        readings = [_COUNTS_PER_CM * (_FAR_CM - echo[1]) * (echo[0] > 0) for echo in echoes]
        return [0, *(max(reading, 0) for reading in readings), *[0] * 4]

    def _parse(self, request: bytes) -> Command | None:
        head, *fields = request.split(b",")
        if (arguments := _ARGUMENTS.get(letter := head.strip().decode("latin-1"))) is None:
            return None
        matches = [match for match in map(_PREFIXED.match, fields[: len(arguments)]) if match]
        numbers, limits = [int(match[2]) for match in matches], [_LIMITS[match[1]] for match in matches]
        is_valid = all(low <= number <= high for number, (low, high) in zip(numbers, limits, strict=True))
        return (letter, numbers) if is_valid and len(numbers) == len(arguments) else None

    def _run(self, letter: str, values: Sequence[int]) -> Reply:
        if letter in _ORDERS:
            return self._order(letter, values)
        if letter in _MEASURES:
            return self._measure(letter)
        if hasattr(self, f"_on_{letter.lower()}"):
            return super()._run(letter, values)
        arguments = [value & 0xFF for value in values]
        if letter == "C":
            arguments[1:] = divmod(values[1] & self.value_mask, 256)
        reply = self._bus.dspic.ask(letter, *arguments)
        return self.silence if reply is None else reply

    def _on_a(self, values: Sequence[int]) -> Reply:
        (mode,), level = values, int(self._state[WANDERING])
        if mode in (0, 1):
            return self._start_vehicle(1 + (level if self.nests else mode), self._measure("R"))
        if level and (self.nests or mode == 2):
            self._state[WANDERING] = level - 1 if self.nests else 0
            self._set(MotorRegister.MODE, 1, PicMode.STOP)
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
        self._set(MotorRegister.MODE, 1, PicMode.IDLE)
        for register, size, value in registers.DEFAULTS:
            self._set(register, size, value)
        self._set(MotorRegister.HARDWARE_OPTIONS, 1, 0)
        self._set(MotorRegister.OPTIONS, 1, _OPTIONS | Option.INVERTED, _OPTIONS)
        self._set(MotorRegister.ERRORS, 1, 0)
        return self._on_j(self.profile)

    def _on_n(self, values: Sequence[int]) -> Sequence[int]:
        *counts, time_ms = self._bus.dspic.ask("N") or (0,)
        return *(count & self.count_mask for count in counts), time_ms

    def _on_v(self, values: Sequence[int]) -> Reply:
        """Return a value of the battery, by its kind: 0 voltage [V] to 5 charge [%]."""
        kind = values[0] & 0xFFFF
        if kind > 5:
            return None
        integer, fraction = self._bus.dspic.ask("V", kind) or (0, 0)
        sign = "-" if kind in (1, 2) and integer & 0x8000 else ""
        if kind in (3, 5):
            return [self.charge.format(integer) if kind == 3 else integer]
        return f"{sign}{integer & 0x7FFF if sign else integer}", fraction

    def _on_x(self, values: Sequence[int]) -> bytes:
        proximity, ambient = (self._bus.dspic.execute(letter)[1:] for letter in (b"N", b"O"))
        motors = struct.pack("<4i", *self._measure("E"), *self._measure("R"))
        return b"".join([b"x", proximity[:22], ambient[:22], motors, ambient[22:], b"\n\r"])

    def _order(self, letter: str, orders: Sequence[int]) -> Sequence[int]:
        """Set mode, control type and set points of the motors."""
        self._set(MotorRegister.MODE, 1, PicMode.NORMAL)
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


class Kh3Server(Letters):
    """kh3server on a KoreBot."""

    end, longest, discards = VehicleServer.end, VehicleServer.longest, True
    answer_ns = 3_000_000  # an exchange with the dsPIC (a program)
    vehicle, nests = SERVER_VEHICLE, True
    profile, charge, silence = (15_000, 10), "{:03d}", b""
    count_mask, value_mask = 0xFFFF, 0xFF

    def _parse(self, request: bytes) -> Command | None:
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


def program_of(bus: Bus, rom: str) -> Letters:
    """Return the program of a firmware's name."""
    return (Kh3Server if rom == SERVER else Letters)(bus, rom)
