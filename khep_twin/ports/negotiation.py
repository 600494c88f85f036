"""RFC 2217: the settings of a serial line, sent between the bytes that go over it.

The negotiation is pyserial's own server half, over a port object that only remembers what the host has set.
That half expects hosts which follow the standard. Here the answer to an out-of-range value is the present
one, and an invalid negotiation is a fault, after which nothing is accepted from its host.
"""

# pyserial's types leave out what it does with a negotiation.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false, reportArgumentType=false

import struct
from collections.abc import Callable

import serial
from serial.rfc2217 import (
    COM_PORT_OPTION,
    RFC2217_ANSWER_MAP,
    SERVER_SET_CONTROL,
    SET_CONTROL,
    SET_CONTROL_BREAK_OFF,
    SET_CONTROL_BREAK_ON,
    SET_CONTROL_DTR_OFF,
    SET_CONTROL_DTR_ON,
    SET_CONTROL_REQ_BREAK_STATE,
    SET_CONTROL_REQ_DTR,
    SET_CONTROL_REQ_FLOW_SETTING,
    SET_CONTROL_REQ_RTS,
    SET_CONTROL_RTS_OFF,
    SET_CONTROL_RTS_ON,
    SET_LINESTATE_MASK,
    SET_MODEMSTATE_MASK,
    PortManager,
)

from khep_twin import __version__
from khep_twin.board.uart import LineSettings

LOWEST_BAUD, HIGHEST_BAUD = 50, 4_000_000
"""Speeds that a host may set, those of Linux's constants [baud]."""

SIGNATURE = f"khep_twin {__version__}".encode()
"""Reply to a host that asks for the signature."""

LONGEST = 256
"""Bytes between the two ends of one negotiation; only a signature is longer than a few."""

_WANTED = {"baudrate": range(LOWEST_BAUD, HIGHEST_BAUD + 1), "bytesize": range(5, 9)}
"""Values of a line's settings that are accepted."""

_ASK_SIGNATURE, _SERVER_SIGNATURE = b"\x00", b"\x64"
"""Command that asks for a signature or tells one, and that of the answer; pyserial has neither."""

_SHOWN = 16


class Negotiator:
    """The robot's end of an RFC 2217 connection; `answer` takes the answers of the negotiation.

    Attributes:
        fault: Negotiation that could not be understood and what was expected; empty while there was none.
    """

    def __init__(self, baud: int, answer: Callable[[bytes], None]) -> None:
        self.fault = ""
        self._line = _Line(baud)
        self._answer = answer
        self._manager = _Manager(self._line, self)
        self._ended = False

    def write(self, data: bytes) -> None:
        """Send an answer of the negotiation; called by pyserial."""
        self._answer(bytes(data))

    def settings(self) -> LineSettings:
        """Return what the host has set."""
        return LineSettings(self._line.baudrate, 2 if self._line.stopbits > 1 else 1)

    def received(self, data: bytes) -> bytes:
        """Return the host's bytes without the negotiation in between, up to a fault.

        A NUL behind a carriage return belongs to it, as in Telnet without BINARY (RFC 854).
        """
        manager, taken = self._manager, bytearray()
        for value in data:
            if self.fault:
                break
            try:
                for byte in manager.filter(bytes((value,))):
                    taken += b"" if self._ended and byte == b"\0" else byte
                    self._ended = byte == b"\r"
            except (struct.error, TypeError):
                # A value that is too short or missing, or an end without a beginning.
                self._find_fault(manager.suboption, "ff f0")
            else:
                if manager.suboption is not None and len(manager.suboption) > LONGEST:
                    self._find_fault(manager.suboption, "without an end")
        return bytes(taken)

    def escaped(self, data: bytes) -> bytes:
        """Return bytes for the host as they must go over the connection."""
        return b"".join(self._manager.escape(data))

    def _find_fault(self, suboption: bytes | None, end: str) -> None:
        begin, inside = ("", b"") if suboption is None else ("ff fa ", bytes(suboption[:_SHOWN]))
        more = " ..." if suboption is not None and len(suboption) > _SHOWN else ""
        shown = f"{begin}{inside.hex(' ')}{more} {end}".strip()
        self.fault = (
            f"negotiation {shown} cannot be understood; expected ff fa 2c COMMAND VALUE ff f0 of RFC 2217, "
            f"with at most {LONGEST} bytes inside"
        )


class _Manager(PortManager):
    """pyserial's server half; by itself it does not answer invalid parities and stop bits, and masks."""

    def _telnet_process_subnegotiation(self, suboption: bytes) -> None:
        try:
            super()._telnet_process_subnegotiation(suboption)
        except KeyError:
            # 0 asks for the present ones.
            super()._telnet_process_subnegotiation(suboption[:2] + b"\0")
        command = suboption[1:2]
        if suboption[:1] == COM_PORT_OPTION and command in (SET_LINESTATE_MASK, SET_MODEMSTATE_MASK):
            # Clients wait for it, such as serialx.
            self.rfc2217_send_subnegotiation(RFC2217_ANSWER_MAP[command], suboption[2:3])
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _STATES:
            name, on, off = _STATES[suboption[2:3]]
            state = on if getattr(self.serial, name) else off
            self.rfc2217_send_subnegotiation(SERVER_SET_CONTROL, state)
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _INBOUND:
            self.rfc2217_send_subnegotiation(SERVER_SET_CONTROL, _NO_INBOUND)
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _BY_LINES:
            super()._telnet_process_subnegotiation(suboption[:2] + SET_CONTROL_REQ_FLOW_SETTING)
        elif suboption == COM_PORT_OPTION + _ASK_SIGNATURE:
            # With a text it is the host's own, which needs no answer.
            self.rfc2217_send_subnegotiation(_SERVER_SIGNATURE, SIGNATURE)


_STATES = {
    SET_CONTROL_REQ_BREAK_STATE: ("break_condition", SET_CONTROL_BREAK_ON, SET_CONTROL_BREAK_OFF),
    SET_CONTROL_REQ_DTR: ("dtr", SET_CONTROL_DTR_ON, SET_CONTROL_DTR_OFF),
    SET_CONTROL_REQ_RTS: ("rts", SET_CONTROL_RTS_ON, SET_CONTROL_RTS_OFF),
}
"""Questions about states of the line, which pyserial does not answer: state, answers for on and off."""

_INBOUND, _NO_INBOUND = (b"\x0d", b"\x0e", b"\x0f", b"\x10", b"\x12"), b"\x0e"
"""Values of SET-CONTROL for flow control of what the host receives; there is none of it, the second."""

_BY_LINES = b"\x11", b"\x13"
"""Values of SET-CONTROL for flow control by DCD and by DSR: the answer is what is in force."""


class _Line:
    """Settings of a line as pyserial's server expects them; the robot has no modem lines.

    pyserial answers a value that is refused by `ValueError` with the present one.
    """

    def __init__(self, baud: int) -> None:
        self.baudrate, self.bytesize = baud, serial.EIGHTBITS
        self.parity = serial.PARITY_NONE
        self.stopbits: float = serial.STOPBITS_TWO
        self.rtscts = self.xonxoff = self.break_condition = False
        self.rts = self.dtr = self.cts = self.dsr = self.cd = True
        self.ri = False

    def __setattr__(self, name: str, value: object) -> None:
        wanted = _WANTED.get(name)
        if wanted is not None and value not in wanted:
            raise ValueError(f"{name} = {value}; expected {wanted[0]} to {wanted[-1]}")
        super().__setattr__(name, value)

    def reset_input_buffer(self) -> None:
        """Do nothing: neither input nor output waits here."""

    reset_output_buffer = reset_input_buffer
