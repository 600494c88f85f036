"""Working directory of a user's programs, apart from that of the command, whose paths keep their meaning."""

import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Returned = TypeVar("Returned")

_changed: list[str] = []
"""Directory to which a user's program has changed; empty if it has not."""


def in_users_folder(
    program: Callable[Given, Returned], /, *given: Given.args, **named: Given.kwargs
) -> Returned:
    """Call a user's program in the directory that it was in last; afterwards the one before is back."""
    if not (before := _here()):  # nothing leads back to a directory that is gone
        return program(*given, **named)
    if _changed:
        os.chdir(_changed.pop())  # what it calls here stays where it is
    try:
        return program(*given, **named)
    finally:
        if (after := _here()) != before:
            _changed[:] = [after] if after else []
            os.chdir(before)


def begin_here() -> None:
    """Let the next program of a user begin in the directory of the command."""
    _changed.clear()


def _here() -> str:
    """Return the working directory; empty if it has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""
