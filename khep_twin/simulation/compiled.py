"""The stepping core compiled by numba: many steps in one call, without the interpreter and its lock.

Imported only where numba is installed. Compiling takes some seconds; numba caches the compiled code beside
this file, or in the user's cache, until a source changes.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import mujoco
import numba
from numba.extending import register_jitable

from khep_twin import step, units
from khep_twin.board import battery, kernel
from khep_twin.compilable import FUNCTIONS
from khep_twin.sensing import (
    light,
    mujoco_scene,
    noise,
    optics,
    reflection,
    robot_sensors,
    scene,
    seen_surfaces,
)
from khep_twin.sensing.light import Light
from khep_twin.simulation import addresses, foreign, linking, mujoco_calls
from khep_twin.simulation.announcement import ANNOUNCER
from khep_twin.simulation.linking import INNER, OuterCompiler
from khep_twin.simulation.mujoco_calls import MujocoCalls
from khep_twin.step import Simulated, StepInputs

Function = TypeVar("Function", bound=Callable[..., object])

_OPTICS = noise, seen_surfaces, reflection, robot_sensors, light, optics, mujoco_scene
SOURCES = (units, battery, kernel, scene, *_OPTICS, step, addresses, foreign, mujoco_calls)
"""Modules that are compiled."""

_REGISTERED: list[object] = []
"""Functions of `FUNCTIONS` that numba knows, in its order."""


def compiled(function: Function, sources: tuple[ModuleType, ...]) -> Function:
    """Return a function compiled by numba when it is first called; the compilation is announced.

    numba caches compiled code in a file of the function's name, and checks only that function's own source
    for changes. So its name here has a stamp of all sources that it calls.

    Args:
        function: Function of plain arithmetic, which makes no arrays.
        sources: Modules of the functions that it calls.
    """
    register()
    function.__qualname__ = f"{function.__name__}_{stamp(map(source_of, (*sources, foreign, linking)))}"
    # Reference counts of arrays would take half of the time, and nothing here makes arrays.
    make = numba.njit(nogil=True, _nrt=False, error_model="numpy", pipeline_class=OuterCompiler)
    made = make(function)
    with suppress(RuntimeError):  # where no folder can be written, nothing is cached
        made.enable_caching()
    ANNOUNCER.add(made, sources)
    return made


def stamp(sources: Iterable[Path]) -> str:
    """Return a digest of source files, and of the versions of numba and MuJoCo."""
    digest = hashlib.sha256(f"{numba.__version__} {mujoco.__version__}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:14]


def source_of(module: ModuleType) -> Path:
    """Return the source file of a module."""
    return Path(str(module.__file__))


def register() -> None:
    """Register with numba the functions that compiled code may call."""
    for plain in FUNCTIONS[len(_REGISTERED) :]:
        _REGISTERED.append(register_jitable(**INNER)(plain))


def _advance(scene, timing, law, bulbs, hidden, robots, counters, powers, tables, until, stops):
    calls, light = MujocoCalls(scene[0][0], scene[1]), Light(law[0], bulbs, hidden)
    simulated = Simulated(calls, timing[0], light, robots, counters)
    inputs = StepInputs(powers, tables)
    if until < 0:
        return step.switch_on(simulated, inputs)
    return step.advance(simulated, inputs, until, stops)


advance = compiled(_advance, SOURCES)
"""`step.advance`, compiled; `step.switch_on` where `until` is below 0."""
