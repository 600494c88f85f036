"""kh4server, the program on the Khepera IV that answers ASCII commands on a serial line (manual, chapter 6).

    server = Kh4Server(Dspic())
    reply = server.receive(b"D,100,100" + END)

A command is a capital letter and numbers, separated by commas; the reply is the small letter and values. The
published program is reproduced to the byte (library): a reply discards all input after its command; an A
without argument 0, 1 or 2 stops the Braitenberg vehicle and is answered with an error; X sends 128 bytes, the
readings from their second byte on. Uninitialized memory of the program is 0 here: missing numbers, the last
byte of X's readings, and all bytes of X after the first 67. docs/khepera4.md lists the differences.
"""

import re
from collections.abc import Sequence

from khep_twin.robots.khepera4.channels import BINARY_BYTES, PACKET_SIZE, RING
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC, Dspic
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.khepera4.registers import BATTERY_BYTES, Control, DspicRegister
from khep_twin.robots.khepera4.vehicle import vehicle_speeds
from khep_twin.robots.line_server import VehicleServer
from khep_twin.sensing.buffers import Vector

ANSWER_NS = 2_000_000
"""Time from a command to its reply [ns]: that of some 60 bytes on the bus (assumed)."""

END = b"\r\n"
ERROR = b"$" + END
"""Reply to an unknown command, or to a wrong number of values."""

DEFAULT_PROFILE = (3, 0, 20, 1, 400)
WANDERING_PROFILE = (10, 0, 20, 1, 400)
"""Profiles of J: the default, and that of the Braitenberg vehicle."""

MARGIN = 20
"""Default position margin [pulses]."""

LONGEST_LINE = 82
"""Bytes of a command that are read; the rest of its line is discarded."""

TURN_SPEED, BLOCKED, N_STUCK, MOVED_PULSES = 120, 250, 5, 4424
"""Parameters of the vehicle besides those of `vehicle_speeds`: speed of a turn in place [pulses/10 ms]; the
front reading above which it turns in place, after so many periods in which it moved less than 30 mm
[pulses]."""

WANDERING, _TURNING, _N_STILL, _LAST_LEFT, _LAST_RIGHT = range(5)
"""Indices in the state of the vehicle: whether it drives, whether it turns in place, control periods without
motion, and position at the last motion [pulses]."""
N_VEHICLE = 5

_READS = {
    "e": (DspicRegister.SPEED_LEFT, 2, 2, True),
    "g": (DspicRegister.ULTRASONIC, N_ULTRASONIC, 2, False),
    "n": (DspicRegister.PROXIMITY, N_INFRARED, 2, False),
    "o": (DspicRegister.AMBIENT, N_INFRARED, 2, False),
    "r": (DspicRegister.POSITION_LEFT, 2, 4, True),
    "s": (DspicRegister.GYROSCOPE, 3 * PACKET_SIZE, 2, True),
    "t": (DspicRegister.ACCELEROMETER, 3 * PACKET_SIZE, 2, True),
}
"""Commands that read numbers: first register, count, bytes of each, and whether they are signed."""

_WRITES = {
    "d": (DspicRegister.SPEED_ORDER_LEFT, 2, 2, Control.SPEED),
    "f": (DspicRegister.POSITION_ORDER_LEFT, 2, 4, Control.POSITION),
    "h": (DspicRegister.KP, 3, 1, None),
    "l": (DspicRegister.PWM_ORDER_LEFT, 2, 2, Control.OPEN_LOOP),
    "p": (DspicRegister.POSITION_MARGIN, 1, 2, None),
    "u": (DspicRegister.ULTRASONIC_ENABLED, 1, 1, None),
}
"""Commands that write their values: first register, count, bytes of each, and the control type to set."""

_FRONT = 3
_INTEGER = re.compile(rb"\s*[+-]?\d+")


class Kh4Server(VehicleServer):
    """The program on its serial line; it starts with the first bytes received.

    Args:
        dspic: Microcontroller that it controls.
        vehicle: State of the vehicle (N_VEHICLE,).

    """

    answer_ns = ANSWER_NS
    program = "kh4server"

    def __init__(self, dspic: Dspic, vehicle: Vector[int] | None = None) -> None:
        self._dspic = dspic
        super().__init__(KHEPERA_4.dialect, self.execute, [0] * N_VEHICLE if vehicle is None else vehicle)

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        self._dspic.reset()
        return super().reset()

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return self._dspic.is_powered

    def receive(self, data: bytes) -> bytes:
        """Receive bytes; return the reply to the command that they complete, if any."""
        if not self.powered:
            return b""
        if not self._is_running:
            self._is_running = True
            self._set_defaults()
        messages, line = self._framing.split(self._line + data, to_robot=True)
        request = next(filter(None, messages), b"")[:LONGEST_LINE]
        self._line = b"" if request else line[:LONGEST_LINE]
        return self.execute(request) if request else b""

    def tick(self) -> None:
        """Run the vehicle of A for a control period (assumed; the program loops as fast as it can)."""
        vehicle = self._vehicle
        if not vehicle[WANDERING]:
            return
        proximity, position = self._read(DspicRegister.PROXIMITY, len(RING)), self._read(*_READS["r"])
        last_position = vehicle[_LAST_LEFT], vehicle[_LAST_RIGHT]
        is_still = all(
            abs(new - old) < MOVED_PULSES for new, old in zip(position, last_position, strict=True)
        )
        n_still = vehicle[_N_STILL] = vehicle[_N_STILL] + 1 if is_still else 0
        is_stuck = n_still > N_STUCK
        vehicle[_TURNING] = proximity[_FRONT] > BLOCKED and (vehicle[_TURNING] or is_stuck)
        if vehicle[_TURNING]:
            self._order_speeds((TURN_SPEED, -TURN_SPEED))
            return
        if is_stuck or not is_still:
            vehicle[_N_STILL] = 0
            vehicle[_LAST_LEFT], vehicle[_LAST_RIGHT] = position
        self._order_speeds(vehicle_speeds(proximity))

    def execute(self, request: bytes) -> bytes:
        """Execute a command by the tables, or by its method, `_on_a` for A; return its reply or ERROR."""
        fields = [field for field in request[2:].split(b",") if field]
        values = [int(match[0]) if (match := _INTEGER.match(field)) else 0 for field in fields]
        letter = request[:1].decode("latin-1").lower() if request[:1].isupper() else ""
        if letter in _READS:
            reply = self._read(*_READS[letter])
        elif letter in _WRITES:
            register, count, size, control = _WRITES[letter]
            self._set_control(control)
            reply = self._write(register, _pad_values(values, count), size)
        else:
            handler = getattr(self, f"_on_{letter}", None)
            reply = None if handler is None else handler(values)
        if reply is None:
            return ERROR
        return reply if isinstance(reply, bytes) else ",".join([letter, *map(str, reply)]).encode() + END

    def _on_a(self, values: Sequence[int]) -> Sequence[int] | None:
        if values not in ([0], [1]):
            if self._vehicle[WANDERING]:
                self._order_speeds((0, 0))
                self._set_control(Control.IDLE)
                self._set_profile(DEFAULT_PROFILE)
            self._vehicle[WANDERING] = 0
            return () if values == [2] else None
        self._set_profile(WANDERING_PROFILE)
        self._set_control(Control.SPEED_PROFILE)
        for index, value in enumerate((1, 0, 0, *self._read(*_READS["r"]))):
            self._vehicle[index] = value
        return ()

    def _on_b(self, values: Sequence[int]) -> Sequence[object]:
        revision = self._dspic.read(DspicRegister.REVISION, 1)[0]
        return chr((revision >> 4) + ord("A")), revision & 0x0F

    def _on_i(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.RESET_ENCODERS, [0], size=1)

    def _on_j(self, values: Sequence[int]) -> Sequence[int]:
        return self._set_profile(_pad_values(values, 5))

    def _on_k(self, values: Sequence[int]) -> Sequence[int] | None:
        if len(values) != 9:
            return None
        return self._write(DspicRegister.LEDS, [value & 0x3F for value in values], size=1)

    def _on_m(self, values: Sequence[int]) -> Sequence[int]:
        self._set_defaults()
        return ()

    def _on_v(self, values: Sequence[int]) -> Sequence[object] | None:
        """Return one value of the battery, by its kind: 0 voltage [mV] to 7 status of the gauge."""
        if len(values) != 1 or (kind := values[0] & 0xFFFF) > 7:
            return None
        block = self._dspic.read(DspicRegister.BATTERY, BATTERY_BYTES)
        signed = (int.from_bytes(block[start : start + 2], "little", signed=True) for start in (4, 6, 8))
        current, average, temperature = signed
        voltage = int.from_bytes(block[10:12], "little")
        values_by_kind: Sequence[object] = (
            f"{voltage * 9.76:.0f}",
            f"{current * 0.07813:.0f}",
            f"{average * 0.07813:.0f}",
            f"{int.from_bytes(block[1:3], 'little') * 1.6:.0f}",
            f"{temperature * 0.003906:.1f}",
            block[3],
            0,  # the charger is never plugged in
            block[0],
        )
        return [values_by_kind[kind]]

    def _on_x(self, values: Sequence[int]) -> bytes:
        readings = [
            self._dspic.read(register, 2 * N_INFRARED)[1:] + b"\0"
            for register in (DspicRegister.PROXIMITY, DspicRegister.AMBIENT)
        ]
        motors = *self._read(*_READS["e"]), *self._read(*_READS["r"])
        reply = b"".join([b"x", *readings, *(value.to_bytes(4, "little", signed=True) for value in motors)])
        return (reply + b"\n\r").ljust(BINARY_BYTES, b"\0")

    def _on_z(self, values: Sequence[int]) -> Sequence[int]:
        self._dspic.reset()
        return ()

    def _set_defaults(self) -> None:
        """Set the default settings of the motors."""
        self._write(DspicRegister.POSITION_MARGIN, [MARGIN])
        self._write(DspicRegister.KP, (10, 5, 1), size=1)
        self._set_profile(DEFAULT_PROFILE)
        self._set_control(Control.IDLE)

    def _set_profile(self, profile: Sequence[int]) -> Sequence[int]:
        self._write(DspicRegister.ACCELERATION, profile[:4], size=1)
        return self._write(DspicRegister.POSITION_SPEED, profile[4:])

    def _order_speeds(self, orders: Sequence[int]) -> None:
        """Order speeds; in open-loop control the library uses them as PWM."""
        is_open = self._dspic.read(DspicRegister.CONTROL, 1)[0] == Control.OPEN_LOOP
        self._write(DspicRegister.PWM_ORDER_LEFT if is_open else DspicRegister.SPEED_ORDER_LEFT, orders)

    def _set_control(self, control: Control | None) -> None:
        if control is not None:
            self._write(DspicRegister.CONTROL, [control], size=1)

    def _write(self, register: DspicRegister, values: Sequence[int], size: int = 2) -> Sequence[int]:
        """Write numbers of `size` bytes, truncated as in C; return the values of an empty reply."""
        mask = (1 << 8 * size) - 1
        self._dspic.write(bytes([register]) + b"".join((v & mask).to_bytes(size, "little") for v in values))
        return ()

    def _read(
        self, register: DspicRegister, count: int, size: int = 2, signed: bool = False
    ) -> tuple[int, ...]:
        """Return numbers of `size` bytes."""
        content = self._dspic.read(register, size * count)
        numbers = (content[offset : offset + size] for offset in range(0, size * count, size))
        return tuple(int.from_bytes(number, "little", signed=signed) for number in numbers)


def _pad_values(values: Sequence[int], count: int) -> list[int]:
    """Return the first `count` values, 0 for missing ones."""
    return [*values, *[0] * count][:count]
