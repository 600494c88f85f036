"""Grammar of the serial protocol: lines, commands and replies; `firmware` executes the commands.

A command is a capital letter and decimal numbers, separated by commas, ended by CR, LF or CR LF; a tool is a
lower-case word and its arguments, separated by blanks. A reply is the command's letter in lower case and its
values, separated by commas, ended by CR LF (manual, 3.2 and appendix A).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

LINE_LIMIT = 128
"""Longest command line [bytes] (assumed; the manual gives none); longer ones are truncated."""

LINE_ENDS = b"\r\n"
"""Bytes that end a command."""

LINE_END = re.compile(rb"[\r\n]")
"""Pattern of the byte that ends a command."""

END = b"\r\n"

MOTION_COMMANDS = ("C", "D", "P")
"""Letters of the commands that move the wheels."""

SETPOINT_COMMANDS = (*MOTION_COMMANDS, "A", "F", "G", "J")
"""Letters of the commands that change setpoints, counters or gains of the motors' controllers."""

COMMAND_NOT_FOUND = b"Command not found" + END
PROTOCOL_ERROR = b"z,Protocol error" + END
TURRET_REFUSAL = b"z,Turret order not supported" + END
"""Reply to an order that a turret does not know, and to any order for a missing turret."""

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
    """A message to the turret with this number, e.g. `T,1,D,0` as (1, b"D,0")."""

    turret: int
    message: bytes


@dataclass(frozen=True, slots=True)
class Tool:
    """A word in lower case and its arguments, e.g. `run demo` as (b"run", (b"demo",))."""

    word: bytes
    arguments: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Malformed:
    """A line that cannot be executed, and the reply to it."""

    reply: bytes


Request = Command | TurretMessage | Tool | Malformed


class LineReader:
    """Splitter of a byte stream into lines, for chunks of any size.

    Empty lines are dropped, so CR LF is one ending. A line beyond the limit is truncated to one byte more.

    Args:
        limit: Longest line [bytes].

    Attributes:
        partial_line: Bytes of the incomplete line.
    """

    def __init__(self, limit: int = LINE_LIMIT) -> None:
        self._limit = limit
        self.partial_line = b""

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Add bytes; yield the lines that they complete, without their ending."""
        *lines, remainder = LINE_END.split(self.partial_line + data)
        # If `clear` is called while a line is handled, the bytes after that line are still read.
        self.partial_line = b""
        for line in filter(None, lines):
            yield line[: self._limit + 1]
        self.partial_line = remainder[: self._limit + 1]

    def clear(self) -> None:
        """Discard the incomplete line."""
        self.partial_line = b""


def parse(line: bytes, argument_counts: Mapping[str, int]) -> Request:
    """Parse a line without its ending.

    Blanks separate a tool's arguments; around a command's letter and numbers they are skipped, as the
    manual prints `D, 5, 5`.

    Args:
        line: Line to parse.
        argument_counts: Number of arguments of each command except T.
    """
    content = line.strip(_BLANKS)
    letter_field, *fields = content.split(b",")
    letter = letter_field.strip(_BLANKS).decode("latin-1")
    if len(line) > LINE_LIMIT:
        return Malformed(PROTOCOL_ERROR if letter in argument_counts or letter == "T" else COMMAND_NOT_FOUND)
    if letter == "T":
        return _parse_turret_message(fields)
    if letter in argument_counts:
        return _parse_order(letter, fields, argument_counts[letter])
    words = content.split()
    if words and _TOOL.fullmatch(words[0]):
        return Tool(words[0], tuple(words[1:]))
    return Malformed(COMMAND_NOT_FOUND)


def parse_turret_order(message: bytes, argument_counts: Mapping[str, int]) -> Command | Malformed:
    """Parse a message to a turret.

    Args:
        message: A letter and numbers, separated by commas, e.g. b"D,0".
        argument_counts: Number of arguments of each of the turret's orders.
    """
    letter_field, *fields = message.split(b",")
    letter = letter_field.strip(_BLANKS).decode("latin-1")
    if letter not in argument_counts:
        return Malformed(TURRET_REFUSAL)
    return _parse_order(letter, fields, argument_counts[letter])


def reply(letter: str, *values: int | str) -> bytes:
    """Return the reply to a command with its ending, e.g. h,12,-5 for H and the values 12, -5."""
    return (letter.lower() + ",%s" * len(values) % values).encode("ascii") + END


def turret_reply(turret: int, letter: str, *values: int | str) -> bytes:
    """Return the reply of a turret with its ending, e.g. t,1,g,255 for turret 1, G and the value 255."""
    return reply("T", turret, letter.lower(), *values)


def refusal(reason: str) -> bytes:
    """Return the reply to a valid command that cannot be executed, e.g. b"z,Protocol error"."""
    return b"z," + reason.encode("ascii") + END


def _parse_order(letter: str, fields: Sequence[bytes], count: int) -> Command | Malformed:
    """Return the command with this letter and exactly `count` numbers."""
    arguments = [_parse_number(field) for field in fields]
    numbers = tuple(number for number in arguments if number is not None)
    if len(numbers) != len(arguments) or len(numbers) != count:
        return Malformed(PROTOCOL_ERROR)
    return Command(letter, numbers)


def _parse_number(field: bytes) -> int | None:
    field = field.strip(_BLANKS)
    return int(field) if _NUMBER.fullmatch(field) else None


def _parse_turret_message(fields: list[bytes]) -> Request:
    number = _parse_number(fields[0]) if fields else None
    message = b",".join(fields[1:]).strip(_BLANKS)
    if number is None or not message:
        return Malformed(PROTOCOL_ERROR)
    return TurretMessage(number, message)
