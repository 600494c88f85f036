"""Functions that run plain and compiled by numba, from the same source.

A function marked by `compilable` stays what it is. Where numba is installed, compiled code may call it, too:
`simulation.compiled` registers all of them with numba before it compiles the first one. They use plain
arithmetic on numbers, arrays and named tuples: no objects, no exceptions.
"""

from collections.abc import Callable
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

FUNCTIONS: list[Callable[..., Any]] = []
"""Functions that compiled code may call, in the order of their definition."""

ONCE: set[Callable[..., Any]] = set()
"""Those of `FUNCTIONS` that do not become part of their callers."""


def compilable(function: Function) -> Function:
    """Mark a function as callable from compiled code; return it unchanged."""
    FUNCTIONS.append(function)
    return function


def compilable_once(function: Function) -> Function:
    """Mark a large function with several callers as `compilable`; compiled code has it only once.

    Others become part of each of their callers, which is faster to run, and takes longer to compile.
    """
    ONCE.add(function)
    return compilable(function)
