"""Framing of the messages on a robot's line: lines of text, or binary frames.

A message has a text, in which programs, transcripts and error messages show it: that of its line, or the
hexadecimal digits of its frame.
"""

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from khep_twin.board.protocol import LINE_END, LINE_ENDS

if TYPE_CHECKING:
    from serial import Serial
_NOISE = "noise"

_INTEGER = re.compile("-?[0-9]{1,10}")
"""Numbers in messages: of 32 bits at most."""


class Lines(NamedTuple):
    """Messages that are lines of text: requests end in CR, LF or both, replies in CR LF.

    Attributes:
        resync: Bytes that end an unfinished request.
        number: Form of a number; its last group, if it has one, is the integer.
        has_reversed_ends: True if replies may also end in LF CR.
    """

    resync: bytes = b"\n"
    number: re.Pattern[str] = _INTEGER
    has_reversed_ends: bool = False

    def length(self, data: bytes | bytearray, to_robot: bool) -> int:
        """Return the length of the first message; more than that of `data` if it is incomplete."""
        end = LINE_END.search(data)
        return len(data) + 1 if end is None else end.end()

    def split(self, data: bytes, to_robot: bool) -> tuple[list[bytes], bytes]:
        """Return the messages without their ends, and the part of an incomplete one."""
        lines = data.splitlines()
        rest = b"" if data[-1:] in LINE_ENDS else lines.pop()
        return [line for line in lines if line or not self.has_reversed_ends], rest

    def is_message(self, data: bytes, to_robot: bool = False) -> bool:
        """Return whether bytes are a complete message, and no noise."""
        return to_robot or data.endswith((b"\n", b"\n\r"))

    def flaw(self, reply: bytes) -> str:
        """Return the expected form of a malformed reply; empty for another one."""
        ends = (b"\r\n", b"\n\r") if self.has_reversed_ends else (b"\r\n",)
        if not reply.endswith(ends) or b"\r" in reply[:-2]:
            return "expected one line that ends in CR LF"
        return "" if reply.isascii() else "expected plain ASCII"

    def read(self, port: "Serial", clock: Callable[[], float]) -> bytes:
        """Read a reply, or the part of it that arrives within the port's timeout."""
        reply = port.read_until(b"\n", None)
        if not self.has_reversed_ends:
            return reply
        # Another reader of the port may have left the CR after the LF of the last reply.
        reply = reply.removeprefix(b"\r")
        return reply + port.read(1) if reply.endswith(b"\n") and not reply.endswith(b"\r\n") else reply

    def encode(self, text: str) -> bytes:
        """Return the request with a text; raise ValueError for another text."""
        if not text.isascii() or "\n" in text or "\r" in text:
            raise ValueError(f"request {text!r}; expected one line of ASCII, without its ending")
        return text.encode("ascii") + b"\n"

    def decode(self, message: bytes) -> str:
        """Return the text of a message, with or without its end."""
        return message.decode("latin-1").strip("\r\n")

    def command(self, text: str) -> str:
        """Return the command of a message by its text: a letter, or a tool's word."""
        return text.strip().split(",")[0].split(" ")[0][:12]

    def has_one_reply(self, request: str) -> bool:
        """Return whether a request has exactly one reply, by its text: a tool prints any number of lines."""
        return not request.lstrip()[:1].islower()

    def answers(self, request: str, reply: str) -> bool:
        """Return whether a reply is one to a request, by their texts: it has its letter in lower case."""
        return reply.partition(",")[0] == self.command(request).lower()

    def values(self, text: str) -> Sequence[int]:
        """Return the numbers in a message by its text; raise ValueError for others."""
        _, *values = text.split(",")
        numbers = [number[number.lastindex or 0] for number in map(self.number.fullmatch, values) if number]
        if len(numbers) < len(values):
            raise ValueError("expected integers")
        return [int(number) for number in numbers]


class Frames(NamedTuple):
    """Messages that are binary frames, whose bytes tell their length.

    Attributes:
        frame_length: Function that returns the length of the frame at the start of one byte or more: larger
            than their number while it is incomplete, 0 for noise, e.g. after a wrong checksum. Its second
            argument is whether it is a request.
        frame_command: Function that returns a frame's command, the same for a request and its reply.
        resync: Bytes that end an unfinished request: as many as the longest one has.
        frame_values: Function that returns the numbers in a frame.
    """

    frame_length: Callable[[bytes, bool], int]
    frame_command: Callable[[bytes], int]
    resync: bytes
    frame_values: Callable[[bytes], Sequence[int]] = tuple

    def length(self, data: bytes | bytearray, to_robot: bool) -> int:
        """Return the length of noise, or of the first frame; more than that of `data` if it is incomplete."""
        n_noise, size = self._measure(bytes(data), to_robot)
        return n_noise or size

    def split(self, data: bytes, to_robot: bool) -> tuple[list[bytes], bytes]:
        """Return the frames, noise between them, and the part of an incomplete frame."""
        messages: list[bytes] = []
        while (size := self.length(data, to_robot)) <= len(data):
            messages.append(data[:size])
            data = data[size:]
        return messages, data

    def is_message(self, data: bytes, to_robot: bool = False) -> bool:
        """Return whether bytes are a complete frame, and no noise."""
        return bool(data) and self.frame_length(data, to_robot) == len(data)

    def flaw(self, reply: bytes) -> str:
        """Return the expected form of a malformed reply; empty for another one."""
        return "" if self.is_message(reply) else "expected a complete frame"

    def read(self, port: "Serial", clock: Callable[[], float]) -> bytes:
        """Read a reply, without noise before it, or the part that arrives within the port's timeout."""
        data, start = b"", clock()
        while True:
            n_noise, size = self._measure(data, False)
            data = data[n_noise:]
            is_late = port.timeout is not None and clock() - start > port.timeout
            if len(data) == size or is_late or not (chunk := port.read(size - len(data))):
                return data
            data += chunk

    def encode(self, text: str) -> bytes:
        """Return the request with a text; raise ValueError for another text."""
        if not self.is_message(frame := _bytes(text), True):
            raise ValueError(f"request {text!r}; expected the hexadecimal digits of one frame")
        return frame

    def decode(self, message: bytes) -> str:
        """Return the text of a frame or of noise, in upper case."""
        return message.hex().upper()

    def command(self, text: str) -> str:
        """Return the command of a message by its text; "noise" for other bytes."""
        data = _bytes(text)
        is_frame = self.is_message(data, True) or self.is_message(data)
        return f"{self.frame_command(data):02X}" if is_frame else _NOISE

    def has_one_reply(self, request: str) -> bool:
        """Return whether a request has exactly one reply, by its text: noise has none."""
        return self.command(request) != _NOISE

    def answers(self, request: str, reply: str) -> bool:
        """Return whether a reply is one to a request, by their texts: it has the same command."""
        return self.command(reply) == self.command(request) != _NOISE

    def values(self, text: str) -> Sequence[int]:
        """Return the numbers in a message by its text."""
        return self.frame_values(_bytes(text))

    def _measure(self, data: bytes, to_robot: bool) -> tuple[int, int]:
        """Return the length of the noise at the start, and that of the frame after it, at least 1."""
        for start in range(len(data)):
            if size := self.frame_length(data[start:], to_robot):
                return start, size
        return len(data), 1


def _bytes(text: str) -> bytes:
    """Return the bytes of hexadecimal digits; none for another text."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        return b""


Framing = Lines | Frames

LINES = Lines()
