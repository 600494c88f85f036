"""Output of programs: captured for each thread, and sent to the page in batches."""

import io
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, TextIO

from khep_twin.web.messages import Publish

_PRINT_LIMIT = 20_000
"""Longest text of one message [characters]."""

_WRITE: ContextVar[Callable[[str], object] | None] = ContextVar("_WRITE", default=None)
"""Function that takes this thread's output; None to print it."""


class PrintBuffer:
    """Buffer of a program's output for the page; of a longer text it keeps the end."""

    def __init__(self, publish: Publish, kind: Literal["printed", "score-printed"]) -> None:
        self._publish = publish
        self._text = ""
        self._kind: Literal["printed", "score-printed"] = kind

    def add(self, text: str) -> None:
        """Append text."""
        self._text = (self._text + text)[-_PRINT_LIMIT:]

    def flush(self) -> None:
        """Send the text to the page."""
        text, self._text = self._text, ""
        if text:
            self._publish({"kind": self._kind, "text": text})


@contextmanager
def captured_by(write: Callable[[str], object]) -> Generator[None]:
    """Pass the output of this thread to a function; other threads print as before."""
    if not isinstance(sys.stdout, _ThreadOutput):
        sys.stdout = _ThreadOutput(sys.stdout)
    token = _WRITE.set(write)
    try:
        yield
    finally:
        _WRITE.reset(token)


class _ThreadOutput(io.TextIOBase):
    """Text stream that writes to the function of the current thread, or else to the original stream."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str, /) -> int:
        write = _WRITE.get()
        if write is None:
            return self._stream.write(text)
        write(text)
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)  # for example its binary buffer
