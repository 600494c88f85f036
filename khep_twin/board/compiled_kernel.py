"""Compilation by numba, from the same source that runs without it, and many times as fast.

numba is the extra `batch`; everything else works without it.
"""

# numba is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

import inspect
import sys
from collections.abc import Mapping
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from types import ModuleType
from typing import Any

from khep_twin.board import kernel
from khep_twin.errors import MissingExtraError


@cache
def compiled_kernel() -> ModuleType:
    """Return the compiled `kernel`, the board's arithmetic; its registers are int64 arrays.

    Raises:
        MissingExtraError: numba is not installed.
    """
    return compiled_copy(kernel)


def compiled_copy(
    module: ModuleType,
    others: Mapping[str, ModuleType] | None = None,
    name: str = "compiled",
    *,
    inlined: bool = False,
) -> ModuleType:
    """Return a second copy of a module whose own functions are compiled, each when it is first called.

    Args:
        module: Module whose source numba can compile.
        others: Compiled modules that the copy uses instead of its own, by the names in the module.
        name: Name that distinguishes this copy from others of the same module.
        inlined: True to inline functions into their callers, for long chains of calls with many arguments,
            and to leave out numba's reference counts of arrays, which can take half of the time. Sources must
            then neither make nor return arrays, and avoid a division by 0, which raises nothing.

    Raises:
        MissingExtraError: numba is not installed.
    """
    try:
        from numba import njit
    except ImportError as error:
        raise MissingExtraError("numba", "batch") from error
    copy = another_copy(module, others, name)
    options: dict[str, Any] = {}
    if inlined:
        options = {"_nrt": False, "forceinline": True, "error_model": "numpy"}
    # A compiled function looks up the others, compiled too, by their names in the copy.
    for own, function in inspect.getmembers(copy, inspect.isfunction):
        if function.__module__ == copy.__name__:
            setattr(copy, own, njit(**options)(function))
    return copy


def another_copy(module: ModuleType, others: Mapping[str, ModuleType] | None, name: str) -> ModuleType:
    """Return an uncompiled second copy of a module that uses other modules; see `compiled_copy`."""
    loader = SourceFileLoader(f"{module.__name__}#{name}", str(module.__file__))
    spec = spec_from_loader(loader.name, loader)
    if spec is None:
        raise ImportError(f"cannot load {module.__file__}")
    copy = module_from_spec(spec)
    # Code that numba has cached in another process looks up its module by name.
    sys.modules[loader.name] = copy
    loader.exec_module(copy)
    for used, other in (others or {}).items():
        setattr(copy, used, other)
    return copy
