"""Working directory of a user's programs, separate from the command's, so that relative paths stay valid."""

import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Params = ParamSpec("Params")
ReturnType = TypeVar("ReturnType")

_user_folder: list[str] = []
"""Directory to which a user's program changed; empty if it did not."""


def in_users_folder(
    program: Callable[Params, ReturnType], /, *args: Params.args, **kwargs: Params.kwargs
) -> ReturnType:
    """Call a user's program in the directory of its last call, then restore the command's directory."""
    if not (command_folder := _current_folder()):  # a removed directory cannot be restored
        return program(*args, **kwargs)
    if _user_folder:
        os.chdir(_user_folder.pop())  # nested calls stay in this directory
    try:
        return program(*args, **kwargs)
    finally:
        if (user_folder := _current_folder()) != command_folder:
            _user_folder[:] = [user_folder] if user_folder else []
            os.chdir(command_folder)


def reset_users_folder() -> None:
    """Let the next program of a user start in the directory of the command."""
    _user_folder.clear()


def _current_folder() -> str:
    """Return the working directory; empty if it has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""
