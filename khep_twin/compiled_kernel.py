"""The board's arithmetic compiled by numba: the same source as `kernel`, many times as fast.

numba is an extra, `pip install 'khep-twin[batch]'`; everything else works without it.
"""

# numba is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

import inspect
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from types import ModuleType

from khep_twin import kernel
from khep_twin.errors import MissingExtraError


@cache
def compiled_kernel() -> ModuleType:
    """A second copy of the module `kernel` whose functions are compiled; its registers are int64 arrays.

    Each function is compiled when it is first called.

    Raises:
        MissingExtraError: numba is not installed.
    """
    try:
        from numba import njit
    except ImportError as error:
        raise MissingExtraError("numba", "batch") from error
    loader = SourceFileLoader("khep_twin.kernel#compiled", str(kernel.__file__))
    spec = spec_from_loader(loader.name, loader)
    if spec is None:
        raise ImportError(f"no way to load {kernel.__file__}")
    copy = module_from_spec(spec)
    loader.exec_module(copy)
    # A compiled function finds the others by their names in the copy, compiled too.
    for name, function in inspect.getmembers(copy, inspect.isfunction):
        setattr(copy, name, njit(function))
    return copy
