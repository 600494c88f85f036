"""Mutants: deliberately broken builds, each of which an invariant must catch."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple
from unittest.mock import patch

Broken = Callable[[], AbstractContextManager[object]]
"""Function that returns a context in which the product is broken."""


class Mutant(NamedTuple):
    """A broken build.

    Attributes:
        scenario: Name of the scenario that shows it.
        invariant: Name of the invariant that it violates.
        broken: Function that returns a context in which the product is broken.
        seconds: Simulated time of each seed that looks for it [s]; more for a fault that shows late in a run.
    """

    scenario: str
    invariant: str
    broken: Broken
    seconds: float = 200.0


def replaced(owner: Any, **functions: Any) -> Broken:
    """Return a break that puts other functions, or values, in the place of some of a class or module."""
    return lambda: patch.multiple(owner, **functions)


def nothing(*_: object) -> None:
    """Do nothing, in the place of another function."""
