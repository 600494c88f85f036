"""Episodes and their controllers compiled by numba.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
from numba import carray, cfunc, njit, types  # pyright: ignore
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from khep_twin.board.kernel import AMBIENT, N_REGISTERS, PROXIMITY
from khep_twin.episodes import fitness, line, metrics, networks, stepping
from khep_twin.errors import ControllerError
from khep_twin.sensing.light import Light
from khep_twin.simulation.compiled import SOURCES, compiled
from khep_twin.simulation.foreign import moved
from khep_twin.simulation.mujoco_calls import MujocoCalls
from khep_twin.step import Simulated, StepInputs

EPISODE_SOURCES = (*SOURCES, fitness, networks, metrics, line, stepping)
"""Modules that are compiled."""


def _run(given, until, stops, joint):
    reason = stepping.DONE
    for turn in range(max(len(joint.rows), 1)):
        own = moved(given, joint.addresses, joint.rows[turn]) if len(joint.rows) else given
        controllers, scene, timing, law, bulbs, hidden, robots, counters, powers, tables = own
        calls, light = MujocoCalls(scene[0][0], scene[1]), Light(law[0], bulbs, hidden)
        simulated = Simulated(calls, timing[0], light, robots, counters)
        reason = stepping.run_in_turn(
            controllers, simulated, StepInputs(powers, tables), until, stops, joint, turn
        )
    return reason


run = compiled(_run, EPISODE_SOURCES)
"""`stepping.run`, compiled, of one episode or of many."""


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
        lines = [
            line for line in _STYLE.sub("", str(error)).strip().splitlines() if not line.startswith(_GENERAL)
        ]
        reason = lines[0].rstrip(":.") if lines else type(error).__name__
        raise ControllerError(
            f"{name}: numba cannot compile it: {reason}; expected a function of proximity, ambient, memory "
            "and genes that returns two numbers"
        ) from error
    _KEPT.append(made)
    return int(made.address or 0)


_KEPT: list[object] = []

_STYLE = re.compile(r"\x1b\[[0-9;]*m")
"""Bold and colours, which numba adds where colorama is installed."""

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
