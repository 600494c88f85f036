"""Standard output of the designer; the output of controllers goes to the page instead."""

import io
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

_CAPTURE: ContextVar[Callable[[str], object] | None] = ContextVar("_CAPTURE", default=None)


class _Split(io.TextIOBase):
    """Text stream that is split by thread: to a function that takes text, or to the original stream."""

    def __init__(self, before: TextIO) -> None:
        self._before = before

    def write(self, text: str, /) -> int:
        take = _CAPTURE.get()
        if take is None:
            return self._before.write(text)
        take(text)
        return len(text)

    def flush(self) -> None:
        self._before.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._before, name)  # such as its buffer of bytes


@contextmanager
def captured_by(take: Callable[[str], object]) -> Generator[None]:
    """Pass the output of this thread to a function; other threads print as before."""
    if not isinstance(sys.stdout, _Split):
        sys.stdout = _Split(sys.stdout)
    token = _CAPTURE.set(take)
    try:
        yield
    finally:
        _CAPTURE.reset(token)
