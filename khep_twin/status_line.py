"""The bottom line of a terminal, rewritten in place; whole lines of output appear above it."""

import os
import shutil
import stat
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from typing import TextIO, cast

_CLEAR = "\r\033[K"
"""Control sequence: return to the first column and erase the line."""


class StatusLine:
    """A line of text at the bottom of a terminal.

    Args:
        terminal: The terminal's stream.
    """

    def __init__(self, terminal: TextIO) -> None:
        self._terminal = terminal
        self._lock = threading.RLock()
        self._line_open = False
        self._visible = False
        self.text = ""

    def show(self, text: str) -> None:
        """Replace the text; it waits while the output above has an unfinished line."""
        with self._lock:
            self.text = text
            if not self._line_open:
                # A line that wraps could not be erased.
                width = shutil.get_terminal_size().columns - 1
                self._terminal.write(f"{_CLEAR}{text[:width]}")
                self._terminal.flush()
                self._visible = bool(text)

    def write_above(self, stream: TextIO, text: str) -> int:
        """Write output of the program to its own stream, above the status line."""
        with self._lock:
            if text and self._visible:
                self._terminal.write(_CLEAR)
                self._terminal.flush()
                self._visible = False
            written = stream.write(text)
            if text:
                stream.flush()
                self._line_open = not text.endswith(("\n", "\r"))
                if self.text and not self._line_open:
                    self.show(self.text)
            return written


class _Above:
    """A standard stream whose output appears above a status line."""

    def __init__(self, stream: TextIO, line: StatusLine) -> None:
        self._stream, self._line = stream, line

    def write(self, text: str) -> int:
        """Write above the status line."""
        return self._line.write_above(self._stream, text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


_open_lines: list[StatusLine] = []
"""Status lines in use, the innermost last."""


@contextmanager
def status_line() -> Generator[StatusLine | None, None, None]:
    """Open a status line on standard error; None where that is no terminal of this program's alone."""
    terminal = _terminal()
    if terminal is None:
        yield None
        return
    line = StatusLine(terminal)
    outputs = sys.stdout, sys.stderr
    with ExitStack() as stack:
        stack.callback(line.show, "")
        _open_lines.append(line)
        stack.callback(_open_lines.remove, line)
        for name, stream in zip(("stdout", "stderr"), outputs, strict=True):
            if stream.isatty():
                setattr(sys, name, cast(TextIO, _Above(stream, line)))
                stack.callback(setattr, sys, name, stream)
        yield line


@contextmanager
def announced(begin: str, progress: Callable[[], str], end: Callable[[], str]) -> Generator[None, None, None]:
    """Announce long work on standard error.

    Args:
        begin: Line at its begin, where that is no terminal.
        progress: Text on its progress, shown each second on a terminal.
        end: Line at its end, where that is no terminal.
    """
    terminal = _terminal()
    if terminal is None:
        _print(begin)
        yield
        _print(end())
        return
    line = _open_lines[-1] if _open_lines else StatusLine(terminal)
    before, done = line.text, threading.Event()

    def show() -> None:
        line.show(progress())
        while not done.wait(1.0):
            line.show(progress())

    counter = threading.Thread(target=show, name="status line", daemon=True)
    counter.start()
    try:
        yield
    finally:
        done.set()
        counter.join()
        line.show(before)


def _print(text: str) -> None:
    # Programs without a console have no standard streams.
    if sys.stderr is not None:  # pyright: ignore[reportUnnecessaryComparison]
        print(text, file=sys.stderr, flush=True)


def _terminal() -> TextIO | None:
    """Return the terminal at standard error, if there is one, with this program's output alone."""
    # Programs without a console have no standard streams.
    if sys.stderr is None or not sys.stderr.isatty():  # pyright: ignore[reportUnnecessaryComparison]
        return None
    # One without control sequences, such as an editor's, could not erase the line.
    if os.environ.get("TERM") == "dumb" or _is_piped():
        return None
    stream = cast("TextIO | _Above", sys.stderr)
    return stream._stream if isinstance(stream, _Above) else stream  # pyright: ignore[reportPrivateUsage]


def _is_piped() -> bool:
    """Return whether standard output goes to a program, such as `tee`, which may print on the terminal."""
    with suppress(AttributeError, OSError, ValueError):
        return stat.S_ISFIFO(os.fstat(sys.stdout.fileno()).st_mode)
    return False
