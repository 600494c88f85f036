"""The stepping core compiled by numba: many steps per call, without the interpreter and its lock.

Imported only where numba is installed. The compilation takes some seconds; numba caches the code beside this
file, or in the user's cache folder, until a source file changes.
"""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

import hashlib
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TypeVar

import mujoco
import numba
from numba.extending import overload, register_jitable

from khep_twin import step, units
from khep_twin.compilable import FUNCTIONS
from khep_twin.robots import core as robot_core
from khep_twin.robots.core import DUTIES, core_of, core_of_fields
from khep_twin.robots.registry import find_family
from khep_twin.sensing import (
    device_faults,
    light,
    mujoco_scene,
    noise,
    optics,
    reflection,
    robot_sensors,
    scene,
    seen_surfaces,
    simulated,
)
from khep_twin.sensing.light import Light
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.simulation import addresses, foreign, linking, mujoco_calls
from khep_twin.simulation.announcement import ANNOUNCER
from khep_twin.simulation.linking import INNER, OuterCompiler
from khep_twin.simulation.mujoco_calls import MujocoCalls

Function = TypeVar("Function", bound=Callable[..., object])

_OPTICS = noise, seen_surfaces, reflection, robot_sensors, light, optics, mujoco_scene
_SENSING = scene, simulated, *_OPTICS, device_faults
_CORE_SOURCES = units, *_SENSING, robot_core, step, addresses, foreign, mujoco_calls
"""Modules that are compiled for all robots."""

_REGISTERED: list[object] = []
"""Functions of `FUNCTIONS` that are registered with numba, in the same order."""


def sources_of(*models: str) -> tuple[ModuleType, ...]:
    """Return the modules that are compiled for worlds of robots with these cores."""
    cores = [core_of(find_family(model)) for model in models]
    return (*_CORE_SOURCES, *(sys.modules[name] for core in cores for name in core.modules))


def compiled(function: Function, sources: tuple[ModuleType, ...]) -> Function:
    """Return a function compiled by numba when it is first called; the compilation is announced.

    numba caches compiled code in a file named after the function, and checks only that function's source file
    for changes. So the name is extended with a digest of all source files that it uses.

    Args:
        function: Function of arithmetic, which creates no arrays.
        sources: Modules of the functions that it calls.
    """
    register()
    function.__qualname__ = f"{function.__name__}_{digest_of(map(source_of, (*sources, foreign, linking)))}"
    # Reference counting of arrays would take half of the time, and is not needed without new arrays.
    decorate = numba.njit(nogil=True, _nrt=False, error_model="numpy", pipeline_class=OuterCompiler)
    dispatcher = decorate(function)
    with suppress(RuntimeError):  # no folder can be written: no cache
        dispatcher.enable_caching()
    ANNOUNCER.add(dispatcher, sources)
    return dispatcher


def digest_of(sources: Iterable[Path]) -> str:
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
    if not _REGISTERED:
        step.unroll = numba.literal_unroll
        for duty in DUTIES:
            overload(duty, strict=False, jit_options=INNER)(_chooser(duty.__name__))
    for function in FUNCTIONS[len(_REGISTERED) :]:
        _REGISTERED.append(register_jitable(**INNER)(function))


def _chooser(duty):
    """Return a function that returns the function of a duty for the state of a robot, by its numba type."""

    def choose(robot, *rest):
        core = core_of_fields(getattr(robot, "fields", ()))
        return core and getattr(core, duty)

    return choose


def _advance(scene, timing, law, bulbs, hidden_sectors, groups, counters, powers, tables, end_step, stops):
    calls, light = MujocoCalls(scene[0][0], scene[1]), Light(law[0], bulbs, hidden_sectors)
    simulated = Simulated(calls, timing[0], light, groups, counters)
    inputs = StepInputs(powers, tables)
    if end_step < step.SWITCH_ON:
        step.evaluate_recorded(groups, simulated, inputs, step.EVALUATE - end_step, stops)
        return step.Reason.DONE
    if end_step < 0:
        return step.switch_on(simulated, inputs)
    return step.advance(simulated, inputs, end_step, stops)


@cache
def advance_of(*models):
    """Return `simulation.plain_advance` compiled for worlds of robots with these cores, in this order."""
    return compiled(named(_advance, "advance", *models), sources_of(*models))


def named(function, name, *models):
    """Return a copy of a function, named after the families of models that it is compiled for."""
    copy = FunctionType(function.__code__, function.__globals__, "_".join((name, *models)))
    copy.__module__ = function.__module__
    return copy
