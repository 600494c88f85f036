"""Controllers of robots within the stepping core, and the sums of their metrics.

A controller replaces the bytes on the line. Once per control period it reads the registers and sets the
speeds of both wheels in them, as the firmware does on a command D: immediately, or at the times of a `line`.
Like the core, this is plain arithmetic that runs interpreted and compiled; `episode` provides the data.
All robots of an episode are of one model, whose registers `robots.core.Interface` describes.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
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
from khep_twin.robots.core import (
    Registers,
    RobotState,
    interface_of,
    is_powered,
    set_speeds,
    update_registers,
    wander,
)
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import pose
from khep_twin.sensing.simulated import PHASE, STEPS, Simulated, StepInputs
from khep_twin.step import Phase, Reason, Stop, advance, switch_on

CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION, CALLER = 0, 1, 2, 3, 4
"""Kinds of controller: none (constant speeds), the robot's Braitenberg vehicle, a network, a function, and
the caller of the core, which sets speeds after each reading at a line."""

N_SCALE = 4
TERM_REGISTER, LOWEST, HIGHEST, ZERO = range(N_SCALE)
"""Columns of `Controllers.terms`."""

_STEP_S = units.STEP_NS * 1e-9

Records = Any
"""Arrays of records, whose fields numba infers."""


class Controllers(NamedTuple):
    """Controllers of one kind for the robots of a scene, and their sums of metrics.

    Attributes:
        kind: CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION or CALLER.
        function: Address of a compiled function, or the Python function if episodes run uncompiled.
        sizes: Sizes of the network: inputs, layers, outputs.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [register].
        terms: Register, lowest and highest value, and value of 0 of each of a network's further inputs
            (n, N_SCALE).
        genes: Weights of the networks, or parameters of the functions (n_robots, n_genes).
        memory: Memories between control periods (n_robots, n_memory).
        neurons: Buffer for the values of a network's neurons.
        outputs: Speeds of a function [register], and values of commands to turrets (n_robots, n_outputs).
        home: Home x, y and radius [m], and time for which a full battery lasts [s] (4,); radius 0 for none.
        sums: Sums over the episode, see `metrics` (n_robots, N_SUMS).
        line: Times of the line, see `line.line_times`.
        events: Events of the robots' lines (n_robots, N_EVENT).
        host_registers: Registers as read by the controllers, then readings of turrets (n_robots, n).
    """

    kind: int
    function: Any
    sizes: Vector[int]
    recurrent: bool
    top_speed: float
    terms: Any
    genes: Any
    memory: Any
    neurons: Vector[float]
    outputs: NDArray[np.float64]
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
        speeds: Speeds to set first [register], and commands (n, n_robots, n_outputs); (0, …) for none.
        reasons: `Reason` of each return, filled in (n,).
        registers: Final registers of the robots, filled in (n, n_robots, n_registers).
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
    def of(cls, count: int, n_robots: int, n_registers: int, n_outputs: int = 2) -> Self:
        """Return arrays for `count` slots, filled with zeros."""
        return cls(
            np.zeros((count, 0), np.int64),
            np.arange(count),
            np.zeros(count, np.int64),
            np.zeros((count, n_robots, n_outputs)),
            np.zeros(count, np.int64),
            np.zeros((count, n_robots, n_registers), np.int64),
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
            if not control(simulated, inputs, controllers):
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
                is_driven = drive(state, left, right)
            if not is_driven:
                reason = Reason.NO_SPEED
    if reason == Reason.DONE:
        reason = run(controllers, simulated, inputs, end_step, stops)
    if slot >= 0:
        slots.reasons[slot] = reason
        observe(simulated, inputs, controllers, slots, slot)
    return reason


@compilable
def observe(
    simulated: Simulated, inputs: StepInputs, controllers: Controllers, slots: SlotArrays, slot: int
) -> None:
    """Copy registers (at a line as last read) and poses of an episode's robots into the arrays of a slot."""
    for robot in range(len(simulated.groups[0])):
        state = simulated.groups[0][robot]
        if controllers.kind != CALLER:
            update_registers(state, simulated, inputs)
        for index in range(slots.registers.shape[2]):
            if controllers.kind == CALLER or index >= interface_of(state).n_registers:
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
def control(simulated: Simulated, inputs: StepInputs, controllers: Controllers) -> bool:
    """Handle all due events of the controllers; return False if a speed is not finite."""
    for robot in range(len(simulated.groups[0])):
        event = controllers.events[robot]
        while event[NEXT_STEP] <= simulated.counters[STEPS]:
            if not _handle_event(simulated, inputs, controllers, robot):
                return False
    return True


@compilable
def drive_by_line(
    simulated: Simulated, controllers: Controllers, robot: int, left: float, right: float
) -> bool:
    """Send the caller's speeds [register] over the line; return False if they are not finite."""
    event, state = controllers.events[robot], simulated.groups[0][robot]
    if not _set_setpoints(state, controllers.host_registers[robot], left, right):
        return False
    send_speeds(event, controllers.line, controllers.host_registers[robot], interface_of(state))
    set_next_step(event, controllers.line, simulated.timing.step_ns)
    return True


@compilable
def _handle_event(simulated: Simulated, inputs: StepInputs, controllers: Controllers, robot: int) -> bool:
    """Handle the due event of a robot's line; return False if a speed is not finite."""
    state, line = simulated.groups[0][robot], controllers.line
    interface, ambient = interface_of(state), state.sensors.ambient
    event, host_registers = controllers.events[robot], controllers.host_registers[robot]
    is_driven = controllers.kind != CONSTANT_SPEED and is_powered(state)
    if event[STAGE] < len(line) - FIRST_REQUEST:
        update_registers(state, simulated, inputs)
        if answer_request(event, line, state.registers, host_registers, interface):
            if controllers.kind == CALLER:
                event[NEXT_STEP] = NEVER
                return True
            if is_driven and not _decide(state, host_registers, controllers, robot):
                return False
            send_speeds(event, line, host_registers, interface)
    else:
        if is_driven:
            left, right = interface.setpoints[0], interface.setpoints[1]
            set_speeds(state, host_registers[left], host_registers[right])
        robot_pose, sums, home = pose(simulated.scene, state.pose), controllers.sums[robot], controllers.home
        period = end_cycle(event, line) / units.STEP_NS * _STEP_S
        lights = ambient.dark, ambient.floor
        add_period(host_registers, interface, sums, home, lights, robot_pose, period)
    set_next_step(event, line, simulated.timing.step_ns)
    return True


@compilable
def drive(robot: RobotState, left: float, right: float) -> bool:
    """Set both speeds of a powered robot [register], rounded and clipped; return False if not finite."""
    if not is_powered(robot):
        return True
    if not (math.isfinite(left) and math.isfinite(right)):
        return False
    limit = float(interface_of(robot).speed_limit)
    set_speeds(robot, round(min(max(left, -limit), limit)), round(min(max(right, -limit), limit)))
    return True


@compilable
def _set_setpoints(robot: RobotState, registers: Registers, left: float, right: float) -> bool:
    """Set both setpoints in registers as `drive` does; return False if a speed is not finite."""
    if not (math.isfinite(left) and math.isfinite(right)):
        return False
    interface = interface_of(robot)
    limit = float(interface.speed_limit)
    registers[interface.setpoints[0]] = round(min(max(left, -limit), limit))
    registers[interface.setpoints[1]] = round(min(max(right, -limit), limit))
    return True


@compilable
def _decide(robot: RobotState, registers: Registers, controllers: Controllers, index: int) -> bool:
    """Let a controller set the setpoints in registers; return False if a speed is not finite."""
    if controllers.kind == BRAITENBERG:
        wander(robot, registers)
    elif controllers.kind == NETWORK:
        neurons, interface, ambient = controllers.neurons, interface_of(robot), robot.sensors.ambient
        first, end = interface.proximity
        n_sensors, dark, floor = end - first, ambient.dark, ambient.floor
        for sensor in range(n_sensors):
            neurons[sensor] = registers[first + sensor] / interface.counts[1]
        first_term = controllers.sizes[0] - len(controllers.terms)
        for reading in range(len(controllers.terms)):
            term = controllers.terms[reading]
            value = min(max(float(registers[int(term[TERM_REGISTER])]), term[LOWEST]), term[HIGHEST])
            neurons[first_term + reading] = (value - term[ZERO]) / (term[HIGHEST] - term[ZERO])
        for sensor in range(first_term - n_sensors):
            neurons[n_sensors + sensor] = (dark - registers[interface.ambient[0] + sensor]) / (dark - floor)
        genes, memory = controllers.genes[index], controllers.memory[index]
        output = networks.forward(controllers.sizes, controllers.recurrent, genes, memory, neurons)
        top_speed = controllers.top_speed
        for command in range(2, controllers.sizes[len(controllers.sizes) - 1]):
            controllers.outputs[index][command] = neurons[output + command]
        return _set_setpoints(robot, registers, top_speed * neurons[output], top_speed * neurons[output + 1])
    elif controllers.kind == FUNCTION:
        memory, outputs = controllers.memory[index], controllers.outputs[index]
        call_function(controllers.function, registers, memory, controllers.genes[index], outputs)
        return _set_setpoints(robot, registers, outputs[0], outputs[1])
    return True


def call_function(
    function: Callable[..., tuple[float, ...]],
    registers: Registers,
    memory: Vector[float],
    genes: Vector[float],
    outputs: NDArray[np.float64],
) -> None:
    """Call a controller; compiled code calls it by address.

    Args:
        function: Function of registers, memory and genes.
        registers: Registers of the robot (n_registers,).
        memory: State of the controller.
        genes: Parameters of the controller, read-only.
        outputs: Buffer for the returned numbers (n_outputs,); NaN after an arithmetic error such as a
            division by 0.
    """
    try:
        outputs[:] = function(registers, memory, genes)
    except ArithmeticError:
        outputs[:] = math.nan
