"""kh4server, the program on the Khepera IV that answers ASCII commands on a serial line (manual, chapter 6).

    server = Kh4Server(Dspic())
    reply = server.receive(b"D,100,100" + END)

A command is a capital letter and numbers, separated by commas; the reply is its small letter and values. The
published program is imitated letter by letter (library): a reply drops what has arrived behind its command,
a wrong A ends the vehicle, too, and X sends 128 bytes, the readings from their second byte on. What is
undefined in it (memory that it has not written) is 0 here: missing numbers, the last byte of the readings of
X, all behind its first 67. docs/khepera4.md lists what is not imitated.
"""

import re
from collections.abc import Callable, Mapping, Sequence

from khep_twin.board.kernel import divide
from khep_twin.board.protocol import LINE_END
from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.firmware import FirmwareState
from khep_twin.khepera4.dspic import N_INFRARED, N_ULTRASONIC, Dspic
from khep_twin.khepera4.registers import BATTERY_BYTES, Control, DspicRegister

BAUD = 115_200
"""Speed of the serial line [baud] (manual, chapter 6)."""

ANSWER_NS = 2_000_000
"""Time from a command to its reply [ns]: that of some 60 bytes on the bus (assumed)."""

END = b"\r\n"
ERROR = b"$" + END
"""Reply to what is unknown, or has another number of values."""

DEFAULT_PROFILE = (3, 0, 20, 1, 400)
WANDERING_PROFILE = (10, 0, 20, 1, 400)
"""Profiles of J: of the program at its start, and of its Braitenberg vehicle."""

MARGIN = 20
"""Position margin that the program sets at its start [pulses]."""

LONGEST_LINE = 82
"""Bytes of a command that are read; the rest of its line is dropped."""

BINARY_BYTES = 128
"""Length of X's reply, of which 67 bytes have a meaning."""

LEFT_WEIGHTS, RIGHT_WEIGHTS = (2, 3, 4, -7, -4, -3, -2, 1), (-2, -3, -4, -9, 4, 3, 2, 1)
FORWARDS, LEAST_SPEED, TURNING = 200, 10, 120
NEAREST, FARTHEST, GAIN_DIVISOR = 500, 80, 3
BLOCKED, PATIENCE, MOVED = 250, 5, 4424
"""Numbers of the vehicle: weights of the eight sensors; speed without obstacles, least speed, and that of a
turn in place [pulses/10 ms]; readings with the largest and without an effect; the reading in front for which
it turns where it has not moved by 30 mm [pulses] for so many rounds."""

_FRONT = 3
_INTEGER = re.compile(rb"\s*[+-]?\d+")


class Kh4Server:
    """The program at its serial line, which starts with the first bytes on it.

    Args:
        dspic: Microcontroller that it drives.
        is_charging: Function that tells whether the charger is plugged in.

    Attributes:
        baud: Speed of the line [baud].
        reply_baud: The same.
        turrets: None.
        answer_ns: Time that an answer takes [ns].
    """

    answer_ns = ANSWER_NS

    def __init__(self, dspic: Dspic, is_charging: Callable[[], bool] = lambda: False) -> None:
        self._dspic, self._is_charging = dspic, is_charging
        self.baud = self.reply_baud = BAUD
        self.turrets: Mapping[TurretKind, Turret] = {}
        self.forget()

    def forget(self) -> None:
        """End the program; it starts anew with the next bytes."""
        self._line = b""
        self._runs = self._wanders = self._turns = False
        self._rounds, self._before = 0, (0, 0)

    def forget_line(self) -> None:
        """Discard the incomplete line."""
        self._line = b""

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        self._dspic.reset()
        self.forget()
        return b""

    def remedy(self, baud: int) -> str:
        """Return a hint for setting the robot's line to a host's speed [baud]."""
        return f"expected {BAUD} baud at the host, not {baud}"

    @property
    def powered(self) -> bool:
        """True while the robot runs."""
        return self._dspic.is_powered

    def state(self) -> FirmwareState:
        """Return the state besides `numbers`."""
        return FirmwareState(self.baud, self.reply_baud, "kh4server" if self._runs else "", self._line, {})

    def set_state(self, state: FirmwareState) -> None:
        """Take over a state."""
        self._runs, self._line = bool(state.running), state.begun

    @property
    def numbers(self) -> list[int]:
        """State of the vehicle."""
        return [self._wanders, self._turns, self._rounds, *self._before]

    @numbers.setter
    def numbers(self, numbers: Sequence[int]) -> None:
        wanders, turns, self._rounds, left, right = numbers
        self._wanders, self._turns, self._before = bool(wanders), bool(turns), (left, right)

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the line; return the reply to the command that they end, if any."""
        if not self.powered:
            return b""
        if not self._runs:
            self._runs = True
            self._start()
        self._line += data
        while end := LINE_END.search(self._line):
            line, self._line = self._line[: end.start()], self._line[end.end() :]
            if line:
                self._line = b""
                return self._execute(line[:LONGEST_LINE])
        self._line = self._line[:LONGEST_LINE]
        return b""

    def tick(self) -> None:
        """Let the vehicle of A decide once, for a control period (assumed; it decides as often as it can)."""
        if not self._wanders:
            return
        near, position = self._numbers(DspicRegister.PROXIMITY, 8), self._positions()
        stands = all(abs(now - then) < MOVED for now, then in zip(position, self._before, strict=True))
        self._rounds = self._rounds + 1 if stands else 0
        self._turns = near[_FRONT] > BLOCKED and (self._turns or self._rounds > PATIENCE)
        if self._turns:
            self._drive((TURNING, -TURNING))
            return
        if self._rounds > PATIENCE or not stands:
            self._rounds, self._before = 0, position
        seen = [0 if each < FARTHEST else (min(each, NEAREST) - FARTHEST) // 2 for each in near]
        orders = [
            divide(sum(map(int.__mul__, weights, seen)), GAIN_DIVISOR) + FORWARDS
            for weights in (LEFT_WEIGHTS, RIGHT_WEIGHTS)
        ]
        orders = [max(each, LEAST_SPEED) if each >= 0 else min(each, -LEAST_SPEED) for each in orders]
        self._drive(orders)

    def _execute(self, line: bytes) -> bytes:
        """Execute a command; return its reply."""
        words = [word for word in line[2:].split(b",") if word]
        values = [int(found[0]) if (found := _INTEGER.match(word)) else 0 for word in words]
        letter = line[:1].decode("latin-1")
        action = getattr(self, f"_on_{letter.lower()}", None) if "A" <= letter <= "Z" else None
        answer = None if action is None else action(values)
        if answer is None:
            return ERROR
        if isinstance(answer, bytes):
            return answer
        return ",".join([letter.lower(), *map(str, answer)]).encode() + END

    def _on_a(self, values: Sequence[int]) -> Sequence[int] | None:
        if values not in ([0], [1]):
            if self._wanders:
                self._drive((0, 0))
                self._set_control(Control.IDLE)
                self._set_profile(DEFAULT_PROFILE)
            self._wanders = False
            return () if values == [2] else None
        self._set_profile(WANDERING_PROFILE)
        self._set_control(Control.SPEED_PROFILE)
        self._wanders, self._turns, self._rounds, self._before = True, False, 0, self._positions()
        return ()

    def _on_b(self, values: Sequence[int]) -> Sequence[object]:
        revision = self._dspic.read(DspicRegister.REVISION, 1)[0]
        return chr((revision >> 4) + ord("A")), revision & 0x0F

    def _on_d(self, values: Sequence[int]) -> Sequence[int]:
        self._set_control(Control.SPEED)
        return self._write(DspicRegister.SPEED_ORDER_LEFT, _first(values, 2))

    def _on_e(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.SPEED_LEFT, 2, signed=True)

    def _on_f(self, values: Sequence[int]) -> Sequence[int]:
        self._set_control(Control.POSITION)
        return self._write(DspicRegister.POSITION_ORDER_LEFT, _first(values, 2), size=4)

    def _on_g(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.ULTRASONIC, N_ULTRASONIC)

    def _on_h(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.KP, _first(values, 3), size=1)

    def _on_i(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.RESET_ENCODERS, [0], size=1)

    def _on_j(self, values: Sequence[int]) -> Sequence[int]:
        return self._set_profile(_first(values, 5))

    def _on_k(self, values: Sequence[int]) -> Sequence[int] | None:
        if len(values) != 9:
            return None
        return self._write(DspicRegister.LEDS, [value & 0x3F for value in values], size=1)

    def _on_l(self, values: Sequence[int]) -> Sequence[int]:
        self._set_control(Control.OPEN_LOOP)
        return self._write(DspicRegister.PWM_ORDER_LEFT, _first(values, 2))

    def _on_m(self, values: Sequence[int]) -> Sequence[int]:
        self._start()
        return ()

    def _on_n(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.PROXIMITY, N_INFRARED)

    def _on_o(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.AMBIENT, N_INFRARED)

    def _on_p(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.POSITION_MARGIN, _first(values, 1))

    def _on_r(self, values: Sequence[int]) -> Sequence[int]:
        return self._positions()

    def _on_s(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.GYROSCOPE, 30, signed=True)

    def _on_t(self, values: Sequence[int]) -> Sequence[int]:
        return self._numbers(DspicRegister.ACCELEROMETER, 30, signed=True)

    def _on_u(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.ULTRASONIC_ENABLED, _first(values, 1), size=1)

    def _on_v(self, values: Sequence[int]) -> Sequence[object] | None:
        if len(values) != 1 or (kind := values[0] & 0xFFFF) > 7:
            return None
        block = self._dspic.read(DspicRegister.BATTERY, BATTERY_BYTES)
        current, average, temperature = (_signed(block[at : at + 2]) for at in (4, 6, 8))
        voltage = int.from_bytes(block[10:12], "little")
        told: Sequence[object] = (
            f"{voltage * 9.76:.0f}",
            f"{current * 0.07813:.0f}",
            f"{average * 0.07813:.0f}",
            f"{int.from_bytes(block[1:3], 'little') * 1.6:.0f}",
            f"{temperature * 0.003906:.1f}",
            block[3],
            int(self._is_charging()),
            block[0],
        )
        return [told[kind]]

    def _on_x(self, values: Sequence[int]) -> bytes:
        readings = [
            self._dspic.read(each, 2 * N_INFRARED)[1:] + b"\0"
            for each in (DspicRegister.PROXIMITY, DspicRegister.AMBIENT)
        ]
        motors = (*self._numbers(DspicRegister.SPEED_LEFT, 2, signed=True), *self._positions())
        told = b"".join([b"x", *readings, *(value.to_bytes(4, "little", signed=True) for value in motors)])
        return (told + b"\n\r").ljust(BINARY_BYTES, b"\0")

    def _on_z(self, values: Sequence[int]) -> Sequence[int]:
        self._dspic.reset()
        return ()

    def _start(self) -> None:
        """Set the motors' settings, as the program does at its start."""
        self._write(DspicRegister.POSITION_MARGIN, [MARGIN])
        self._write(DspicRegister.KP, (10, 5, 1), size=1)
        self._set_profile(DEFAULT_PROFILE)
        self._set_control(Control.IDLE)

    def _set_profile(self, profile: Sequence[int]) -> Sequence[int]:
        self._write(DspicRegister.ACCELERATION, profile[:4], size=1)
        return self._write(DspicRegister.POSITION_SPEED, profile[4:])

    def _drive(self, orders: Sequence[int]) -> None:
        """Order speeds; where the control is open loop, the library takes them for PWM."""
        is_open = self._dspic.read(DspicRegister.CONTROL, 1)[0] == Control.OPEN_LOOP
        self._write(DspicRegister.PWM_ORDER_LEFT if is_open else DspicRegister.SPEED_ORDER_LEFT, orders)

    def _set_control(self, control: Control) -> None:
        self._write(DspicRegister.CONTROL, [control], size=1)

    def _write(self, register: DspicRegister, values: Sequence[int], size: int = 2) -> Sequence[int]:
        """Write numbers of some bytes, cut off as in C; return the values of a reply without any."""
        limit = (1 << 8 * size) - 1
        self._dspic.write(bytes([register]) + b"".join((v & limit).to_bytes(size, "little") for v in values))
        return ()

    def _numbers(self, register: DspicRegister, count: int, *, signed: bool = False) -> tuple[int, ...]:
        """Return numbers of two bytes."""
        content = self._dspic.read(register, 2 * count)
        pairs = (content[at : at + 2] for at in range(0, 2 * count, 2))
        return tuple(int.from_bytes(pair, "little", signed=signed) for pair in pairs)

    def _positions(self) -> tuple[int, int]:
        content = self._dspic.read(DspicRegister.POSITION_LEFT, 8)
        return _signed(content[:4]), _signed(content[4:])


def _first(values: Sequence[int], count: int) -> list[int]:
    """Return the first values, 0 for those that are missing."""
    return [*values, *[0] * count][:count]


def _signed(content: bytes) -> int:
    return int.from_bytes(content, "little", signed=True)
