"""The episode compiled by numba: one loop without the interpreter and its lock.

Imported only where numba is installed. Compiling takes some ten seconds; numba caches the compiled code
beside this file, or in the user's cache, until a source changes.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

import hashlib
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import mujoco
import numba
import numpy as np
from numba import carray, cfunc, njit, types  # pyright: ignore
from numba.core import event
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.board.compiled_kernel import compiled_copy, compiled_kernel
from khep_twin.board.kernel import AMBIENT, N_REGISTERS, PROXIMITY
from khep_twin.errors import ControllerError
from khep_twin.rollout import addresses, compiled_casting, fitness, networks, stepping
from khep_twin.rollout.stepping import Advance, ControllerState, RobotState, StepInputs
from khep_twin.sensing import optics, raycast
from khep_twin.status_line import announced

Function = TypeVar("Function", bound=Callable[..., object])

SOURCES = (kernel, units, fitness, optics, raycast, networks, stepping, compiled_casting, addresses)
"""Modules that are compiled."""

_EPISODE = compiled_copy(
    stepping,
    {
        "kernel": compiled_kernel(),
        "units": compiled_copy(units),
        "fitness": compiled_copy(fitness),
        "networks": compiled_copy(networks),
        "raycast": compiled_casting,
        "optics": compiled_copy(optics, {"raycast": compiled_casting}),
    },
)


def stamp_of(sources: tuple[ModuleType, ...]) -> int:
    """Return a hash of these sources and of the versions of numba and MuJoCo."""
    digest = hashlib.sha256(f"{numba.__version__} {mujoco.__version__}".encode())
    for module in sources:
        digest.update(Path(str(module.__file__)).read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")


def stamped(function: Function, sources: tuple[ModuleType, ...]) -> Function:
    """Return the function, renamed with the stamp of the sources that it calls.

    numba caches compiled code in a file of the function's name, and checks only that function's own source
    for changes.
    """
    function.__qualname__ = f"{function.__name__}_{stamp_of(sources):x}"
    return function


class _Announcer(event.Listener):
    """Announces each compilation of one function; code from the cache is not compiled."""

    def __init__(self, function: object) -> None:
        self._function = function
        self._shown = ExitStack()

    def on_start(self, event: Any) -> None:
        if event.data["dispatcher"] is self._function:
            self._shown.enter_context(announced(COMPILING))

    def on_end(self, event: Any) -> None:
        if event.data["dispatcher"] is self._function:
            self._shown.close()


COMPILING = "khep_twin: compiling with numba, once per version (10 to 30 s)"
"""Announcement of a compilation."""


def announce_compilation(function: Function) -> Function:
    """Return a function compiled by numba; its compilations are announced on standard error."""
    event.register("numba:compile", _Announcer(function))
    return function


def _advance(robot: RobotState, controller: ControllerState, inputs: StepInputs, n_steps: int) -> int:
    return _EPISODE.advance(robot, controller, inputs, n_steps)


advance: Advance = announce_compilation(njit(nogil=True, cache=True)(stamped(_advance, SOURCES)))
"""`stepping.advance`, compiled."""


@cache
def address_of(function: Callable[..., tuple[float, float]]) -> int:
    """Return the address of a controller, for compiled code.

    Args:
        function: Function of proximity (8,), ambient (8,), memory and genes, plain or by `numba.njit`; it
            returns left and right speed [pulses/10 ms].

    Raises:
        ControllerError: numba cannot compile it.
    """
    first_near, first_ambient, count = PROXIMITY[0], AMBIENT[0], len(PROXIMITY)
    whole, real = types.CPointer(types.int64), types.CPointer(types.float64)

    def call(registers, memory, n_memory, genes, n_genes, speeds):
        board, both = carray(registers, (N_REGISTERS,)), carray(speeds, (2,))
        both[:] = np.nan
        try:
            left, right = decide(
                board[first_near : first_near + count],
                board[first_ambient : first_ambient + count],
                carray(memory, (n_memory,)),
                carray(genes, (n_genes,)),
            )
            both[0], both[1] = left, right
        except Exception:  # nothing can be raised through MuJoCo's loop: NaN speeds report it
            pass

    signature = types.void(whole, real, types.int64, real, types.int64, real)
    try:
        decide = _within_bounds(function)
        made = cfunc(signature)(call)
    # numba leaves it to Python to report what is no function, or missing from a module.
    except (NumbaError, UnsupportedBytecodeError, TypeError, AttributeError) as error:
        name = getattr(function, "__name__", "controller")
        lines = [line for line in str(error).strip().splitlines() if not line.startswith(_GENERAL)]
        reason = lines[0].rstrip(":.") if lines else type(error).__name__
        raise ControllerError(
            f"{name}: numba cannot compile it: {reason}; expected a function of proximity, ambient, memory "
            "and genes that returns two numbers"
        ) from error
    _KEPT.append(made)
    return int(made.address or 0)


_KEPT: list[object] = []

_GENERAL = "Failed in nopython mode"
"""First words of a line of numba's that gives no reason yet."""


def _within_bounds(function: Any) -> Any:
    """Return a controller compiled with bounds checks on its arrays."""
    if not hasattr(function, "py_func"):
        return njit(boundscheck=True)(function)
    if function.targetoptions.get("boundscheck") is not None:
        return function
    options: dict[str, Any] = {**function.targetoptions, "boundscheck": True}
    return numba.jit(**options)(function.py_func)
