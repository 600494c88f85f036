"""Controllers of robots inside the stepping core, and the sums of their metrics.

A controller replaces the line's bytes: at the start of every control period it reads the registers and sets
both wheels' speeds in them at once, as the firmware would on a command D. Like the core, this is plain
arithmetic that runs interpreted and compiled; `episode` provides its data.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.compilable import compilable
from khep_twin.episodes import networks
from khep_twin.episodes.metrics import add_period
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import decide, pose
from khep_twin.step import DONE, NO_SPEED, PHASE, STEPS, Simulated, StepInputs, advance, switch_on

CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION = 0, 1, 2, 3
"""Kinds of controller: none (constant speeds), the ROM's Braitenberg vehicle, a network, a function."""

_SPEED_LIMIT = 127
_CONVERSION = units.STEP_NS * 1e-9
_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_RIGHT = kernel.RIGHT
_N = units.N_SENSORS


class Controllers(NamedTuple):
    """Controllers of a scene's robots, of one kind, and their sums of metrics.

    Attributes:
        kind: CONSTANT_SPEED, BRAITENBERG, NETWORK or FUNCTION.
        function: Address of a compiled function, or the function itself where nothing is compiled.
        steps_per_period: Steps per control period.
        sizes: Sizes of the network: inputs, layers, outputs.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        genes: Weights of the networks, or parameters of the functions (n_robots, n_genes).
        memory: Memories kept from one control period to the next (n_robots, n_memory).
        values: Buffer for a network's values.
        speeds: Buffer for the speeds of a function (2,) [pulses/10 ms].
        home: Home x, y and radius [m], and duration of the charge [s] (4,); radius 0 for none.
        sums: Sums over the episode, as of `metrics` (n_robots, N_SUMS).
    """

    kind: int
    function: Any
    steps_per_period: int
    sizes: Vector[int]
    recurrent: bool
    top_speed: float
    genes: Any
    memory: Any
    values: Vector[float]
    speeds: Vector[float]
    home: Vector[float]
    sums: Any


class JointRun(NamedTuple):
    """Episodes that one call runs, one after another; an episode that runs alone has none of them.

    Attributes:
        addresses: Addresses of the arrays of each episode (n, n_arrays).
        rows: Rows of the episodes to run, in all arrays (n_rows,).
        untils: Number of steps since the start up to which each episode is run (n,).
        speeds: Speeds of the wheels, set before (n, n_robots, 2) [pulses/10 ms].
        reasons: Reason of each return, filled in (n,).
        registers: States of the boards afterwards, filled in (n, n_robots, N_REGISTERS).
        poses: True x, y [m] and heading [rad] afterwards, filled in (n, n_robots, 3).
    """

    addresses: NDArray[np.int64]
    rows: NDArray[np.int64]
    untils: NDArray[np.int64]
    speeds: NDArray[np.float64]
    reasons: NDArray[np.int64]
    registers: NDArray[np.int64]
    poses: NDArray[np.float64]

    @classmethod
    def of(cls, count: int, n_robots: int, n_arrays: int) -> Self:
        """Return arrays for some episodes, filled with zeros."""
        whole = np.int64
        return cls(
            np.zeros((count, n_arrays), whole),
            np.arange(count),
            np.zeros(count, whole),
            np.zeros((count, n_robots, 2)),
            np.zeros(count, whole),
            np.zeros((count, n_robots, kernel.N_REGISTERS), whole),
            np.zeros((count, n_robots, 3)),
        )


ALONE = JointRun.of(0, 0, 0)
"""No joint run: the episode of the other arguments runs alone."""

Run = Callable[..., int]
"""`run`; compiled code gets arrays, with the controllers first, and a `JointRun`."""


@compilable
def run(controllers: Controllers, simulated: Simulated, inputs: StepInputs, until: int, stops: int) -> int:
    """Run steps with controllers, as `step.advance` does without them.

    Args:
        controllers: Controllers of the robots.
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        until: Number of steps since the start of the run; below 0 to switch the robots on.
        stops: Reasons to return earlier, as for `step.advance`.
    """
    if until < 0:
        return switch_on(simulated, inputs)
    counters, period = simulated.counters, controllers.steps_per_period
    while True:
        steps = counters[STEPS]
        if counters[PHASE] == DONE and steps % period == 0 and steps < until:
            for robot in range(len(simulated.robots)):
                if not control(simulated, controllers, robot):
                    return NO_SPEED
        begun = steps if counters[PHASE] == DONE else steps - 1
        reason = advance(simulated, inputs, min((begun // period + 1) * period, until), stops)
        if reason != DONE or counters[STEPS] == until:
            return reason


@compilable
def run_in_turn(
    controllers: Controllers,
    simulated: Simulated,
    inputs: StepInputs,
    until: int,
    stops: int,
    joint: JointRun,
    turn: int,
) -> int:
    """Run one episode of a joint run, with its speeds, or an episode alone; arguments are those of `run`."""
    # `run` is called in one place, as compiled code has it once for each.
    row, reason = -1, DONE
    if len(joint.rows) > 0:
        row = joint.rows[turn]
        until = int(joint.untils[row])
        for robot in range(len(simulated.robots)):
            state = simulated.robots[robot]
            left, right = joint.speeds[row, robot, 0], joint.speeds[row, robot, 1]
            if state.processor[kernel.POWERED] and not drive(state.registers, left, right):
                reason = NO_SPEED
    if reason == DONE:
        reason = run(controllers, simulated, inputs, until, stops)
    if row >= 0:
        joint.reasons[row] = reason
        observe(simulated, joint, row)
    return reason


@compilable
def observe(simulated: Simulated, joint: JointRun, row: int) -> None:
    """Copy registers and poses of an episode's robots."""
    for robot in range(len(simulated.robots)):
        state = simulated.robots[robot]
        for index in range(kernel.N_REGISTERS):
            joint.registers[row, robot, index] = state.registers[index]
        x, y, cosine, sine = pose(simulated.scene, state.pose)
        joint.poses[row, robot, 0] = x
        joint.poses[row, robot, 1] = y
        joint.poses[row, robot, 2] = math.atan2(sine, cosine)


@compilable
def control(simulated: Simulated, controllers: Controllers, robot: int) -> bool:
    """Run the controller of a robot and add its metrics; return False if a speed is not finite."""
    state, ambient = simulated.robots[robot], simulated.robots[robot].sensors.ambient
    if state.processor[kernel.POWERED] and not _drive(
        state.registers, controllers, robot, ambient.dark, ambient.floor
    ):
        return False
    period = controllers.steps_per_period * simulated.timing.conversions * _CONVERSION
    add_period(
        state.registers,
        controllers.sums[robot],
        controllers.home,
        ambient.dark,
        ambient.floor,
        pose(simulated.scene, state.pose),
        period,
    )
    return True


@compilable
def drive(registers: kernel.Registers, left: float, right: float) -> bool:
    """Set both speeds [pulses/10 ms] as command D does, rounded and clipped; return False if not finite."""
    if not (math.isfinite(left) and math.isfinite(right)):
        return False
    limit = float(_SPEED_LIMIT)
    kernel.set_speed(registers, 0, round(min(max(left, -limit), limit)))
    kernel.set_speed(registers, _RIGHT, round(min(max(right, -limit), limit)))
    return True


@compilable
def _drive(
    registers: kernel.Registers, controllers: Controllers, robot: int, dark: float, floor: float
) -> bool:
    """Run a controller once; return False if a speed is not finite."""
    if controllers.kind == BRAITENBERG:
        kernel.wander(registers)
    elif controllers.kind == NETWORK:
        values = controllers.values
        for sensor in range(_N):
            values[sensor] = registers[_PROXIMITY + sensor] / units.COUNTS_LIMIT
        for sensor in range(controllers.sizes[0] - _N):
            values[_N + sensor] = (dark - registers[_AMBIENT + sensor]) / (dark - floor)
        genes, memory = controllers.genes[robot], controllers.memory[robot]
        out = networks.forward(controllers.sizes, controllers.recurrent, genes, memory, values)
        return drive(registers, controllers.top_speed * values[out], controllers.top_speed * values[out + 1])
    elif controllers.kind == FUNCTION:
        genes, memory, speeds = controllers.genes[robot], controllers.memory[robot], controllers.speeds
        decide(controllers.function, registers, memory, genes, speeds)
        return drive(registers, speeds[0], speeds[1])
    return True
