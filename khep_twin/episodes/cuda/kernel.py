"""The stepping core of episodes in a plane as a CUDA kernel, compiled from the source of the plane.

A thread runs one episode after another: it copies its state to local memory, runs it, and copies the state
back. States are columns of a table of 64-bit words. Constants have one row for all slots, or one per slot.

Imported only where numba-cuda is installed.
"""

# numba-cuda is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingImports=false, reportMissingTypeStubs=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportPrivateImportUsage=false

import time
import warnings
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from numba import config, cuda, types

from khep_twin.compilable import ONCE
from khep_twin.episodes import stepping
from khep_twin.episodes.cuda import views
from khep_twin.episodes.cuda.views import array_at, constant_of, obstacles_at, overlay, record_at, scene_of
from khep_twin.episodes.planar.compiled import PLANE_SOURCES
from khep_twin.episodes.planar.plane import Plane
from khep_twin.process.status_line import announced
from khep_twin.sensing.light import Light
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.simulation.compiled import digest_of, source_of, sources_of
from khep_twin.step import Reason


def stamp_of(model: str) -> str:
    """Return a digest of all sources that are compiled for robots of a family."""
    sources = map(source_of, (*sources_of(model), *PLANE_SOURCES, views))
    return digest_of([*sources, *map(Path(__file__).with_name, ("lowering.py", "kernel.py"))])


ANNOUNCEMENT = "khep_twin: compiling for the GPU"
"""Start of each line of an announcement."""

SIMULATED = bool(config.ENABLE_CUDASIM)
"""True if kernels run in numba's simulator, in plain Python."""

if not SIMULATED:
    from khep_twin.episodes.cuda import lowering as _lowering  # noqa: F401  # the same functions for a GPU


class Constants(NamedTuple):
    """Constants of episodes.

    Those from `tables` on have one row for all slots, or a row for each (1 or n, ...).

    Attributes:
        kind: Kind of controller.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        terms: Further inputs of the network.
        sizes: Sizes of the network.
        line: Times of the line.
        tables: Quantiles of the random draws.
        genes: Genes of the robots.
        home: Home of the robots.
        table: Cumulated light of faces, of `Proximity`.
        obstacles: Obstacles; only the constant columns of fixed ones are read.
        timing: Divisions of time.
        law: Law of the lamps' light.
        bulbs: Lamps.
        hidden: Directions in which the lamps may be hidden.
        powers: Powers of the lamps.
        paint: Floor and paint on it.
        robots: Robots, as records of the state of their core.
        planar_robots: Robots, as records of `PlanarRobot`.
    """

    kind: Any
    recurrent: Any
    top_speed: Any
    terms: Any
    sizes: Any
    line: Any
    tables: Any
    genes: Any
    home: Any
    table: Any
    obstacles: Any
    timing: Any
    law: Any
    bulbs: Any
    hidden: Any
    powers: Any
    paint: Any
    robots: Any
    planar_robots: Any


class LocalMemory(NamedTuple):
    """Parts of a thread's local memory, in order: the template of each (an array), or its offset in words.

    Attributes:
        state: State of the robot, a record (1,).
        memory: Memories of the controllers.
        obstacles: Changing columns of the obstacles: `state` of `views.obstacles_at`.
        fixed_by_distance: Indices of the fixed obstacles, nearest first.
        bodies: Movable obstacles.
        buffers: Buffers of the robot, a record (1,); from here on nothing is stored between launches.
        neurons: Buffer for the values of a network's neurons.
        near: Buffer for the obstacles in sensor range.
        obstacle_contacts: Buffer for contacts of movable obstacles.
    """

    state: Any
    memory: Any
    obstacles: Any
    fixed_by_distance: Any
    bodies: Any
    buffers: Any
    neurons: Any
    near: Any
    obstacle_contacts: Any


class _Sensors(NamedTuple):
    """Field of `KheperaState` that is an overlay."""

    sensors: Any


class _Proximity(NamedTuple):
    """Field of `RobotSensors` that is an overlay."""

    proximity: Any


class _Table(NamedTuple):
    """Field of `Proximity` that its record leaves out."""

    table: Any


def make_run(capacity: int) -> Any:
    """Return the kernel's function for a number of words of local memory."""

    def run(constants, templates, offsets, states, new_states, end_step, slots):
        """Run the episodes of some slots.

        Args:
            constants: `Constants`.
            templates: `LocalMemory` of arrays, for shapes and types.
            offsets: `LocalMemory` of the index of each part's first word.
            states: States of all slots (n_words, n).
            new_states: States of the slots to switch on (n_words, n_slots).
            end_step: Number of steps as for `stepping.run`; below 0 to switch on the robots of `new_states`.
            slots: Arrays of the slots (`stepping.SlotArrays`).
        """
        local = cuda.local.array(capacity, types.int64)
        for index in range(cuda.grid(1), len(slots.indices), cuda.gridsize(1)):
            slot = slots.indices[index]
            for word in range(len(states)):
                local[word] = new_states[word, index] if end_step < 0 else states[word, slot]
            for word in range(len(states), capacity):
                local[word] = 0
            state = record_at(local, offsets.state, templates.state)
            buffers = record_at(local, offsets.buffers, templates.buffers)
            fixed_by_distance = array_at(local, offsets.fixed_by_distance, templates.fixed_by_distance)
            obstacle_state = array_at(local, offsets.obstacles, templates.obstacles)
            neurons = array_at(local, offsets.neurons, templates.neurons)
            memory = array_at(local, offsets.memory, templates.memory)
            controllers = stepping.Controllers(
                constants.kind,
                0,
                constants.sizes,
                constants.recurrent,
                constants.top_speed,
                constants.terms,
                constant_of(constants.genes, slot),
                memory,
                neurons,
                memory,  # no outputs besides the speeds
                constant_of(constants.home, slot),
                state.sums,
                constants.line,
                state.events,
                state.host_registers,
            )
            robot = constant_of(constants.robots, slot)
            table = _Table(constant_of(constants.table, slot))
            proximity = overlay(overlay(robot.sensors.proximity, table), buffers.proximity)
            sensors = _Sensors(overlay(robot.sensors, _Proximity(proximity)))
            plane = Plane(
                obstacles_at(constant_of(constants.obstacles, slot), obstacle_state, len(fixed_by_distance)),
                fixed_by_distance,
                array_at(local, offsets.near, templates.near),
                array_at(local, offsets.bodies, templates.bodies),
                array_at(local, offsets.obstacle_contacts, templates.obstacle_contacts),
                constant_of(constants.paint, slot),
                overlay(overlay(constant_of(constants.planar_robots, slot), state.plane), buffers.plane),
            )
            simulated = Simulated(
                scene_of(plane),
                constant_of(constants.timing, slot)[0],
                Light(
                    constant_of(constants.law, slot)[0],
                    constant_of(constants.bulbs, slot),
                    constant_of(constants.hidden, slot),
                ),
                ((overlay(overlay(robot, sensors), state.robot),),),
                state.counters,
            )
            inputs = StepInputs(constant_of(constants.powers, slot), constant_of(constants.tables, slot))
            reason = Reason.STOPPED
            while reason == Reason.STOPPED:  # a robot continues to roll without its processor
                reason = stepping.run_slot(controllers, simulated, inputs, end_step, 0, slots, index)
                if end_step < 0:
                    break
            for word in range(len(states)):
                states[word, slot] = local[word]

    return run


@cache
def kernel(capacity: int, model: str) -> Any:
    """Return the kernel for a number of words of local memory, and for robots of a family.

    It is compiled when it is first launched.
    """
    run = make_run(capacity)
    # numba's cache checks only the kernel's own source, as `simulation.compiled.compiled` says.
    run.__qualname__ = f"run_{model}_{capacity}_{stamp_of(model)}"
    dispatcher = cuda.jit(run)
    if not SIMULATED:
        with suppress(RuntimeError):  # where no folder can be written, nothing is cached
            dispatcher.enable_caching()
    return dispatcher


@contextmanager
def compiling() -> Generator[None]:
    """Compile kernels within this context as on the CPU: no fused multiply-adds, large functions only once.

    A fused multiply-add rounds once where CPU code rounds twice. As numba-cuda has no option for it, nor
    for `compilable.ONCE`, its compiler is replaced temporarily. Its warning about small grids is suppressed.
    """
    if SIMULATED:
        yield
        return
    from numba.cuda import dispatcher

    original, start_s, compiled_functions = dispatcher.compile_cuda, time.monotonic(), list[Any]()

    def report_progress() -> str:
        return f"{ANNOUNCEMENT}: {len(compiled_functions)} functions, {time.monotonic() - start_s:.0f} s"

    def report_end() -> str:
        return f"{ANNOUNCEMENT} took {time.monotonic() - start_s:.0f} s"

    def compile_cuda(function: Any, *arguments: Any, nvvm_options: Any = None, **options: Any) -> Any:
        if not compiled_functions:
            notice = f"{ANNOUNCEMENT}, once per version: half a minute to two minutes"
            stack.enter_context(announced(notice, report_progress, report_end))
        compiled_functions.append(function)
        result = original(function, *arguments, nvvm_options={**(nvvm_options or {}), "fma": 0}, **options)
        if function in ONCE:
            result.library.get_function(result.fndesc.llvm_func_name).attributes.add("noinline")
        return result

    with ExitStack() as stack:
        dispatcher.compile_cuda = compile_cuda
        stack.callback(setattr, dispatcher, "compile_cuda", original)
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "Grid size")
        yield
