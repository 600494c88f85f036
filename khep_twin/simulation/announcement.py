"""Announcement of compilations by numba: their duration on this machine, and their progress.

Imported only where numba is installed.
"""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

from numba.core import event

from khep_twin.compilable import FUNCTIONS
from khep_twin.process.status_line import announced

COMPILING = "khep_twin: compiling with numba"
"""Start of each line of an announcement."""

_MIN_SHARE = 0.15
"""Part of the bytecode after which the total duration is estimated, to about a third."""

_MIN_DURATION_S = 2.0
"""Shortest duration that is announced [s]."""

IMPLEMENTATIONS: list[Callable[..., Any]] = []
"""Functions that implement queries to a scene in compiled code."""


class Announcer(event.Listener):
    """Announces the compilation of each function with its callees, or of all functions of a `group` together.

    Code from numba's cache is not compiled.
    """

    def __init__(self) -> None:
        self._sources: dict[object, frozenset[str]] = {}
        self._expected: set[Callable[..., Any]] = set()
        self._compiled: set[Callable[..., Any]] = set()
        self._status_lines = ExitStack()
        self._start_s = self._start_cpu_s = 0.0
        self._outermost: object | None = None
        self._is_grouped = self._is_shown = False

    def add(self, function: object, sources: Iterable[ModuleType]) -> None:
        """Announce the compilation of a function that calls functions of these modules."""
        self._sources[function] = frozenset(module.__name__ for module in sources)

    @contextmanager
    def group(self, functions: Iterable[object]) -> Generator[None, None, None]:
        """Announce the compilations of several functions together."""
        self._is_grouped = True
        self._set_expected(functions)
        try:
            yield
        finally:
            self._is_grouped = False
            self._close()

    def on_start(self, event: Any) -> None:
        """Start the announcement if this is the outermost function."""
        function = event.data["dispatcher"]
        if function in self._sources and self._outermost is None:
            self._outermost = function
            self._start_s, self._start_cpu_s = time.monotonic(), time.thread_time()
            if not self._is_grouped:
                self._set_expected([function])

    def on_end(self, event: Any) -> None:
        """Count a function; announce the compilation once its duration can be estimated."""
        function = event.data["dispatcher"]
        self._compiled.add(function.py_func)
        if function is self._outermost and not self._is_grouped:
            self._close()
        elif self._outermost is not None and not self._is_shown and self._compiled_fraction() >= _MIN_SHARE:
            self._is_shown = True
            # The first functions show the processor time; other programs may slow down the rest.
            cpu_s = (time.thread_time() - self._start_cpu_s) / self._compiled_fraction()
            if cpu_s >= _MIN_DURATION_S:
                text = f"{COMPILING}, once per version: about {cpu_s:.0f} s of processor time"
                self._status_lines.enter_context(announced(text, self._progress_text, self._end_text))

    def _set_expected(self, roots: Iterable[object]) -> None:
        modules = frozenset[str]().union(*(self._sources[function] for function in roots))
        functions = {
            function for function in (*FUNCTIONS, *IMPLEMENTATIONS) if function.__module__ in modules
        }
        self._expected = functions - self._compiled

    def _close(self) -> None:
        self._outermost = None
        self._is_shown = False
        self._status_lines.close()

    def _compiled_fraction(self) -> float:
        """Return the compiled fraction of the bytecode, to which the duration is roughly proportional."""
        return _bytecode_size(self._expected & self._compiled) / max(_bytecode_size(self._expected), 1)

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._start_s

    def _progress_text(self) -> str:
        fraction = self._compiled_fraction()
        remaining_s = max(self._elapsed_s() * (1 - fraction) / fraction, 1.0)
        return f"{COMPILING}, once per version: {100 * fraction:.0f} %, about {remaining_s:.0f} s to go"

    def _end_text(self) -> str:
        return f"{COMPILING} took {self._elapsed_s():.0f} s"


def _bytecode_size(functions: Iterable[Callable[..., Any]]) -> int:
    return sum(len(function.__code__.co_code) for function in functions)


ANNOUNCER = Announcer()
"""Announces the compilations of this process."""

event.register("numba:compile", ANNOUNCER)
