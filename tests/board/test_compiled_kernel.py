"""The board's arithmetic gives the same bits plain and compiled."""

import inspect
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba_marks import with_numba

from khep_twin.board import kernel
from khep_twin.board.kernel import LEFT, N_REGISTERS, RIGHT, Board, Wheel
from khep_twin.compilable import FUNCTIONS
from khep_twin.randomness import stream

N_ORDERS = 10_000


def functions() -> dict[str, Callable[..., Any]]:
    """Return the functions of the kernel by name."""
    members = inspect.getmembers(kernel, inspect.isfunction)
    return {name: function for name, function in members if function.__module__ == kernel.__name__}


@cache
def compiled_kernel() -> SimpleNamespace:
    """Return the kernel's functions in compiled form."""
    import numba

    from khep_twin.simulation.compiled import register

    register()
    return SimpleNamespace(**{name: numba.njit(function) for name, function in functions().items()})


def orders(rng: np.random.Generator) -> Callable[[Any, Any], None]:
    """Draw an order to the board or its clock: a function of a kernel and of registers."""
    wheel = int(rng.choice([LEFT, RIGHT]))
    small, large = int(rng.integers(-127, 128)), int(rng.integers(-(2**23) + 2, 2**23 - 1))
    position = int(rng.integers(-(2**31), 2**31))
    gain = int(rng.choice([0, 1, 20, 100, 3800, 32767]))
    left, right = (int(pulses) for pulses in rng.integers(-200, 201, 2))
    register = int(rng.integers(Board.SPEED_KP, Board.POSITION_KD + 1))
    limits = [(Wheel.MAX_SPEED, int(rng.integers(0, 128))), (Wheel.ACCELERATION, int(rng.integers(1, 65536)))]
    limit, value = limits[int(rng.integers(2))]

    def tick(module: Any, registers: Any) -> None:
        encoders = [int(registers[side + Wheel.ENCODER]) for side in (LEFT, RIGHT)]
        module.tick(registers, encoders[0] + left, encoders[1] + right)

    choices: list[Callable[[Any, Any], None]] = [
        lambda module, registers: module.set_speed(registers, wheel, small),
        lambda module, registers: module.set_duty(registers, wheel, 2 * small),
        lambda module, registers: module.set_target(registers, wheel, large),
        lambda module, registers: module.set_position(registers, wheel, position),
        lambda module, registers: module.convert(registers, abs(small), abs(position) % 1024),
        lambda module, registers: module.measure(registers, abs(small), abs(large) % 1000),
        lambda module, registers: module.wander(registers),
        lambda module, registers: registers.__setitem__(register, gain),
        lambda module, registers: registers.__setitem__(wheel + limit, value),
        lambda module, registers: module.reset(registers),
    ]
    weights = np.array([4, 1, 4, 1, 4, 1, 1, 1, 1, 0.1])
    if rng.random() < 0.8:
        return tick
    return choices[int(rng.choice(len(choices), p=weights / weights.sum()))]


@with_numba
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_plain_and_compiled_registers_are_equal_after_every_order(seed: int) -> None:
    plain, array, compiled = (np.zeros(N_REGISTERS, np.int64) for _ in range(3))
    fast = compiled_kernel()
    for registers, module in ((plain.data, kernel), (array, kernel), (compiled, fast)):
        module.reset(registers)
    rng = stream(seed, "orders")
    for turn in range(N_ORDERS):
        order = orders(rng)
        order(kernel, plain.data)
        order(fast, compiled)
        if turn < 2000:  # numpy's own integers are slow one by one
            order(kernel, array)
            assert array.tobytes() == plain.tobytes(), turn
        assert compiled.tobytes() == plain.tobytes(), turn


@with_numba
def test_every_function_of_the_kernel_is_for_compiled_code() -> None:
    assert set(functions().values()) <= set(FUNCTIONS)
    fast = compiled_kernel()
    registers = np.zeros(N_REGISTERS, np.int64)
    fast.reset(registers)
    fast.tick(registers, 1, -1)
    assert fast.tick.signatures
