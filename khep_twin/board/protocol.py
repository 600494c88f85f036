"""The grammar of the serial protocol: lines, commands and replies. What they do is `firmware`'s affair.

A command is a capital letter and decimal numbers, parted by commas, ended by CR, LF or CR LF; a tool is a
lower-case word and its arguments, parted by blanks. A reply is the command's letter in lower case and its
values, parted by commas, ended by CR LF (manual, 3.2 and appendix A).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

LINE_LIMIT = 128
"""Longest command line [bytes] (assumed; the manual gives none). The rest of a longer one is dropped."""

LINE_ENDS = b"\r\n"
"""Each of these bytes ends a command."""

END = b"\r\n"
COMMAND_NOT_FOUND = b"Command not found" + END
PROTOCOL_ERROR = b"z,Protocol error" + END
TURRET_REFUSAL = b"z,Turret order not supported" + END
"""Of an order that a turret does not know, and of a turret that is not there."""

ARGUMENT_COUNTS: dict[str, int] = {
    "A": 3,
    "B": 0,
    "C": 2,
    "D": 2,
    "E": 0,
    "F": 3,
    "G": 2,
    "H": 0,
    "I": 1,
    "J": 4,
    "K": 0,
    "L": 2,
    "N": 0,
    "O": 0,
    "P": 2,
    "R": 1,
    "W": 2,
}
"""Numbers that each command takes. The eighteenth command, T, passes its arguments on to a turret."""

_NUMBER = re.compile(rb"[+-]?[0-9]{1,10}")
_TOOL = re.compile(rb"[a-z][a-z-]*")
_BLANKS = b" \t"


@dataclass(frozen=True, slots=True)
class Command:
    """A well-formed command, e.g. `D,5,-5` as ("D", (5, -5))."""

    letter: str
    arguments: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class TurretMessage:
    """A message for the turret with this number, e.g. `T,1,D,0` as (1, b"D,0")."""

    turret: int
    message: bytes


@dataclass(frozen=True, slots=True)
class Tool:
    """A word in lower case and what follows it, e.g. `run demo` as (b"run", (b"demo",))."""

    word: bytes
    arguments: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Malformed:
    """A line that cannot be carried out, and the reply that it gets."""

    reply: bytes


Request = Command | TurretMessage | Tool | Malformed


class LineReader:
    """Cuts a stream of bytes into lines, whatever the chunks it comes in.

    Empty lines vanish, so CR LF is one ending. Of a line beyond LINE_LIMIT only the beginning is kept,
    marked as too long.
    """

    def __init__(self) -> None:
        self._line = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Takes more bytes; gives the lines that they complete, without their ending."""
        for byte in data:
            if byte in LINE_ENDS:
                if self._line:
                    line = bytes(self._line)
                    self._line.clear()
                    yield line
            elif len(self._line) <= LINE_LIMIT:
                self._line.append(byte)

    def clear(self) -> None:
        """Forgets the line begun."""
        self._line.clear()


def parse(line: bytes) -> Request:
    """What a line, without its ending, asks for.

    Blanks count only within tools: around a command's letter and numbers they are passed over, as the
    manual itself prints `D, 5, 5`.
    """
    text = line.strip(_BLANKS)
    head, *rest = text.split(b",")
    letter = head.strip(_BLANKS).decode("latin-1")
    if len(line) > LINE_LIMIT:
        return Malformed(PROTOCOL_ERROR if letter in ARGUMENT_COUNTS or letter == "T" else COMMAND_NOT_FOUND)
    if letter == "T":
        return _parse_turret_message(rest)
    if letter in ARGUMENT_COUNTS:
        return _parse_order(letter, rest, ARGUMENT_COUNTS[letter])
    words = text.split()
    if words and _TOOL.fullmatch(words[0]):
        return Tool(words[0], tuple(words[1:]))
    return Malformed(COMMAND_NOT_FOUND)


def parse_turret_order(message: bytes, argument_counts: Mapping[str, int]) -> Command | Malformed:
    """What the message to a turret asks for.

    Args:
        message: a letter and numbers, parted by commas, e.g. b"D,0".
        argument_counts: numbers that each of the turret's orders takes.
    """
    head, *rest = message.split(b",")
    letter = head.strip(_BLANKS).decode("latin-1")
    if letter not in argument_counts:
        return Malformed(TURRET_REFUSAL)
    return _parse_order(letter, rest, argument_counts[letter])


def reply(letter: str, *values: int | str) -> bytes:
    """The reply to a command with its ending, e.g. h,12,-5 for H and the values 12, -5."""
    return ",".join([letter.lower(), *map(str, values)]).encode("ascii") + END


def turret_reply(turret: int, letter: str, *values: int | str) -> bytes:
    """The reply of a turret with its ending, e.g. t,1,g,255 for turret 1, G and the value 255."""
    return reply("T", turret, letter.lower(), *values)


def refusal(text: str) -> bytes:
    """The reply to a command that is understood and cannot be carried out, e.g. b"z,Protocol error"."""
    return b"z," + text.encode("ascii") + END


def _parse_order(letter: str, fields: Sequence[bytes], count: int) -> Command | Malformed:
    """A letter and its numbers, of which there must be `count`."""
    arguments = [_parse_number(field) for field in fields]
    numbers = tuple(number for number in arguments if number is not None)
    if len(numbers) != len(arguments) or len(numbers) != count:
        return Malformed(PROTOCOL_ERROR)
    return Command(letter, numbers)


def _parse_number(field: bytes) -> int | None:
    field = field.strip(_BLANKS)
    return int(field) if _NUMBER.fullmatch(field) else None


def _parse_turret_message(rest: list[bytes]) -> Request:
    number = _parse_number(rest[0]) if rest else None
    message = b",".join(rest[1:]).strip(_BLANKS)
    if number is None or not message:
        return Malformed(PROTOCOL_ERROR)
    return TurretMessage(number, message)
