"""The stepping core of episodes in a plane as a CUDA kernel, compiled from the source of the plane.

A thread takes one episode after another: it copies the episode's words to its own memory, runs it, and
copies them back. What differs between episodes is in columns of a table; constants are shared, or have a row
for each.

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
from khep_twin.episodes.cuda.views import array_at, record_at, row_of, scene_of, split, things_at
from khep_twin.episodes.planar.compiled import PLANE_SOURCES
from khep_twin.episodes.planar.plane import Plane
from khep_twin.sensing.light import Light
from khep_twin.simulation.compiled import source_of, stamp
from khep_twin.status_line import announced
from khep_twin.step import STOPPED, Simulated, StepInputs

STAMP = stamp(
    [*map(source_of, (*PLANE_SOURCES, views)), *map(Path(__file__).with_name, ("lowering.py", "kernel.py"))]
)
"""Digest of all sources that are compiled."""

ANNOUNCEMENT = "khep_twin: compiling for the card"
"""Begin of each line of an announcement."""

SIMULATED = bool(config.ENABLE_CUDASIM)
"""True if kernels run in numba's simulator, in plain Python."""

if not SIMULATED:
    from khep_twin.episodes.cuda import lowering as _lowering  # noqa: F401  # how a card does it


class Constants(NamedTuple):
    """Constants of episodes.

    Those from `tables` on have a row for all, or one for each (1 or n, ...).

    Attributes:
        kind: Kind of controller.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        sizes: Sizes of the network.
        line: Times of the line.
        tables: Quantiles of the random draws.
        genes: Genes of the robots.
        home: Home of the robots.
        table: Cumulated light of faces, of `Proximity`.
        things: Obstacles, of which the fixed ones' constants are read.
        timing: Divisions of time.
        law: Law of the lamps' light.
        bulbs: Lamps.
        hidden: Directions in which they may be hidden.
        powers: Powers of the lamps.
        robots: Robots, as records of `step.RobotState`.
        planes: The same, as records of `PlanarRobot`.
    """

    kind: Any
    recurrent: Any
    top_speed: Any
    sizes: Any
    line: Any
    tables: Any
    genes: Any
    home: Any
    table: Any
    things: Any
    timing: Any
    law: Any
    bulbs: Any
    hidden: Any
    powers: Any
    robots: Any
    planes: Any


class LocalMemory(NamedTuple):
    """Parts of a thread's memory, in order: each an array of its shape, or the index of its first word.

    Attributes:
        kept: State of the robot, a record (1,).
        memory: Memories of the controllers.
        things: Changing numbers of the obstacles, as of `views.things_at`.
        order: Order of the fixed obstacles.
        bodies: Movable obstacles.
        buffers: Buffers of the robot, a record (1,), the first part that is not kept.
        values: Buffer for a network's values.
        near: Buffer for the obstacles within sight.
        touches: Buffer for contacts.
    """

    kept: Any
    memory: Any
    things: Any
    order: Any
    bodies: Any
    buffers: Any
    values: Any
    near: Any
    touches: Any


class _Sensors(NamedTuple):
    """Field of `RobotState` that is a split."""

    sensors: Any


class _Proximity(NamedTuple):
    """Field of `RobotSensors` that is a split."""

    proximity: Any


class _Table(NamedTuple):
    """Field of `Proximity` that its record is without."""

    table: Any


def body(capacity: int) -> Any:
    """Return the kernel's function for a number of words of local memory."""

    def run(constants, like, first, words, fresh, until, joint):
        """Run the episodes of a joint run.

        Args:
            constants: `Constants`.
            like: `LocalMemory` of arrays.
            first: `LocalMemory` of the indices of their first words.
            words: Words of the episodes (n_words, n).
            fresh: Words of the episodes to switch on (n_words, n_rows).
            until: Number of steps, as for `stepping.run`: below 0 to switch on the episodes of `fresh`.
            joint: `stepping.JointRun` of the episodes.
        """
        local = cuda.local.array(capacity, types.int64)
        for turn in range(cuda.grid(1), len(joint.rows), cuda.gridsize(1)):
            lane = joint.rows[turn]
            for word in range(len(words)):
                local[word] = fresh[word, turn] if until < 0 else words[word, lane]
            for word in range(len(words), capacity):
                local[word] = 0
            kept = record_at(local, first.kept, like.kept)
            buffers = record_at(local, first.buffers, like.buffers)
            order = array_at(local, first.order, like.order)
            own = array_at(local, first.things, like.things)
            values = array_at(local, first.values, like.values)
            controllers = stepping.Controllers(
                constants.kind,
                0,
                constants.sizes,
                constants.recurrent,
                constants.top_speed,
                row_of(constants.genes, lane),
                array_at(local, first.memory, like.memory),
                values,
                values,
                row_of(constants.home, lane),
                kept.sums,
                constants.line,
                kept.events,
                kept.seen,
            )
            robot = row_of(constants.robots, lane)
            table = _Table(row_of(constants.table, lane))
            proximity = split(split(robot.sensors.proximity, table), buffers.proximity)
            sensors = _Sensors(split(robot.sensors, _Proximity(proximity)))
            plane = Plane(
                things_at(row_of(constants.things, lane), own, len(order)),
                order,
                array_at(local, first.near, like.near),
                array_at(local, first.bodies, like.bodies),
                array_at(local, first.touches, like.touches),
                split(split(row_of(constants.planes, lane), kept.plane), buffers.plane),
            )
            simulated = Simulated(
                scene_of(plane),
                row_of(constants.timing, lane)[0],
                Light(
                    row_of(constants.law, lane)[0],
                    row_of(constants.bulbs, lane),
                    row_of(constants.hidden, lane),
                ),
                (split(split(robot, sensors), kept.robot),),
                kept.counters,
            )
            inputs = StepInputs(row_of(constants.powers, lane), row_of(constants.tables, lane))
            reason = STOPPED
            while reason == STOPPED:  # without its processor a robot rolls on
                reason = stepping.run_in_turn(controllers, simulated, inputs, until, 0, joint, turn)
                if until < 0:
                    break
            for word in range(len(words)):
                words[word, lane] = local[word]

    return run


@cache
def kernel(capacity: int) -> Any:
    """Return the kernel for a number of words of local memory, compiled when it is first launched."""
    run = body(capacity)
    # numba's cache checks only the kernel's own source, as `simulation.compiled.compiled` says.
    run.__qualname__ = f"run_{capacity}_{STAMP}"
    made = cuda.jit(run)
    if not SIMULATED:
        with suppress(RuntimeError):  # where no folder can be written, nothing is cached
            made.enable_caching()
    return made


@contextmanager
def compiling() -> Generator[None]:
    """Compile what is launched within as on the CPU: no fused multiply-adds, and large functions once.

    numba's advice on small grids is left out: few episodes do not fill a card.

    A fused multiply-add rounds once where the CPU's code rounds twice. numba-cuda has no option for it, nor
    for what `compilable.ONCE` asks, so its own function for one compilation is replaced meanwhile.
    """
    if SIMULATED:
        yield
        return
    from numba.cuda import dispatcher

    plain, begin, done = dispatcher.compile_cuda, time.monotonic(), list[Any]()

    def passed() -> str:
        return f"{ANNOUNCEMENT}: {len(done)} functions, {time.monotonic() - begin:.0f} s"

    def compile_cuda(function: Any, *given: Any, nvvm_options: Any = None, **options: Any) -> Any:
        if not done:
            took = f"{ANNOUNCEMENT} took"
            first = f"{ANNOUNCEMENT}, once per version: half a minute to two minutes"
            shown.enter_context(announced(first, passed, lambda: f"{took} {time.monotonic() - begin:.0f} s"))
        done.append(function)
        made = plain(function, *given, nvvm_options={**(nvvm_options or {}), "fma": 0}, **options)
        if function in ONCE:
            made.library.get_function(made.fndesc.llvm_func_name).attributes.add("noinline")
        return made

    with ExitStack() as shown:
        dispatcher.compile_cuda = compile_cuda
        shown.callback(setattr, dispatcher, "compile_cuda", plain)
        shown.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "Grid size")
        yield
