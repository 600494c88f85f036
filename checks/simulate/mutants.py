"""Mutants: deliberately broken builds, each of which an invariant must catch."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple


class Mutant(NamedTuple):
    """A broken build.

    Attributes:
        scenario: Name of the scenario that shows it.
        invariant: Name of the invariant that it violates.
        broken: Function that returns a context in which the product is broken.
        seconds: Simulated time of each seed that looks for it [s]; more for what shows late in a run.
    """

    scenario: str
    invariant: str
    broken: Callable[[], AbstractContextManager[object]]
    seconds: float = 200.0
