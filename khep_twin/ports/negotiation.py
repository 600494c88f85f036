"""RFC 2217: negotiation of serial line settings within a TCP connection, between the bytes of the line.

pyserial's server class `PortManager` negotiates, with a port object that only stores the host's settings. It
expects hosts that follow the standard. Here an out-of-range value is answered with the present one. An
invalid negotiation is a fault, after which no more bytes are accepted from its host.
"""

# pyserial's types omit the negotiation.
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
"""Lowest and highest baud rate that a host may set, those of Linux's constants."""

SIGNATURE = f"khep_twin {__version__}".encode()
"""Reply to a host that asks for the signature."""

MAX_CONTENT_BYTES = 256
"""Bytes between the two ends of one negotiation; only a signature is longer than a few."""

_VALID_VALUES = {"baudrate": range(LOWEST_BAUD, HIGHEST_BAUD + 1), "bytesize": range(5, 9)}
"""Accepted values of line settings."""

_ASK_SIGNATURE, _SERVER_SIGNATURE = b"\x00", b"\x64"
"""Command that requests or sends a signature, and command of the answer; pyserial has neither."""

_MAX_SHOWN = 16

_LINE_STATES = {
    SET_CONTROL_REQ_BREAK_STATE: ("break_condition", SET_CONTROL_BREAK_ON, SET_CONTROL_BREAK_OFF),
    SET_CONTROL_REQ_DTR: ("dtr", SET_CONTROL_DTR_ON, SET_CONTROL_DTR_OFF),
    SET_CONTROL_REQ_RTS: ("rts", SET_CONTROL_RTS_ON, SET_CONTROL_RTS_OFF),
}
"""Requests of line states, which pyserial does not answer: attribute, answers for on and off."""

_INBOUND_FLOW, _NO_INBOUND_FLOW = (b"\x0d", b"\x0e", b"\x0f", b"\x10", b"\x12"), b"\x0e"
"""Values of SET-CONTROL for flow control of the host's input, and the answer: no flow control."""

_FLOW_BY_LINES = b"\x11", b"\x13"
"""Values of SET-CONTROL for flow control by DCD and by DSR; the answer is the present setting."""


class Negotiator:
    """Robot's end of an RFC 2217 connection; `answer` sends the answers of the negotiation.

    Attributes:
        fault: Message about an invalid negotiation; empty without one.
    """

    def __init__(self, baud: int, answer: Callable[[bytes], None]) -> None:
        self.fault = ""
        self._line = _Line(baud)
        self._answer = answer
        self._manager = _Manager(self._line, self)
        self._is_after_return = False

    def write(self, data: bytes) -> None:
        """Send an answer of the negotiation; called by pyserial."""
        self._answer(bytes(data))

    def settings(self) -> LineSettings:
        """Return the line settings of the host."""
        return LineSettings(self._line.baudrate, 2 if self._line.stopbits > 1 else 1)

    def decode(self, data: bytes) -> bytes:
        """Return the host's bytes without the negotiation between them, up to a fault.

        A NUL after a carriage return is dropped, as in Telnet without the option BINARY (RFC 854).
        """
        manager, output = self._manager, bytearray()
        for value in data:
            if self.fault:
                break
            try:
                for byte in manager.filter(bytes((value,))):
                    output += b"" if self._is_after_return and byte == b"\0" else byte
                    self._is_after_return = byte == b"\r"
            except (struct.error, TypeError):
                # A value is too short or missing, or an end has no start.
                self._set_fault(manager.suboption, "ff f0")
            else:
                if manager.suboption is not None and len(manager.suboption) > MAX_CONTENT_BYTES:
                    self._set_fault(manager.suboption, "without an end")
        return bytes(output)

    def encode(self, data: bytes) -> bytes:
        """Return bytes for the host, escaped for the connection."""
        return b"".join(self._manager.escape(data))

    def _set_fault(self, suboption: bytes | None, end: str) -> None:
        prefix, content = ("", b"") if suboption is None else ("ff fa ", bytes(suboption[:_MAX_SHOWN]))
        ellipsis = " ..." if suboption is not None and len(suboption) > _MAX_SHOWN else ""
        excerpt = f"{prefix}{content.hex(' ')}{ellipsis} {end}".strip()
        self.fault = (
            f"negotiation {excerpt} cannot be understood; expected ff fa 2c COMMAND VALUE ff f0 of RFC 2217, "
            f"with at most {MAX_CONTENT_BYTES} bytes inside"
        )


class _Manager(PortManager):
    """pyserial's server, with answers to invalid parities and stop bits, masks, line states and signature."""

    def _telnet_process_subnegotiation(self, suboption: bytes) -> None:
        try:
            super()._telnet_process_subnegotiation(suboption)
        except KeyError:
            # 0 requests the present value.
            super()._telnet_process_subnegotiation(suboption[:2] + b"\0")
        command = suboption[1:2]
        if suboption[:1] == COM_PORT_OPTION and command in (SET_LINESTATE_MASK, SET_MODEMSTATE_MASK):
            # Some clients wait for this answer, such as serialx.
            self.rfc2217_send_subnegotiation(RFC2217_ANSWER_MAP[command], suboption[2:3])
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _LINE_STATES:
            name, on, off = _LINE_STATES[suboption[2:3]]
            state = on if getattr(self.serial, name) else off
            self.rfc2217_send_subnegotiation(SERVER_SET_CONTROL, state)
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _INBOUND_FLOW:
            self.rfc2217_send_subnegotiation(SERVER_SET_CONTROL, _NO_INBOUND_FLOW)
        elif suboption[:1] == COM_PORT_OPTION and command == SET_CONTROL and suboption[2:3] in _FLOW_BY_LINES:
            super()._telnet_process_subnegotiation(suboption[:2] + SET_CONTROL_REQ_FLOW_SETTING)
        elif suboption == COM_PORT_OPTION + _ASK_SIGNATURE:
            # A command with text has the host's signature and needs no answer.
            self.rfc2217_send_subnegotiation(_SERVER_SIGNATURE, SIGNATURE)


class _Line:
    """Settings of a line in the form that pyserial's server expects; the robot has no modem lines.

    pyserial answers a value that raises `ValueError` with the present one.
    """

    def __init__(self, baud: int) -> None:
        self.baudrate = baud
        self.bytesize = serial.EIGHTBITS
        self.parity = serial.PARITY_NONE
        self.stopbits: float = serial.STOPBITS_TWO
        self.rtscts = self.xonxoff = self.break_condition = False
        self.rts = self.dtr = self.cts = self.dsr = self.cd = True
        self.ri = False

    def __setattr__(self, name: str, value: object) -> None:
        valid_values = _VALID_VALUES.get(name)
        if valid_values is not None and value not in valid_values:
            raise ValueError(f"{name} = {value}; expected {valid_values[0]} to {valid_values[-1]}")
        super().__setattr__(name, value)

    def reset_input_buffer(self) -> None:
        """Do nothing: there is no buffer."""

    reset_output_buffer = reset_input_buffer
