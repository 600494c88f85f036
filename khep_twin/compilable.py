"""Functions that run plain and compiled by numba, from the same source.

The decorator `compilable` returns its function unchanged. Where numba is installed, compiled code may also
call it: `simulation.compiled` registers all marked functions with numba before it compiles the first one.
They use plain arithmetic on numbers, arrays and named tuples, without objects or exceptions.
"""

from collections.abc import Callable
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

FUNCTIONS: list[Callable[..., Any]] = []
"""Functions that compiled code may call, in order of definition."""

ONCE: set[Callable[..., Any]] = set()
"""Functions of `FUNCTIONS` that are not inlined."""


def unroll(groups: Any) -> Any:
    """Return a tuple of groups of robots, for a loop over it; compiled code has the loop's body once a group.

    `simulation.compiled` replaces this function by numba's `literal_unroll`.
    """
    return groups


def compilable(function: Function) -> Function:
    """Mark a function as callable from compiled code; return it unchanged."""
    FUNCTIONS.append(function)
    return function


def compilable_once(function: Function) -> Function:
    """Mark a large function with several callers as `compilable`; it is not inlined.

    Other functions are inlined into each caller, which runs faster and takes longer to compile.
    """
    ONCE.add(function)
    return compilable(function)
