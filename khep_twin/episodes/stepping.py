"""Controllers of robots within the stepping core, and the sums of their metrics.

A controller replaces the bytes on the line. Once per control period it reads the registers and sets the
speeds of both wheels in them, as the firmware does on a command D: immediately, or at the times of a `line`.
Like the core, this is plain arithmetic that runs interpreted and compiled; `episode` provides the data.
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
    FIRST_REQUEST,
    NEVER,
    NEXT_STEP,
    STAGE,
    answer_request,
    end_cycle,
    send_speeds,
    set_next_step,
)
from khep_twin.episodes.metrics import add_period
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import decide, pose
from khep_twin.step import PHASE, STEPS, Phase, Reason, Simulated, StepInputs, Stop, advance, switch_on

CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION, CALLER = 0, 1, 2, 3, 4
"""Kinds of controller: none (constant speeds), the ROM's Braitenberg vehicle, a network, a function, and the
caller of the core, which sets speeds after each reading at a line."""

_SPEED_LIMIT = 127
_STEP_S = units.STEP_NS * 1e-9
_LEFT_SETPOINT, _RIGHT_SETPOINT = kernel.SETPOINTS
_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)


Records = Any
"""Arrays of records, whose fields numba infers."""


class Controllers(NamedTuple):
    """Controllers of one kind for the robots of a scene, and their sums of metrics.

    Attributes:
        kind: CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION or CALLER.
        function: Address of a compiled function, or the Python function if episodes run uncompiled.
        sizes: Sizes of the network: inputs, layers, outputs.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        genes: Weights of the networks, or parameters of the functions (n_robots, n_genes).
        memory: Memories between control periods (n_robots, n_memory).
        neurons: Buffer for the values of a network's neurons.
        speeds: Buffer for the speeds of a function (2,) [pulses/10 ms].
        home: Home x, y and radius [m], and time for which a full battery lasts [s] (4,); radius 0 for none.
        sums: Sums over the episode, see `metrics` (n_robots, N_SUMS).
        line: Times of the line, see `line.line_times`.
        events: Events of the robots' lines (n_robots, N_EVENT).
        host_registers: States of the boards as read by the controllers (n_robots, N_REGISTERS).
    """

    kind: int
    function: Any
    sizes: Vector[int]
    recurrent: bool
    top_speed: float
    genes: Any
    memory: Any
    neurons: Vector[float]
    speeds: Vector[float]
    home: Vector[float]
    sums: Any
    line: Vector[int]
    events: Any
    host_registers: Any


class EpisodeArguments(NamedTuple):
    """Arguments of compiled code for one episode: `Controllers`, then those of `Simulation.arguments`."""

    controllers: Records
    scene: Records
    timing: Records
    law: Records
    bulbs: Records
    hidden: Records
    groups: Records
    counters: Records
    powers: Records
    tables: Records


class SlotArrays(NamedTuple):
    """Arrays of n slots, each of which runs one episode at a time. One call runs several slots in sequence.

    Attributes:
        addresses: Addresses of the arrays of each slot's `EpisodeArguments` (n, n_arrays).
        indices: Indices of the slots to run (n_slots,).
        end_steps: Number of steps since the start at which each episode stops (n,).
        speeds: Speeds of the wheels to set first (n, n_robots, 2) [pulses/10 ms]; (0, n_robots, 2) for none.
        reasons: `Reason` of each return, filled in (n,).
        registers: Final states of the boards, filled in (n, n_robots, N_REGISTERS).
        poses: Final true x, y [m] and heading [rad], filled in (n, n_robots, 3).
    """

    addresses: NDArray[np.int64]
    indices: NDArray[np.int64]
    end_steps: NDArray[np.int64]
    speeds: NDArray[np.float64]
    reasons: NDArray[np.int64]
    registers: NDArray[np.int64]
    poses: NDArray[np.float64]

    @classmethod
    def of(cls, count: int, n_robots: int, n_arrays: int) -> Self:
        """Return arrays for `count` slots, filled with zeros."""
        return cls(
            np.zeros((count, n_arrays), np.int64),
            np.arange(count),
            np.zeros(count, np.int64),
            np.zeros((count, n_robots, 2)),
            np.zeros(count, np.int64),
            np.zeros((count, n_robots, kernel.N_REGISTERS), np.int64),
            np.zeros((count, n_robots, 3)),
        )


NO_SLOTS = SlotArrays.of(0, 0, 0)
"""No slots: the call runs the episode of its other arguments."""

Run = Callable[..., int]
"""Type of `run`; its compiled form takes the fields of `EpisodeArguments`, end step, stops and
`SlotArrays`."""


@compilable
def run(controllers: Controllers, simulated: Simulated, inputs: StepInputs, end_step: int, stops: int) -> int:
    """Run steps with controllers, as `step.advance` does without them.

    Args:
        controllers: Controllers of the robots.
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        end_step: Number of steps since the start of the run; below 0 to switch the robots on.
        stops: Sum of `Stop` values at which to return earlier.
    """
    if end_step < 0:
        return switch_on(simulated, inputs)
    counters = simulated.counters
    while True:
        if counters[PHASE] == Phase.DONE and counters[STEPS] < end_step:
            if not control(simulated, controllers):
                return Reason.NO_SPEED
        next_event = next_step(controllers)
        if next_event == NEVER and stops & Stop.AWAITED:
            return Reason.DONE
        reason = advance(simulated, inputs, min(next_event, end_step), stops)
        if reason != Reason.DONE or counters[STEPS] == end_step:
            return reason


@compilable
def run_slot(
    controllers: Controllers,
    simulated: Simulated,
    inputs: StepInputs,
    end_step: int,
    stops: int,
    slots: SlotArrays,
    index: int,
) -> int:
    """Run the episode of slot `slots.indices[index]` with its speeds; without slots, the given episode."""
    # `run` has a single call, as compiled code contains one copy per call.
    slot, reason = -1, Reason.DONE
    if len(slots.indices) > 0:
        slot = slots.indices[index]
        end_step = int(slots.end_steps[slot])
        for robot in range(len(simulated.groups[0]) if len(slots.speeds) else 0):
            state = simulated.groups[0][robot]
            left, right = slots.speeds[slot, robot, 0], slots.speeds[slot, robot, 1]
            if controllers.kind == CALLER:
                is_driven = drive_by_line(simulated, controllers, robot, left, right)
            else:
                is_driven = not state.processor[kernel.POWERED] or drive(state.registers, left, right)
            if not is_driven:
                reason = Reason.NO_SPEED
    if reason == Reason.DONE:
        reason = run(controllers, simulated, inputs, end_step, stops)
    if slot >= 0:
        slots.reasons[slot] = reason
        observe(simulated, controllers, slots, slot)
    return reason


@compilable
def observe(simulated: Simulated, controllers: Controllers, slots: SlotArrays, slot: int) -> None:
    """Copy registers (at a line as last read) and poses of an episode's robots into the arrays of a slot."""
    for robot in range(len(simulated.groups[0])):
        state = simulated.groups[0][robot]
        for index in range(kernel.N_REGISTERS):
            if controllers.kind == CALLER:
                slots.registers[slot, robot, index] = controllers.host_registers[robot][index]
            else:
                slots.registers[slot, robot, index] = state.registers[index]
        x, y, cosine, sine = pose(simulated.scene, state.pose)
        slots.poses[slot, robot, 0] = x
        slots.poses[slot, robot, 1] = y
        slots.poses[slot, robot, 2] = math.atan2(sine, cosine)


@compilable
def next_step(controllers: Controllers) -> int:
    """Return the step before which the next event of a controller is handled."""
    earliest = NEVER
    for robot in range(len(controllers.events)):
        earliest = min(earliest, controllers.events[robot][NEXT_STEP])
    return earliest


@compilable
def control(simulated: Simulated, controllers: Controllers) -> bool:
    """Handle all due events of the controllers; return False if a speed is not finite."""
    for robot in range(len(simulated.groups[0])):
        event = controllers.events[robot]
        while event[NEXT_STEP] <= simulated.counters[STEPS]:
            if not _handle_event(simulated, controllers, robot):
                return False
    return True


@compilable
def drive_by_line(
    simulated: Simulated, controllers: Controllers, robot: int, left: float, right: float
) -> bool:
    """Send the caller's speeds [pulses/10 ms] over the line; return False if they are not finite."""
    event = controllers.events[robot]
    if not drive(controllers.host_registers[robot], left, right):
        return False
    send_speeds(event, controllers.line, controllers.host_registers[robot])
    set_next_step(event, controllers.line, simulated.timing.step_ns)
    return True


@compilable
def _handle_event(simulated: Simulated, controllers: Controllers, robot: int) -> bool:
    """Handle the due event of a robot's line; return False if a speed is not finite."""
    state, line = simulated.groups[0][robot], controllers.line
    registers, ambient = state.registers, state.sensors.ambient
    event, host_registers = controllers.events[robot], controllers.host_registers[robot]
    is_driven = controllers.kind != CONSTANT_SPEED and state.processor[kernel.POWERED]
    if event[STAGE] < len(line) - FIRST_REQUEST:
        if answer_request(event, line, registers, host_registers):
            if controllers.kind == CALLER:
                event[NEXT_STEP] = NEVER
                return True
            if is_driven and not _decide(host_registers, controllers, robot, ambient.dark, ambient.floor):
                return False
            send_speeds(event, line, host_registers)
    else:
        if is_driven:
            kernel.set_speed(registers, 0, host_registers[_LEFT_SETPOINT])
            kernel.set_speed(registers, kernel.RIGHT, host_registers[_RIGHT_SETPOINT])
        robot_pose, sums, home = pose(simulated.scene, state.pose), controllers.sums[robot], controllers.home
        period = end_cycle(event, line) / units.STEP_NS * _STEP_S
        add_period(host_registers, sums, home, ambient.dark, ambient.floor, robot_pose, period)
    set_next_step(event, line, simulated.timing.step_ns)
    return True


@compilable
def drive(registers: kernel.Registers, left: float, right: float) -> bool:
    """Set both speeds [pulses/10 ms] as command D does, rounded and clipped; return False if not finite."""
    if not (math.isfinite(left) and math.isfinite(right)):
        return False
    limit = float(_SPEED_LIMIT)
    kernel.set_speed(registers, 0, round(min(max(left, -limit), limit)))
    kernel.set_speed(registers, kernel.RIGHT, round(min(max(right, -limit), limit)))
    return True


@compilable
def _decide(
    registers: kernel.Registers, controllers: Controllers, robot: int, dark: float, floor: float
) -> bool:
    """Let a controller set the speeds; return False if one is not finite."""
    if controllers.kind == BRAITENBERG:
        kernel.wander(registers)
    elif controllers.kind == NETWORK:
        neurons = controllers.neurons
        for sensor in range(units.N_SENSORS):
            neurons[sensor] = registers[_PROXIMITY + sensor] / units.COUNTS_LIMIT
        for sensor in range(controllers.sizes[0] - units.N_SENSORS):
            neurons[units.N_SENSORS + sensor] = (dark - registers[_AMBIENT + sensor]) / (dark - floor)
        genes, memory = controllers.genes[robot], controllers.memory[robot]
        output = networks.forward(controllers.sizes, controllers.recurrent, genes, memory, neurons)
        top_speed = controllers.top_speed
        return drive(registers, top_speed * neurons[output], top_speed * neurons[output + 1])
    elif controllers.kind == FUNCTION:
        genes, memory, speeds = controllers.genes[robot], controllers.memory[robot], controllers.speeds
        decide(controllers.function, registers, memory, genes, speeds)
        return drive(registers, speeds[0], speeds[1])
    return True
