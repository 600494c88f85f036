"""Episodes and their controllers compiled by numba; imported only where numba is installed."""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numba
import numpy as np
from numba import carray, cfunc, njit, types  # pyright: ignore
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from khep_twin.episodes import fitness, line, metrics, networks, stepping
from khep_twin.errors import ControllerError
from khep_twin.sensing.light import Light
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.simulation.compiled import compiled, named, sources_of
from khep_twin.simulation.foreign import address_of, call_controller, implements, relocate
from khep_twin.simulation.mujoco_calls import MujocoCalls
from khep_twin.step import Reason

EPISODE_SOURCES = fitness, networks, metrics, line, stepping
"""Modules that are compiled, besides those of `sources_of`."""

_CALLBACKS: list[object] = []
"""Compiled controllers, which must outlive the use of their addresses."""

_ANSI_STYLE = re.compile(r"\x1b\[[0-9;]*m")
"""ANSI codes for bold and colours, which numba adds if colorama is installed."""

_GENERAL_ERROR_START = "Failed in nopython mode"
"""Start of a line of numba's messages that states no reason."""


def _run(arguments, end_step, stops, slots):
    reason = Reason.DONE.value  # an integer, which numba returns faster
    for i in range(max(len(slots.indices), 1)):
        arrays = relocate(arguments, slots.addresses, slots.indices[i]) if len(slots.indices) else arguments
        episode = stepping.EpisodeArguments(*arrays)
        light = Light(episode.law[0], episode.bulbs, episode.hidden)
        scene = MujocoCalls(episode.scene[0][0], episode.scene[1])
        simulated = Simulated(scene, episode.timing[0], light, episode.groups, episode.counters)
        inputs = StepInputs(episode.powers, episode.tables)
        reason = stepping.run_slot(episode.controllers, simulated, inputs, end_step, stops, slots, i)
    return reason


@cache
def run_of(model: str) -> Callable[..., int]:
    """Return `stepping.run_slot` for robots of a family, compiled, for one episode or many.

    Its first argument are the fields of `EpisodeArguments`.
    """
    return compiled(named(_run, "run", model), (*sources_of(model), *EPISODE_SOURCES))


@implements(stepping.call_function)
def _call_function(function, registers, memory, genes, outputs):
    call_controller(
        function,
        address_of(registers),
        address_of(memory),
        len(memory),
        address_of(genes),
        len(genes),
        address_of(outputs),
    )


@cache
def compile_controller(
    function: Callable[..., Sequence[float]],
    n_registers: int,
    readings: tuple[tuple[int, int], ...],
    n_outputs: int,
) -> int:
    """Compile a controller; return its address for compiled code.

    Args:
        function: Function of proximity (n,), ambient (n,), memory, genes and terms (n,), plain or by
            `numba.njit`; it returns left and right speed [register], and values of commands.
        n_registers: Number of registers of the robot, and of readings of turrets.
        readings: First register of proximity, ambient light and each term, and the end of them.
        n_outputs: Number of numbers that it returns.

    Raises:
        ControllerError: numba cannot compile it.
    """
    read = _reader_of(readings)
    int_pointer, float_pointer = types.CPointer(types.int64), types.CPointer(types.float64)

    def call(registers, memory, n_memory, genes, n_genes, outputs):
        board, results = carray(registers, (n_registers,)), carray(outputs, (n_outputs,))
        results[:] = np.nan
        try:
            values = read(board)
            state = carray(memory, (n_memory,)), carray(genes, (n_genes,))
            results[:] = np.array(decide(*(values[:2] + state + values[2:])))
        except Exception:  # exceptions cannot pass through compiled code: NaN reports them
            pass

    signature = types.void(int_pointer, float_pointer, types.int64, float_pointer, types.int64, float_pointer)
    try:
        decide = _compile_checked(function)
        callback = cfunc(signature)(call)
        returned = decide.nopython_signatures[-1].return_type
        if not isinstance(returned, types.BaseTuple) or len(returned) != n_outputs:
            raise TypeError(f"it returns {returned}")
    # Python, not numba, reports an argument that is no function, or a missing attribute of a module.
    except (NumbaError, UnsupportedBytecodeError, TypeError, AttributeError) as error:
        name = getattr(function, "__name__", "controller")
        lines = [
            line
            for line in _ANSI_STYLE.sub("", str(error)).strip().splitlines()
            if not line.startswith(_GENERAL_ERROR_START)
        ]
        reason = lines[0].rstrip(":.") if lines else type(error).__name__
        raise ControllerError(
            f"{name}: numba cannot compile it: {reason}; expected a function of proximity, ambient, memory, "
            f"genes and terms that returns {'two' if n_outputs == 2 else n_outputs} numbers"
        ) from error
    _CALLBACKS.append(callback)
    return int(callback.address or 0)


def _reader_of(readings: tuple[tuple[int, int], ...]) -> Any:
    """Return a compiled function of the registers that returns all readings."""
    if not readings:
        return njit(lambda board: ())
    read_others, (first, end) = _reader_of(readings[:-1]), readings[-1]
    return njit(lambda board: read_others(board) + (board[first:end],))  # noqa: RUF005


def _compile_checked(function: Any) -> Any:
    """Compile a controller with bounds checks on its arrays."""
    if not hasattr(function, "py_func"):
        return njit(boundscheck=True)(function)
    if function.targetoptions.get("boundscheck") is not None:
        return function
    options: dict[str, Any] = {**function.targetoptions, "boundscheck": True}
    return numba.jit(**options)(function.py_func)
