"""Controllers of robots inside the stepping core, and the sums of their metrics.

A controller replaces the line's bytes: once a control period it reads the registers and sets both wheels'
speeds in them, as the firmware would on a command D, at once or at the times of a line (`line`). Like the
core, this is plain arithmetic that runs interpreted and compiled; `episode` provides its data.
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
from khep_twin.episodes.line import (
    NEVER,
    NEXT,
    REQUESTED,
    STAGE,
    answer,
    end_cycle,
    send_speeds,
    set_next,
)
from khep_twin.episodes.metrics import add_period
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import decide, pose
from khep_twin.step import DONE, NO_SPEED, PHASE, STEPS, Simulated, StepInputs, advance, switch_on

CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION, CALLER = 0, 1, 2, 3, 4
"""Kinds of controller: none (constant speeds), the ROM's Braitenberg vehicle, a network, a function, and the
caller of the core at a line, whose speeds each reading awaits."""

AWAITED = 4
"""Reason to return earlier, beside those of `step.advance`: all robots await the caller's speeds."""

_SPEED_LIMIT = 127
_CONVERSION = units.STEP_NS * 1e-9
_LEFT_SETPOINT, _RIGHT_SETPOINT = kernel.SETPOINTS
_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_RIGHT = kernel.RIGHT
_N = units.N_SENSORS


class Controllers(NamedTuple):
    """Controllers of a scene's robots, of one kind, and their sums of metrics.

    Attributes:
        kind: CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION or CALLER.
        function: Address of a compiled function, or the function itself where nothing is compiled.
        sizes: Sizes of the network: inputs, layers, outputs.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        genes: Weights of the networks, or parameters of the functions (n_robots, n_genes).
        memory: Memories kept from one control period to the next (n_robots, n_memory).
        values: Buffer for a network's values.
        speeds: Buffer for the speeds of a function (2,) [pulses/10 ms].
        home: Home x, y and radius [m], and duration of the charge [s] (4,); radius 0 for none.
        sums: Sums over the episode, as of `metrics` (n_robots, N_SUMS).
        line: Times of the line, as of `line.line_times`.
        events: Events of the robots' lines (n_robots, N_EVENT).
        seen: States of the boards as read by the controllers (n_robots, N_REGISTERS).
    """

    kind: int
    function: Any
    sizes: Vector[int]
    recurrent: bool
    top_speed: float
    genes: Any
    memory: Any
    values: Vector[float]
    speeds: Vector[float]
    home: Vector[float]
    sums: Any
    line: Vector[int]
    events: Any
    seen: Any


class JointRun(NamedTuple):
    """Episodes that one call runs, one after another; an episode that runs alone has none of them.

    Attributes:
        addresses: Addresses of the arrays of each episode (n, n_arrays).
        rows: Rows of the episodes to run, in all arrays (n_rows,).
        untils: Number of steps since the start up to which each episode is run (n,).
        speeds: Speeds of the wheels, set before (n, n_robots, 2) [pulses/10 ms]; (0, n_robots, 2) for none.
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
    counters = simulated.counters
    while True:
        if counters[PHASE] == DONE and counters[STEPS] < until and not control(simulated, controllers):
            return NO_SPEED
        end = next_step(controllers)
        if end == NEVER and stops & AWAITED:
            return DONE
        reason = advance(simulated, inputs, min(end, until), stops)
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
        for robot in range(len(simulated.robots) if len(joint.speeds) else 0):
            state = simulated.robots[robot]
            left, right = joint.speeds[row, robot, 0], joint.speeds[row, robot, 1]
            if controllers.kind == CALLER:
                is_driven = drive_later(simulated, controllers, robot, left, right)
            else:
                is_driven = not state.processor[kernel.POWERED] or drive(state.registers, left, right)
            if not is_driven:
                reason = NO_SPEED
    if reason == DONE:
        reason = run(controllers, simulated, inputs, until, stops)
    if row >= 0:
        joint.reasons[row] = reason
        observe(simulated, controllers, joint, row)
    return reason


@compilable
def observe(simulated: Simulated, controllers: Controllers, joint: JointRun, row: int) -> None:
    """Copy registers, or what the caller has read of them at a line, and poses of an episode's robots."""
    for robot in range(len(simulated.robots)):
        state = simulated.robots[robot]
        for index in range(kernel.N_REGISTERS):
            if controllers.kind == CALLER:
                joint.registers[row, robot, index] = controllers.seen[robot][index]
            else:
                joint.registers[row, robot, index] = state.registers[index]
        x, y, cosine, sine = pose(simulated.scene, state.pose)
        joint.poses[row, robot, 0] = x
        joint.poses[row, robot, 1] = y
        joint.poses[row, robot, 2] = math.atan2(sine, cosine)


@compilable
def next_step(controllers: Controllers) -> int:
    """Return the step before which a controller acts next."""
    first = NEVER
    for robot in range(len(controllers.events)):
        first = min(first, controllers.events[robot][NEXT])
    return first


@compilable
def control(simulated: Simulated, controllers: Controllers) -> bool:
    """Let the controllers do what is due; return False if a speed is not finite."""
    for robot in range(len(simulated.robots)):
        event = controllers.events[robot]
        while event[NEXT] <= simulated.counters[STEPS]:
            if not _act(simulated, controllers, robot):
                return False
    return True


@compilable
def drive_later(
    simulated: Simulated, controllers: Controllers, robot: int, left: float, right: float
) -> bool:
    """Send the caller's speeds [pulses/10 ms] over the line; return False if they are not finite."""
    event = controllers.events[robot]
    if not drive(controllers.seen[robot], left, right):
        return False
    send_speeds(event, controllers.line, controllers.seen[robot])
    set_next(event, controllers.line, simulated.timing.step_ns)
    return True


@compilable
def _act(simulated: Simulated, controllers: Controllers, robot: int) -> bool:
    """Do what is due on a robot's line; return False if a speed is not finite."""
    state, line = simulated.robots[robot], controllers.line
    registers, ambient = state.registers, state.sensors.ambient
    event, seen = controllers.events[robot], controllers.seen[robot]
    is_driven = controllers.kind != CONSTANT_SPEED and state.processor[kernel.POWERED]
    if event[STAGE] < len(line) - REQUESTED:
        if answer(event, line, registers, seen):
            if controllers.kind == CALLER:
                event[NEXT] = NEVER
                return True
            if is_driven and not _decide(seen, controllers, robot, ambient.dark, ambient.floor):
                return False
            send_speeds(event, line, seen)
    else:
        if is_driven:
            kernel.set_speed(registers, 0, seen[_LEFT_SETPOINT])
            kernel.set_speed(registers, _RIGHT, seen[_RIGHT_SETPOINT])
        at = pose(simulated.scene, state.pose)
        period = end_cycle(event, line) / units.STEP_NS * _CONVERSION
        add_period(seen, controllers.sums[robot], controllers.home, ambient.dark, ambient.floor, at, period)
    set_next(event, line, simulated.timing.step_ns)
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
def _decide(
    registers: kernel.Registers, controllers: Controllers, robot: int, dark: float, floor: float
) -> bool:
    """Set the speeds that a controller decides on; return False if one is not finite."""
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
