"""Compiled code, when it is ready: numba compiles in a process beside the run, which goes on meanwhile."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from khep_twin.errors import MissingNumbaError
from khep_twin.machine import lock, lower_priority

CODE = {
    "world": "khep_twin.simulation.compiled:advance",
    "episodes": "khep_twin.episodes.compiled:run",
    "plane": "khep_twin.episodes.planar.compiled:run",
    "vision": "khep_twin.vision.compiled:see",
    "shadow": "khep_twin.shadow.compiled:advance",
}
"""Parts that are compiled, and their functions; that of the shadow is one of several."""

BESIDE = (
    "khep_twin: numba compiles in the background, once per version; this run goes on uncompiled meanwhile, "
    "with the same results"
)
"""Announcement of a compilation beside a run."""

NOT_KEPT = (
    "numba can keep no code: neither the package's folder nor your cache folder can be written; expected one "
    "that can be in NUMBA_CACHE_DIR"
)
"""Reason and remedy where compiled code is lost with its process."""

_PROCESSES: dict[str, "subprocess.Popen[bytes] | None"] = {}
"""Processes that compile a part; None once one has failed."""


def when_ready(part: str) -> Callable[..., Any] | None:
    """Return the compiled function of a part; None while it is not compiled yet, or without numba.

    The first call for code that is not in numba's cache starts a process of low priority that compiles it,
    and announces it on standard error. It may outlive this one.

    Args:
        part: Key of `CODE`.
    """
    try:
        function: Any = function_of(part)
    except MissingNumbaError:
        return None
    if is_cached(function):
        return function
    if not can_be_kept(function):  # neither for this process nor for the next
        _tell_once(f"khep_twin: this run stays uncompiled, with the same results, as {NOT_KEPT}")
        return None
    if part not in _PROCESSES:
        print(BESIDE, file=sys.stderr, flush=True)
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
def alone(part: str) -> Generator[None]:
    """Wait while another process compiles a part, and keep others waiting meanwhile.

    They find the code in numba's cache then; of a process that is killed the next one takes over.

    Args:
        part: Key of `CODE`.
    """
    function: Any = function_of(part)
    with ExitStack() as stack:
        if (folder := function.stats.cache_path) is not None:
            with suppress(OSError):  # a file system without locks: each compiles
                lock(stack.enter_context(Path(folder, f"compile-{part}.lock").open("ab")), waits=True)
        yield


def function_of(part: str) -> Callable[..., Any]:
    """Return the function of a part, which is compiled when it is first called; errors are `module_of`'s."""
    return getattr(module_of(part), CODE[part].partition(":")[2])


def module_of(part: str) -> ModuleType:
    """Return the module of a part.

    Raises:
        MissingNumbaError: numba is not installed, or switched off.
    """
    if (missing := what_is_missing()) is not None:
        raise missing
    try:
        return import_module(CODE[part].partition(":")[0])
    except ImportError as error:
        raise MissingNumbaError() from error


def what_is_missing() -> MissingNumbaError | None:
    """Return why nothing can be compiled here; None if it can."""
    if importlib.util.find_spec("numba") is None:
        return MissingNumbaError()
    numba: Any = import_module("numba")
    return MissingNumbaError(is_off=True) if numba.config.DISABLE_JIT else None


def functions_of(part: str) -> list[Callable[..., Any]]:
    """Return all compiled functions of a part; errors are those of `module_of`."""
    module = module_of(part)
    own = (each for each in vars(module).values() if getattr(each, "__module__", "") == module.__name__)
    return [each for each in own if hasattr(each, "py_func")]


def can_be_kept(function: Any) -> bool:
    """Return whether numba has a folder for a function's compiled code."""
    return function.stats.cache_path is not None


def is_cached(function: Any) -> bool:
    """Return whether a function is compiled, in this process or in numba's cache."""
    if function.signatures:
        return True
    if not can_be_kept(function):
        return False
    # numba names the files of a function's code by its name, which has a stamp of the sources.
    files = Path(function.stats.cache_path).glob(f"*{function.py_func.__qualname__}*.nbc")
    return next(files, None) is not None


@cache
def _tell_once(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
