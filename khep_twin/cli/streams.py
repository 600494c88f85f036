"""The command line's standard streams: an error of a stream does not end a run or its log.

A stream that cannot be written is reported once, in one line, and then discards its output; the command
continues, and its exit code reports the failure. If the reader of a pipe closes it, as `head`
does, no line is printed and the exit code is 141.
The module also checks the limit of open file descriptors.
"""

import codecs
import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import Any

from khep_twin.process.machine import open_files_limit

MIN_OPEN_FILES = 64
"""Smallest limit of open files. A run has 8 open, `serve` 13, the page 11 without a browser (measured); the
rest is for hosts, browsers and a controller's files."""


class GuardedOutput(io.FileIO):
    """Output of descriptor 1 or 2 as bytes; `error` is the error that ended it, or None."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write data, or discard it after an error."""
        if self.error is None:
            try:
                while (count := super().write(data)) is None:  # non-blocking, by an earlier program
                    select.select([], [self], [])
                return count
            except OSError as error:
                self.error = error
                if self.fileno() == 1 and error.errno != errno.EPIPE:
                    reason = "it is closed" if error.errno == errno.EBADF else error.strerror
                    print(f"khep-twin: standard output: cannot be written: {reason}", file=sys.stderr)
        return memoryview(data).nbytes


class UnclosableStream(io.TextIOWrapper):
    """Standard stream that stays open when a controller closes it."""

    def close(self) -> None:
        """Flush the stream."""
        self.flush()


_SIGPIPE = 13
"""Number of the signal for a pipe without a reader, also on systems without signals."""

_outputs: list[GuardedOutput] = []
_text_streams: list[UnclosableStream] = []


def guard_streams() -> None:
    """Replace the standard streams by guarded ones."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            # Otherwise the next opened file, such as a log, would get the closed stream's descriptor.
            # This one is read-only, so output is reported when it is written.
            os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)
    if sys.stdin is None:  # pyright: ignore[reportUnnecessaryComparison]
        sys.stdin = open(0, closefd=False)
    sys.stdout, sys.stderr = _guard_stream(1, sys.stdout), _guard_stream(2, sys.stderr)


def check_descriptors() -> None:
    """End the process with one line if its limit of open files is too low."""
    if (limit := open_files_limit(MIN_OPEN_FILES)) < MIN_OPEN_FILES:
        message = f"{limit} files may be open at once; expected {MIN_OPEN_FILES} or more, see ulimit -n"
        print(f"khep-twin: {message}", file=sys.stderr)
        sys.exit(1)


def has_no_reader() -> bool:
    """Return whether standard output has lost its reader."""
    return any(raw.fileno() == 1 and raw.error and raw.error.errno == errno.EPIPE for raw in _outputs)


def exit_code(code: int) -> int:
    """Return a command's exit code, or that of a failure if a stream could not be written."""
    for stream in _text_streams:
        stream.flush()
    for stream in (sys.stdout, sys.stderr):
        # A program may have replaced, closed or deleted them.
        with suppress(AttributeError, ValueError, OSError):
            stream.flush()
    errors = [output.error for output in _outputs if output.error is not None]
    if code or not errors:
        return code
    return 128 + _SIGPIPE if all(error.errno == errno.EPIPE for error in errors) else 1


def _escape_error(error: UnicodeError) -> tuple[str | bytes, int]:
    """Encode undecodable bytes of a file name as the original bytes, and other characters as escapes."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.backslashreplace_errors(error)


_ERROR_HANDLER = "khep_twin_as_named"
codecs.register_error(_ERROR_HANDLER, _escape_error)


def _guard_stream(descriptor: int, stream: io.TextIOWrapper | Any) -> UnclosableStream:
    """Return a guarded stream for a descriptor, with the settings of the present one."""
    raw = GuardedOutput(descriptor)
    _outputs.append(raw)
    guarded = UnclosableStream(
        io.BufferedWriter(raw),
        encoding=getattr(stream, "encoding", "utf-8"),
        errors=_ERROR_HANDLER,
        line_buffering=getattr(stream, "line_buffering", True),
        write_through=getattr(stream, "write_through", False),
    )
    _text_streams.append(guarded)
    return guarded
