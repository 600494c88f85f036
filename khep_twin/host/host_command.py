"""Commands to a robot as values: request, reply and whether the command may be sent twice."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

_INTEGER = re.compile("-?[0-9]{1,10}")
"""Numbers in replies: of 32 bits at most."""


@dataclass(frozen=True, slots=True)
class HostCommand(Generic[T_co]):
    """One command.

    Attributes:
        request: Line to send, without its ending.
        read: Function from the reply to its value; raises ValueError with what is expected.
        repeatable: True if it does no harm twice, as a read; a move does harm.
    """

    request: str
    read: Callable[[str], T_co]
    repeatable: bool = False


def order(letter: str, *arguments: int, repeatable: bool = False) -> HostCommand[None]:
    """Return a command whose reply is its letter alone."""

    def read(reply: str) -> None:
        fields(letter.lower(), 0, reply)

    return HostCommand(_request(letter, arguments), read, repeatable)


def numbers(
    letter: str, count: int, make: Callable[[Sequence[int]], T], *arguments: int, repeatable: bool = True
) -> HostCommand[T]:
    """Return a command whose reply is its letter and so many integers."""

    def read(reply: str) -> T:
        words = fields(letter.lower(), count, reply)
        if not all(map(_INTEGER.fullmatch, words)):
            raise ValueError("expected integers")
        return make([int(word) for word in words])

    return HostCommand(_request(letter, arguments), read, repeatable)


def _request(letter: str, arguments: Sequence[int]) -> str:
    return ",".join([letter, *map(str, arguments)])


def fields(letter: str, count: int, reply: str) -> list[str]:
    """Return the values of a reply.

    Raises:
        ValueError: It has another letter, or another number of values.
    """
    head, *words = reply.split(",")
    if head != letter or len(words) != count:
        values = f" and {count} values" if count else " alone"
        raise ValueError(f"expected {letter!r}{values}")
    return words
