"""Announcement of compilations by numba: how long they take on this machine, and how far they are.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

from numba.core import event

from khep_twin.compilable import FUNCTIONS
from khep_twin.status_line import announced

COMPILING = "khep_twin: compiling with numba"
"""Begin of each line of an announcement."""

_ENOUGH = 0.15
"""Part of the bytecode whose compilation shows how long all of it takes, to a third or so."""

_SHORT = 2.0
"""Time of compilations that are not announced [s]."""

IMPLEMENTED: list[Callable[..., Any]] = []
"""Functions that compiled code calls in place of queries of a scene."""


class Announcer(event.Listener):
    """Announces compilations: each function's with all that it calls, or all within `together` as one.

    Code from numba's cache is not compiled.
    """

    def __init__(self) -> None:
        self._sources: dict[object, frozenset[str]] = {}
        self._expected: set[Callable[..., Any]] = set()
        self._done: set[Callable[..., Any]] = set()
        self._shown = ExitStack()
        self._begin = 0.0
        self._outer: object | None = None
        self._is_joint = self._is_shown = False

    def add(self, function: object, sources: Iterable[ModuleType]) -> None:
        """Announce the compilation of a function, of which `sources` are all that it calls."""
        self._sources[function] = frozenset(module.__name__ for module in sources)

    @contextmanager
    def together(self, functions: Iterable[object]) -> Generator[None, None, None]:
        """Announce the compilations of several functions as one."""
        self._is_joint = True
        self._expect(functions)
        try:
            yield
        finally:
            self._is_joint = False
            self._close()

    def on_start(self, event: Any) -> None:
        """Begin to count, if this is the outermost function."""
        function = event.data["dispatcher"]
        if function in self._sources and self._outer is None:
            self._outer, self._begin = function, time.monotonic()
            if not self._is_joint:
                self._expect([function])

    def on_end(self, event: Any) -> None:
        """Count a function; announce the compilation once enough of it is done to tell its time."""
        function = event.data["dispatcher"]
        self._done.add(function.py_func)
        if function is self._outer and not self._is_joint:
            self._close()
        elif self._outer is not None and not self._is_shown and self._part() >= _ENOUGH:
            self._is_shown = True
            if (seconds := self._passed() / self._part()) >= _SHORT:
                first = f"{COMPILING}, once per version: about {seconds:.0f} s"
                self._shown.enter_context(announced(first, self._progress, self._end))

    def _expect(self, functions: Iterable[object]) -> None:
        names = frozenset[str]().union(*(self._sources[each] for each in functions))
        known = {each for each in (*FUNCTIONS, *IMPLEMENTED) if each.__module__ in names}
        self._expected = known - self._done

    def _close(self) -> None:
        self._outer, self._is_shown = None, False
        self._shown.close()

    def _part(self) -> float:
        """Return how much is done, by the bytecode of the functions, which most of the time goes by."""
        return _size(self._expected & self._done) / max(_size(self._expected), 1)

    def _passed(self) -> float:
        return time.monotonic() - self._begin

    def _progress(self) -> str:
        part = self._part()
        left = max(self._passed() * (1 - part) / part, 1.0)
        return f"{COMPILING}, once per version: {100 * part:.0f} %, about {left:.0f} s to go"

    def _end(self) -> str:
        return f"{COMPILING} took {self._passed():.0f} s"


def _size(functions: Iterable[Callable[..., Any]]) -> int:
    return sum(len(function.__code__.co_code) for function in functions)


ANNOUNCER = Announcer()
"""Announces the compilations of this process."""

event.register("numba:compile", ANNOUNCER)
