r"""kh4server, the program on the Khepera IV that answers ASCII commands on a serial line (manual, chapter 6).

    server = Kh4Server(Dspic())
    reply = server.receive(b"D,100,100\r\n")

A command is a capital letter and numbers, separated by commas; the reply is the small letter and values. The
published program is reproduced to the byte (library): a reply discards all input after its command; an A
without argument 0, 1 or 2 stops the Braitenberg vehicle and is answered with an error; X sends 128 bytes, the
readings from their second byte on. Uninitialized memory of the program is 0 here: missing numbers, the last
byte of X's readings, and all bytes of X after the first 67. docs/khepera4.md lists the differences.
"""

import re
import struct
from collections.abc import Sequence

from khep_twin.robots.khepera4 import registers
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC, Dspic
from khep_twin.robots.khepera4.model import KHEPERA_4, VEHICLE
from khep_twin.robots.khepera4.registers import BINARY_BYTES, PACKET_SIZE, Control, DspicRegister
from khep_twin.robots.line_server import Command, Reply, VehicleServer
from khep_twin.robots.vehicle import N_VEHICLE, WANDERING
from khep_twin.sensing.buffers import Vector

_DEFAULT_PROFILE, _WANDERING_PROFILE = (3, 0, 20, 1, 400), (10, 0, 20, 1, 400)
"""Profiles of J: the default, and that of the Braitenberg vehicle."""

_READS = {
    "E": (DspicRegister.SPEED_LEFT, "<2h"),
    "G": (DspicRegister.ULTRASONIC, f"<{N_ULTRASONIC}H"),
    "N": (DspicRegister.PROXIMITY, f"<{N_INFRARED}H"),
    "O": (DspicRegister.AMBIENT, f"<{N_INFRARED}H"),
    "R": (DspicRegister.POSITION_LEFT, "<2i"),
    "S": (DspicRegister.GYROSCOPE, f"<{3 * PACKET_SIZE}h"),
    "T": (DspicRegister.ACCELEROMETER, f"<{3 * PACKET_SIZE}h"),
}
"""Commands that read numbers: first register, and layout."""

_WRITES = {
    "D": (DspicRegister.SPEED_ORDER_LEFT, 2, 2, Control.SPEED),
    "F": (DspicRegister.POSITION_ORDER_LEFT, 2, 4, Control.POSITION),
    "H": (DspicRegister.KP, 3, 1, None),
    "L": (DspicRegister.PWM_ORDER_LEFT, 2, 2, Control.OPEN_LOOP),
    "P": (DspicRegister.POSITION_MARGIN, 1, 2, None),
    "U": (DspicRegister.ULTRASONIC_ENABLED, 1, 1, None),
}
"""Commands that write their values: first register, count, bytes of each, and the control type to set."""

_INTEGER = re.compile(rb"\s*[+-]?\d+")


class Kh4Server(VehicleServer):
    """The program on its serial line; it starts with the first bytes received.

    Args:
        dspic: Microcontroller that it controls.
        vehicle: State of the vehicle (N_VEHICLE,).
    """

    answer_ns = 2_000_000  # some 60 bytes on the bus (assumed)
    program = "kh4server"

    def __init__(self, dspic: Dspic, vehicle: Vector[int] | None = None) -> None:
        self._dspic = dspic
        state = [0] * N_VEHICLE if vehicle is None else vehicle
        super().__init__(KHEPERA_4.dialect, VEHICLE, state, lambda: dspic.is_powered)

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        self._dspic.reset()
        return super().reset()

    def _parse(self, request: bytes) -> Command | None:
        fields = [field for field in request[2:].split(b",") if field]
        values = [int(match[0]) if (match := _INTEGER.match(field)) else 0 for field in fields]
        return (request[:1].decode(), values) if request[:1].isupper() else None

    def _run(self, letter: str, values: Sequence[int]) -> Reply:
        if letter in _READS:
            return self._read(letter)
        if letter not in _WRITES:
            return super()._run(letter, values)
        register, count, size, control = _WRITES[letter]
        if control is not None:
            self._set_control(control)
        # Missing numbers are 0.
        return self._write(register, (*values, *bytes(count))[:count], size)

    def _on_a(self, values: Sequence[int]) -> Reply:
        if values not in ([0], [1]):
            if self._state[WANDERING]:
                self._order_speeds((0, 0))
                self._set_control(Control.IDLE)
                self._set_profile(_DEFAULT_PROFILE)
            self._state[WANDERING] = 0
            return () if values == [2] else None
        self._set_profile(_WANDERING_PROFILE)
        self._set_control(Control.SPEED_PROFILE)
        return self._start_vehicle(1, self._read("R"))

    def _on_b(self, values: Sequence[int]) -> Sequence[object]:
        revision = self._dspic.read(DspicRegister.REVISION, 1)[0]
        return chr((revision >> 4) + ord("A")), revision & 0x0F

    def _on_i(self, values: Sequence[int]) -> Sequence[int]:
        return self._write(DspicRegister.RESET_ENCODERS, [0], size=1)

    def _on_j(self, values: Sequence[int]) -> Sequence[int]:
        return self._set_profile((*values, *bytes(5))[:5])

    def _on_k(self, values: Sequence[int]) -> Reply:
        if len(values) != 9:
            return None
        return self._write(DspicRegister.LEDS, [value & 0x3F for value in values], size=1)

    def _on_m(self, values: Sequence[int]) -> Reply:
        self._write(DspicRegister.POSITION_MARGIN, [20])
        self._write(DspicRegister.KP, (10, 5, 1), size=1)
        self._set_profile(_DEFAULT_PROFILE)
        return self._set_control(Control.IDLE)

    def _on_v(self, values: Sequence[int]) -> Reply:
        """Return one value of the battery, by its kind: 0 voltage [mV] to 7 status of the gauge."""
        if len(values) != 1 or (kind := values[0] & 0xFFFF) > 7:
            return None
        block = struct.unpack("<BHBhhhH", self._dspic.read(DspicRegister.BATTERY, registers.BATTERY_BYTES))
        status, charge, percent, current, average_current, temperature, voltage = block
        values_by_kind: Sequence[object] = (
            f"{voltage * 9.76:.0f}",
            f"{current * 0.07813:.0f}",
            f"{average_current * 0.07813:.0f}",
            f"{charge * 1.6:.0f}",
            f"{temperature * 0.003906:.1f}",
            percent,
            0,  # the charger is never plugged in
            status,
        )
        return [values_by_kind[kind]]

    def _on_x(self, values: Sequence[int]) -> bytes:
        registers = DspicRegister.PROXIMITY, DspicRegister.AMBIENT
        readings = (self._dspic.read(register, 2 * N_INFRARED)[1:] + b"\0" for register in registers)
        motors = struct.pack("<4i", *self._read("E"), *self._read("R"))
        return b"".join([b"x", *readings, motors, b"\n\r"]).ljust(BINARY_BYTES, b"\0")

    def _on_z(self, values: Sequence[int]) -> Sequence[int]:
        self._dspic.reset()
        return ()

    def _set_profile(self, profile: Sequence[int]) -> Sequence[int]:
        self._write(DspicRegister.ACCELERATION, profile[:4], size=1)
        return self._write(DspicRegister.POSITION_SPEED, profile[4:])

    def _order_speeds(self, speeds: tuple[int, int]) -> None:
        """Order speeds; in open-loop control the library uses them as PWM."""
        is_open = self._dspic.read(DspicRegister.CONTROL, 1)[0] == Control.OPEN_LOOP
        self._write(DspicRegister.PWM_ORDER_LEFT if is_open else DspicRegister.SPEED_ORDER_LEFT, speeds)

    def _set_control(self, control: Control) -> Sequence[int]:
        return self._write(DspicRegister.CONTROL, [control], size=1)

    def _write(self, register: DspicRegister, values: Sequence[int], size: int = 2) -> Sequence[int]:
        """Write numbers of `size` bytes, truncated as in C; return the values of an empty reply."""
        mask = (1 << 8 * size) - 1
        self._dspic.write(bytes([register]) + b"".join((v & mask).to_bytes(size, "little") for v in values))
        return ()

    def _read(self, letter: str) -> tuple[int, ...]:
        register, layout = _READS[letter]
        return struct.unpack(layout, self._dspic.read(register, struct.calcsize(layout)))
