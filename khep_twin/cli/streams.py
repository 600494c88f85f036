"""The command line's standard streams: an error of one does not end a run or its log.

A stream that cannot be written is reported once, in a line, and takes no more; the command goes on, and its
exit code says it. A reader that has gone, as `head` does, is not reported, as the reader wanted that.
Also here: the number of descriptors that there may be.
"""

import codecs
import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import Any

from khep_twin.machine import open_files_limit

LEAST_OPEN = 64
"""Number of files that have to be allowed open at once. A run has 8 open, `serve` 13, the page 11 without a
browser (measured); the rest is room for hosts, browsers and files of a controller's own."""


class GuardedOutput(io.FileIO):
    """Output of descriptor 1 or 2 as bytes; `trouble` is why nothing can be written any more, or None."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self.trouble: OSError | None = None

    def write(self, data: Any) -> int:
        """Write, or drop what is not taken."""
        if self.trouble is None:
            try:
                while (done := super().write(data)) is None:  # as a program before this one has left it
                    select.select([], [self], [])
                return done
            except OSError as error:
                self.trouble = error
                if self.fileno() == 1 and error.errno != errno.EPIPE:
                    reason = "it is closed" if error.errno == errno.EBADF else error.strerror
                    print(f"khep-twin: standard output: cannot be written: {reason}", file=sys.stderr)
        return memoryview(data).nbytes


class UnclosableStream(io.TextIOWrapper):
    """A standard stream that stays open when a controller closes it."""

    def close(self) -> None:
        """Write what is left."""
        self.flush()


_SIGPIPE = 13
"""Number of the signal that a program without a reader gets, also where there are none."""

_streams: list[GuardedOutput] = []
_guards: list[UnclosableStream] = []


def guard_streams() -> None:
    """Replace the standard streams by guarded ones."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            # Else the next file that is opened, such as a log, would be taken for the stream that is closed.
            # Output is not writable so, and is reported when it is written.
            os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)
    if sys.stdin is None:  # pyright: ignore[reportUnnecessaryComparison]
        sys.stdin = open(0, closefd=False)
    sys.stdout, sys.stderr = _guarded(1, sys.stdout), _guarded(2, sys.stderr)


def check_descriptors() -> None:
    """End the process with one line if too few files may be open at once."""
    if (most := open_files_limit(LEAST_OPEN)) < LEAST_OPEN:
        told = f"{most} files may be open at once; expected {LEAST_OPEN} or more, see ulimit -n"
        print(f"khep-twin: {told}", file=sys.stderr)
        sys.exit(1)


def has_no_reader() -> bool:
    """Return whether standard output has no reader any more."""
    return any(each.fileno() == 1 and each.trouble and each.trouble.errno == errno.EPIPE for each in _streams)


def exit_code(code: int) -> int:
    """Return a command's exit code; failure if a stream could not be written."""
    for stream in _guards:
        stream.flush()
    for stream in (sys.stdout, sys.stderr):
        # A program may have replaced, closed or deleted them.
        with suppress(AttributeError, ValueError, OSError):
            stream.flush()
    troubles = [each.trouble for each in _streams if each.trouble is not None]
    if code or not troubles:
        return code
    return 128 + _SIGPIPE if all(each.errno == errno.EPIPE for each in troubles) else 1


def _as_named(error: UnicodeError) -> tuple[str | bytes, int]:
    """Write the bytes of a name that is no text, as the system has them, and anything else as its code."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.backslashreplace_errors(error)


_AS_NAMED = "khep_twin_as_named"
codecs.register_error(_AS_NAMED, _as_named)


def _guarded(descriptor: int, stream: io.TextIOWrapper | Any) -> UnclosableStream:
    raw = GuardedOutput(descriptor)
    _streams.append(raw)
    guarded = UnclosableStream(
        io.BufferedWriter(raw),
        encoding=getattr(stream, "encoding", "utf-8"),
        errors=_AS_NAMED,
        line_buffering=getattr(stream, "line_buffering", True),
        write_through=getattr(stream, "write_through", False),
    )
    _guards.append(guarded)
    return guarded
