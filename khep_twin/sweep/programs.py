"""Programs and measures of a study: functions sent as text, so that workers need none of their files."""

import hashlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

from khep_twin.episodes.controllers import Driver, Function
from khep_twin.errors import ControllerError, choices, in_a_line
from khep_twin.signals import is_interruption


@dataclass(frozen=True, slots=True)
class Program:
    """A function in the text of a file, defined by the worker.

    Attributes:
        text: Text of the file.
        file: Name of the file in messages.
        function: Name of the function.
        memory: Length of its memory, for a controller.
    """

    text: str
    file: str
    function: str
    memory: int


def driver_of(driver: Driver | Program) -> Driver:
    """Return a controller, defined and cached if it is a program."""
    return _compiled(driver) if isinstance(driver, Program) else driver


@lru_cache(maxsize=16)
def _compiled(program: Program) -> Driver:
    return Function(function_of(program), program.memory)


@lru_cache(maxsize=32)
def function_of(program: Program) -> Callable[..., Any]:
    """Return the Python function.

    Raises:
        ControllerError: The text fails, or has no such function.
    """
    name = f"khep_twin_study_{hashlib.sha256(program.text.encode()).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = program.file
    # numba looks up the functions that it compiles by their module.
    sys.modules[name] = module
    try:
        exec(compile(program.text, program.file, "exec"), vars(module))  # the user's own program
    except BaseException as error:
        if is_interruption(error):
            raise
        raise ControllerError(f"{program.file}: {in_a_line(error)}") from error
    found: object = vars(module).get(program.function)
    if not callable(found):
        offers = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ControllerError(f"no function {program.function!r}; {choices(program.function, offers)}")
    return found
