"""Arithmetic compiled by numba, from the source that runs without it, and many times as fast.

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
    """The board's arithmetic, `kernel`, compiled; its registers are int64 arrays.

    Raises:
        MissingExtraError: numba is not installed.
    """
    return compiled_copy(kernel)


def compiled_copy(
    module: ModuleType,
    others: Mapping[str, ModuleType] | None = None,
    name: str = "compiled",
    *,
    counted: bool = True,
    within: bool = False,
) -> ModuleType:
    """A second copy of a module whose own functions are compiled, each when it is first called.

    Args:
        module: whose source numba can compile.
        others: modules, by the names that it uses them by, which its copy is to use instead, compiled too.
        name: that tells this copy from others of the same module.
        counted: whether numba counts who has which array. Code that neither makes nor returns any needs no
            such counting, which can take half of the time.
        within: whether functions become parts of what calls them, for long chains of calls with many
            arguments; a division by 0 then raises nothing, and sources must not come to one.

    Raises:
        MissingExtraError: numba is not installed.
    """
    try:
        from numba import njit
    except ImportError as error:
        raise MissingExtraError("numba", "batch") from error
    copy = another_copy(module, others, name)
    options: dict[str, Any] = {} if counted else {"_nrt": False}
    if within:
        options |= {"forceinline": True, "error_model": "numpy"}
    # A compiled function finds the others by their names in the copy, compiled too.
    for own, function in inspect.getmembers(copy, inspect.isfunction):
        if function.__module__ == copy.__name__:
            setattr(copy, own, njit(**options)(function))
    return copy


def another_copy(module: ModuleType, others: Mapping[str, ModuleType] | None, name: str) -> ModuleType:
    """A second copy of a module that uses other modules, as it stands; arguments as of `compiled_copy`."""
    loader = SourceFileLoader(f"{module.__name__}#{name}", str(module.__file__))
    spec = spec_from_loader(loader.name, loader)
    if spec is None:
        raise ImportError(f"no way to load {module.__file__}")
    copy = module_from_spec(spec)
    # Code that numba has kept from another process finds its module by name.
    sys.modules[loader.name] = copy
    loader.exec_module(copy)
    for used, other in (others or {}).items():
        setattr(copy, used, other)
    return copy
