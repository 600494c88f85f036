"""Working directory of a user's programs, apart from that of the command, whose paths keep their meaning."""

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress

_changed: list[str] = []
"""Directory to which a user's program has changed; empty if it has not."""


@contextmanager
def users_folder() -> Generator[None]:
    """Run a user's program in the directory that it was in last; afterwards the one before is back."""
    before, there = _here(), _changed.copy()
    if before is None:  # nothing leads back to a directory that is gone
        yield
        return
    _changed.clear()  # what it calls here stays where it is
    for folder in there:
        os.chdir(folder)
    try:
        yield
    finally:
        after = _here()
        if after != before:
            _changed[:] = [] if after is None else [after]
            os.chdir(before)


def begin_here() -> None:
    """Let the next program of a user begin in the directory of the command."""
    _changed.clear()


def _here() -> str | None:
    with suppress(OSError):  # it may have been removed
        return os.getcwd()
    return None
