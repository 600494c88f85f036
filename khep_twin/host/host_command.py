"""Commands to a robot as values: request, parser of the reply, and whether the command may be repeated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from khep_twin.robots.framing import LINES, Frames

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True, slots=True)
class HostCommand(Generic[T_co]):
    """One command.

    Attributes:
        request: Text of the request: a line without its ending, or the hexadecimal digits of a frame.
        read: Function that parses the reply; raises ValueError with the expected form.
        repeatable: True if a repetition is harmless, as for reads, but not for moves.
    """

    request: str
    read: Callable[[str], T_co]
    repeatable: bool = False


def order(letter: str, *arguments: int | str, repeatable: bool = False) -> HostCommand[None]:
    """Return a command whose reply is only its letter."""

    def read(reply: str) -> None:
        split_reply(letter.lower(), 0, reply)

    return HostCommand(_format_request(letter, arguments), read, repeatable)


def query(
    letter: str, count: int, convert: Callable[[Sequence[int]], T], *arguments: int, repeatable: bool = True
) -> HostCommand[T]:
    """Return a command that reads `count` integers, which `convert` makes its value."""

    def read(reply: str) -> T:
        split_reply(letter.lower(), count, reply)
        return convert(LINES.values(reply))

    return HostCommand(_format_request(letter, arguments), read, repeatable)


def frame_command(
    frames: Frames, request: bytes, convert: Callable[[bytes], T], *, repeatable: bool = False
) -> HostCommand[T]:
    """Return a command that is a binary frame; `convert` makes the frame of the reply its value."""
    text = frames.decode(request)

    def read(reply: str) -> T:
        if not frames.answers(text, reply):
            raise ValueError(f"expected a frame of command {frames.command(text)}")
        return convert(bytes.fromhex(reply))

    return HostCommand(text, read, repeatable)


def _format_request(letter: str, arguments: Sequence[int | str]) -> str:
    return ",".join([letter, *map(str, arguments)])


def split_reply(letter: str, count: int, reply: str) -> list[str]:
    """Return the `count` values of a reply, which starts with a letter.

    Raises:
        ValueError: The letter or the number of values differs.
    """
    head, *values = reply.split(",")
    if head != letter or len(values) != count:
        raise ValueError(f"expected {letter!r}" + (f" and {count} values" if count else " alone"))
    return values
