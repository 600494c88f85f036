"""The bottom line of a terminal, rewritten in place; whole lines of output appear above it."""

import os
import shutil
import stat
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from typing import TextIO, cast

STATUS_LINE_VARIABLE = "_KHEP_TWIN_BESIDE_A_STATUS_LINE"
"""Variable of the environment of a process on whose terminal another one shows a status line."""

_CLEAR = "\r\033[K"
"""Control sequence: return to the first column and erase the line."""


class StatusLine:
    """A line of text at the bottom of a terminal.

    Args:
        terminal: The terminal's stream.
    """

    def __init__(self, terminal: TextIO) -> None:
        self._find_terminal = terminal
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
                self._find_terminal.write(f"{_CLEAR}{text[:width]}")
                self._find_terminal.flush()
                self._visible = bool(text)

    def write_above(self, stream: TextIO, text: str) -> int:
        """Write output of the program to its stream, above the status line."""
        with self._lock:
            if text and self._visible:
                self._find_terminal.write(_CLEAR)
                self._find_terminal.flush()
                self._visible = False
            written = stream.write(text)
            if text:
                stream.flush()
                self._line_open = not text.endswith(("\n", "\r"))
                if self.text and not self._line_open:
                    self.show(self.text)
            return written


class _SharedStream:
    """A standard stream that shares its terminal with a status line."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


class _StreamAbove(_SharedStream):
    """A standard stream whose output appears above a status line."""

    def __init__(self, stream: TextIO, line: StatusLine) -> None:
        super().__init__(stream)
        self._line = line

    def write(self, text: str) -> int:
        """Write above the status line."""
        return self._line.write_above(self._stream, text)


class _StreamInPlace(_SharedStream):
    """A standard stream that takes whole lines, the first of each write in the place of a status line."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._partial_line = ""

    def write(self, text: str) -> int:
        """Write complete lines in one call: another process may show its status line at any time."""
        lines, end, self._partial_line = (self._partial_line + text).rpartition("\n")
        if end:
            self._stream.write(f"{_CLEAR}{lines}{end}")
            self._stream.flush()
        return len(text)


_open_lines: list[StatusLine] = []
"""Status lines in use, the innermost last."""


@contextmanager
def status_line() -> Generator[StatusLine | None, None, None]:
    """Open a status line on standard error; yield None unless that is a terminal with this program alone."""
    terminal = _find_terminal()
    if terminal is None:
        yield None
        return
    line = StatusLine(terminal)
    with ExitStack() as stack:
        stack.callback(line.show, "")
        _open_lines.append(line)
        stack.callback(_open_lines.remove, line)
        stack.enter_context(_replace_streams(lambda stream: _StreamAbove(stream, line)))
        yield line


@contextmanager
def beside_status_line() -> Generator[None, None, None]:
    """Print lines in the place of the status line that another process shows on the same terminal.

    That process shows its line again, below them. An incomplete line waits for its end.
    """
    with nullcontext() if _find_terminal() is None else _replace_streams(_StreamInPlace):
        yield


@contextmanager
def _replace_streams(make_stream: Callable[[TextIO], _SharedStream]) -> Generator[None, None, None]:
    """Replace the standard streams that are terminals."""
    outputs = {"stdout": sys.stdout, "stderr": sys.stderr}
    with ExitStack() as stack:
        for name, stream in outputs.items():
            if stream.isatty():
                setattr(sys, name, cast(TextIO, make_stream(stream)))
                stack.callback(setattr, sys, name, stream)
        yield


@contextmanager
def announced(begin: str, progress: Callable[[], str], end: Callable[[], str]) -> Generator[None, None, None]:
    """Announce long work on standard error.

    Args:
        begin: Line at the start, if standard error is not a terminal.
        progress: Function that returns a text on the progress, shown each second on a terminal.
        end: Function that returns the line at the end, if standard error is not a terminal.
    """
    has_open_line = _open_lines and _find_terminal() is not None
    with nullcontext(_open_lines[-1]) if has_open_line else status_line() as line:
        if line is None:
            _print(begin)
            yield
            _print(end())
        else:
            with _show_each_second(line, progress):
                yield


@contextmanager
def _show_each_second(line: StatusLine, progress: Callable[[], str]) -> Generator[None, None, None]:
    """Show a text on a status line, renewed each second; then restore the previous text."""
    previous_text = line.text
    finished = threading.Event()

    def show() -> None:
        line.show(progress())
        while not finished.wait(1.0):
            line.show(progress())

    thread = threading.Thread(target=show, name="status line", daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
        line.show(previous_text)


def _print(text: str) -> None:
    # Programs without a console have no standard streams.
    if sys.stderr is not None:  # pyright: ignore[reportUnnecessaryComparison]
        print(text, file=sys.stderr, flush=True)


def _find_terminal() -> TextIO | None:
    """Return the terminal at standard error, if there is one, with this program's output alone."""
    # Programs without a console have no standard streams.
    if sys.stderr is None or not sys.stderr.isatty():  # pyright: ignore[reportUnnecessaryComparison]
        return None
    # One without control sequences, such as an editor's, could not erase the line.
    if os.environ.get("TERM") == "dumb" or _is_piped():
        return None
    stream = cast("TextIO | _SharedStream", sys.stderr)
    return stream._stream if isinstance(stream, _SharedStream) else stream  # pyright: ignore[reportPrivateUsage]


def _is_piped() -> bool:
    """Return whether standard output goes to a program (for example `tee`) that may print on the terminal."""
    with suppress(AttributeError, OSError, ValueError):
        mode = os.fstat(sys.stdout.fileno()).st_mode
        return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)  # shells make a pipe of either
    return False
