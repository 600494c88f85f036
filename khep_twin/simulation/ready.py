"""Compiled code when it is ready: numba compiles in a background process, while the run continues."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from khep_twin.errors import MissingNumbaError
from khep_twin.process.machine import lock, lower_priority
from khep_twin.robots.registry import default_model, installed_families

CODE = {
    "world": "khep_twin.simulation.compiled:advance_of",
    "episodes": "khep_twin.episodes.compiled:run_of",
    "plane": "khep_twin.episodes.planar.compiled:run_of",
    "vision": "khep_twin.vision.compiled:capture",
    "shadow": "khep_twin.shadow.compiled:run_of",
}
"""Parts of khep_twin that can be compiled, and their functions; of the shadow's, one of several."""

ROBOT_PARTS = "world", "episodes", "plane", "shadow"
"""Parts of each family of robots, by default of the default one; see `part_of`."""

BACKGROUND_NOTICE = (
    "khep_twin: numba compiles in the background, once per version; this run goes on uncompiled meanwhile, "
    "with the same results"
)
"""Announcement of a compilation in the background."""

NO_CACHE_REASON = (
    "numba can keep no code: neither the package's folder nor your cache folder can be written; expected one "
    "that can be in NUMBA_CACHE_DIR"
)
"""Reason and remedy if compiled code cannot be cached."""

_PROCESSES: dict[str, "subprocess.Popen[bytes] | None"] = {}
"""Processes that compile a part; None after a failure."""


def when_ready(part: str) -> Callable[..., Any] | None:
    """Return the compiled function of a part of `CODE`; None if it is not compiled yet, or without numba.

    If the code is not in numba's cache, the first call starts a low-priority process that compiles it, and
    announces it on standard error. That process may outlive this one.
    """
    try:
        function: Any = function_of(part)
    except MissingNumbaError:
        return None
    if is_cached(function):
        return function
    if not can_cache(function):  # neither for this process nor for the next
        _print_once(f"khep_twin: this run stays uncompiled, with the same results, as {NO_CACHE_REASON}")
        return None
    if part not in _PROCESSES:
        print(BACKGROUND_NOTICE, file=sys.stderr, flush=True)
        process = _PROCESSES[part] = subprocess.Popen(
            [sys.executable, "-m", "khep_twin", "compile", part],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        lower_priority(process.pid)
    elif (process := _PROCESSES[part]) is not None and process.poll():
        _PROCESSES[part] = None
        print(
            "khep_twin: the compilation failed, and the run stays uncompiled; to see why: "
            f"{sys.executable} -m khep_twin compile {part}",
            file=sys.stderr,
            flush=True,
        )
    return None


@contextmanager
def compile_lock(part: str) -> Generator[None]:
    """Hold the lock for the compilation of a part of `CODE`, so that only one process compiles it.

    Other processes wait, and then find the code in numba's cache. The lock of a killed process is released.
    """
    function: Any = function_of(part)
    with ExitStack() as stack:
        if (folder := function.stats.cache_path) is not None:
            with suppress(OSError):  # a file system without locks: each process compiles
                lock(stack.enter_context(Path(folder, f"compile-{part}.lock").open("ab")), waits=True)
        yield


def part_of(kind: str, models: Sequence[str]) -> str:
    """Return the part of `ROBOT_PARTS` for robots of these families, in the order of a world's groups."""
    return kind if [*models] == [default_model().family] else ".".join((kind, *models))


def is_part(name: str) -> bool:
    """Return whether a name is that of a part, also for robots of installed families."""
    kind, *families = name.split(".")
    is_single = kind == "world" or len(families) == 1
    return name in CODE or (
        kind in ROBOT_PARTS and bool(families) and is_single and {*families} <= {*installed_families()}
    )


def function_of(part: str) -> Callable[..., Any]:
    """Return the function of a part, compiled at its first call; errors as for `module_of`."""
    kind, *models = part.split(".")
    function: Any = getattr(module_of(kind), CODE[kind].partition(":")[2])
    return function(*(models or [default_model().family])) if kind in ROBOT_PARTS else function


def module_of(part: str) -> ModuleType:
    """Return the module of a part.

    Raises:
        MissingNumbaError: numba is not installed, or disabled.
    """
    if (missing := find_missing_numba()) is not None:
        raise missing
    try:
        return import_module(CODE[part].partition(":")[0])
    except ImportError as error:
        raise MissingNumbaError() from error


def find_missing_numba() -> MissingNumbaError | None:
    """Return the reason why nothing can be compiled here; None if numba is usable."""
    if importlib.util.find_spec("numba") is None:
        return MissingNumbaError()
    numba: Any = import_module("numba")
    return MissingNumbaError(is_off=True) if numba.config.DISABLE_JIT else None


def functions_of(part: str) -> list[Callable[..., Any]]:
    """Return all compiled functions of a part; errors as for `module_of`."""
    kind, module = part.partition(".")[0], module_of(part.partition(".")[0])
    functions = [function_of(part)] if kind in ROBOT_PARTS else []
    for value in vars(module).values():
        if hasattr(value, "py_func") and value.__module__ == module.__name__:
            functions.append(value)
    return functions


def can_cache(function: Any) -> bool:
    """Return whether numba has a folder for a function's compiled code."""
    return function.stats.cache_path is not None


def is_cached(function: Any) -> bool:
    """Return whether a function is compiled, in this process or in numba's cache."""
    if function.signatures:
        return True
    if not can_cache(function):
        return False
    # numba names the files of a function's code by its name, which contains a digest of the sources.
    files = Path(function.stats.cache_path).glob(f"*{function.py_func.__qualname__}*.nbc")
    return next(files, None) is not None


@cache
def _print_once(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
