"""An episode without a serial line: scan, physics, control loops and controller in one loop.

The order and the results are those of `khep_twin.world.World.advance_to`, bit for bit. The controller
replaces the line's bytes: at the start of every control period it reads the registers and sets both wheels'
speeds in them at once, as the firmware would on a command D.

Like `kernel`, this is plain arithmetic that runs interpreted and compiled; `episode` provides its data.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.rollout import fitness, networks
from khep_twin.sensing import optics, raycast
from khep_twin.sensing.buffers import Vector

CONSTANT_SPEED, BRAITENBERG, NETWORK, FUNCTION = 0, 1, 2, 3
"""Kinds of controller: none (constant speeds), the ROM's Braitenberg vehicle, a network, a function."""

FINE, WARNED, OUT_OF_BOUNDS, NO_SPEED = 0, 1, 2, 3
"""Status of an episode: fine, warned by MuJoCo, physics out of bounds, controller's speed is no number."""

STEPS, POWERED, DEMO, TERMINATION = 0, 1, 2, 3
"""Indices in `RobotState.state`: steps done, whether the processor runs, whether the demo runs, status."""
N_STATE = 4

PERIODS, AVOIDANCE, SEEKING, HOMING, FOLLOWING, DISTANCE, CHARGE, LAST_X, LAST_Y = 0, 1, 2, 3, 4, 5, 6, 7, 8
"""Indices in `ControllerState.sums`: control periods, sums of fitness over them, distance [m], charge left
[s], last position of the robot [m]."""
FORWARD = 9
"""Index in `ControllerState.sums` of the distance forwards less that backwards [m]."""
N_SUMS = 10

FASTEST = 1000.0
"""Largest speed of a joint [m/s or rad/s], as in the world."""

_SPEED_LIMIT = 127
_CONVERSION = units.STEP_NS * 1e-9
_PROXIMITY, _AMBIENT, _SCAN = (int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT), int(kernel.Board.SCAN))
_RIGHT = kernel.RIGHT
_LEFT_SETPOINT, _RIGHT_SETPOINT = kernel.SETPOINTS
_LEFT_DUTY, _RIGHT_DUTY = kernel.DUTIES
_SIDES = (int(units.Sensor.LEFT_90), int(units.Sensor.RIGHT_90))
_N = units.N_SENSORS
_LEFT_ENCODER, _RIGHT_ENCODER = int(kernel.Wheel.ENCODER), kernel.RIGHT + int(kernel.Wheel.ENCODER)


class SimIndices(NamedTuple):
    """Indices of the robot in the scene's arrays, and divisions of time.

    Attributes:
        left_angle: Index of the left wheel's angle in qpos.
        right_angle: Index of the right wheel's angle in qpos.
        left_motor: Index of the left motor in ctrl and forces.
        right_motor: Index of the right motor in ctrl and forces.
        pose: Index of the robot's pose in qpos.
        motor_constant: Torque per current [N m/A].
        limit: Largest coordinate [m].
        conversions: Sensor conversions in each step.
        steps_per_tick: Steps per tick of the control loops.
        steps_per_supply: Steps per measurement of the supply.
        steps_per_period: Steps per period of the controller.
    """

    left_angle: int
    right_angle: int
    left_motor: int
    right_motor: int
    pose: int
    motor_constant: float
    limit: float
    conversions: int
    steps_per_tick: int
    steps_per_supply: int
    steps_per_period: int


class RobotState(NamedTuple):
    """A robot in its scene.

    Attributes:
        scene: Scene as the robot's sensors see it.
        proximity: Model of proximity.
        ambient: Model of ambient light.
        bulbs: Bulbs that may shine.
        indices: Indices in the scene's arrays, and divisions of time.
        registers: State of the board.
        qpos: Positions of the scene's joints, live.
        qvel: Speeds of the scene's joints, live.
        ctrl: Motor voltages, live.
        force: Actuator forces, live.
        positions: Positions of the scene's bodies, live, flattened [m].
        warnings: Counters of MuJoCo's warnings, live.
        state: State of the episode, integers (N_STATE,).
        voltage: Supply voltage (1,) [V].
    """

    scene: raycast.Scene
    proximity: optics.Proximity
    ambient: optics.Ambient
    bulbs: optics.Bulbs
    indices: SimIndices
    registers: kernel.Registers
    qpos: Vector[float]
    qvel: Vector[float]
    ctrl: Vector[float]
    force: Vector[float]
    positions: Vector[float]
    warnings: Vector[int]
    state: Vector[int]
    voltage: Vector[float]


class ControllerState(NamedTuple):
    """Controller of a robot, and its sums of fitness.

    Attributes:
        kind: CONSTANT_SPEED, BRAITENBERG, NETWORK or FUNCTION.
        function: Address of a compiled function, or the function itself where nothing is compiled.
        sizes: Sizes of the network: inputs, layers, outputs.
        recurrent: Whether the network has feedback.
        top_speed: Speed for an output of 1 [pulses/10 ms].
        genes: Weights of the network, or parameters of the function.
        memory: Memory kept from one control period to the next.
        values: Buffer for the network's values.
        speeds: Buffer for the speeds of a function (2,) [pulses/10 ms].
        home: Home x, y and radius [m], and duration of the charge [s]; radius 0 for none.
        sums: Sums over the episode (N_SUMS,).
    """

    kind: int
    function: Any
    sizes: Vector[int]
    recurrent: bool
    top_speed: float
    genes: Vector[float]
    memory: Vector[float]
    values: Vector[float]
    speeds: Vector[float]
    home: Vector[float]
    sums: Vector[float]


class StepInputs(NamedTuple):
    """Random draws and supply of some steps.

    Attributes:
        powers: Powers of the lamps (n_steps or 1, n_lamps) [W].
        volts: Supply voltage at each measurement (n_feeds,) [V].
        noisy: Whether sensors are noisy; if not, the next three are not used.
        proximity: Standard normal draws (n_conversions,).
        ambient: Standard normal draws (n_conversions,).
        idle: Standard exponential draws (n_conversions,).
    """

    powers: Sequence[Sequence[float]]
    volts: Sequence[float]
    noisy: bool
    proximity: Sequence[float]
    ambient: Sequence[float]
    idle: Sequence[float]


Advance = Callable[[RobotState, ControllerState, StepInputs, int], int]


def advance(robot: RobotState, controller: ControllerState, inputs: StepInputs, n_steps: int) -> int:
    """Run the episode for some steps; return its status, FINE or the reason why it ended.

    Each step runs in this order:

        1. at the start of a control period the controller, and its fitness
        2. physics, with the motor voltages of the last control tick
        3. the sensors due are converted, at the pose of the step's start
        4. every 10 ms the control tick: encoders, speed, controllers, duty, voltage
        5. every 20 ms the supply is measured

    Args:
        robot: Robot in its scene.
        controller: Controller of the robot.
        inputs: Random draws and supply of these steps.
        n_steps: Number of steps, below 0 to switch the robot on: the scan before time 0, so that every
            register holds a conversion, with encoders and supply.
    """
    # Functions are passed only the parts that they need: passing whole bodies makes compiling slow.
    state, indices, registers, qpos = robot.state, robot.indices, robot.registers, robot.qpos
    conversions, dark, floor = indices.conversions, robot.ambient.dark, robot.ambient.floor
    on, n_supplies = n_steps >= 0, 0
    if not on:
        raycast.step(robot.scene)
    for i in range(n_steps if on else _N // conversions):
        step = state[STEPS] if on else i
        if on and step % indices.steps_per_period == 0:
            if state[POWERED] and not _control(registers, controller, dark, floor):
                state[TERMINATION] = NO_SPEED
                break
            period = indices.steps_per_period * conversions * _CONVERSION
            position = qpos[indices.pose], qpos[indices.pose + 1]
            ahead = raycast.heading(qpos, indices.pose)
            note(registers, controller.sums, controller.home, dark, floor, position, ahead, period)
        raycast.step(robot.scene)
        row = 0 if len(inputs.powers) == 1 else i
        for turn in range(conversions):
            noise, draw = (0.0, 0.0, 0.0), i * conversions + turn
            if inputs.noisy:
                noise = (inputs.proximity[draw], inputs.ambient[draw], inputs.idle[draw])
            channel = (step * conversions + turn) % _N
            proximity, ambient = optics.convert(
                robot.scene, robot.proximity, robot.ambient, robot.bulbs, inputs.powers[row], channel, noise
            )
            kernel.convert(registers, proximity, ambient)
        if not on:
            continue
        state[STEPS] = step + 1
        if (step + 1) % indices.steps_per_tick == 0:
            if not _fits(robot.positions, robot.qvel, qpos, indices.limit):
                state[TERMINATION] = OUT_OF_BOUNDS
                break
            _tick(indices, registers, state, qpos, robot.ctrl, robot.voltage[0])
        if (step + 1) % indices.steps_per_supply == 0:
            if _warned(robot.warnings):
                state[TERMINATION] = WARNED
                break
            robot.voltage[0] = inputs.volts[n_supplies]
            _update_supply(indices, registers, state, robot.force, robot.voltage[0])
            n_supplies += 1
    if not on:
        registers[_LEFT_ENCODER] = units.wheel_pulses(qpos[indices.left_angle])
        registers[_RIGHT_ENCODER] = units.wheel_pulses(qpos[indices.right_angle])
        robot.voltage[0] = inputs.volts[0]
        _update_supply(indices, registers, state, robot.force, robot.voltage[0])
        if not _fits(robot.positions, robot.qvel, qpos, indices.limit):
            state[TERMINATION] = OUT_OF_BOUNDS
        elif _warned(robot.warnings):
            state[TERMINATION] = WARNED
    return state[TERMINATION]


def note(
    registers: kernel.Registers,
    sums: Vector[float],
    home: Vector[float],
    dark: float,
    floor: float,
    position: tuple[float, float],
    ahead: tuple[float, float],
    period: float,
) -> None:
    """Add the fitness at the start of a control period, with the speeds just set.

    Args:
        registers: State of the board.
        sums: Sums over the episode, changed in place (N_SUMS,).
        home: Home as in `ControllerState`.
        dark: Ambient reading in the dark [counts].
        floor: Ambient reading in the brightest light [counts].
        position: Robot x and y [m].
        ahead: Cosine and sine of the robot's heading.
        period: Control period [s].
    """
    nearest, darkest = registers[_PROXIMITY], registers[_AMBIENT]
    for sensor in range(1, _N):
        nearest = max(nearest, registers[_PROXIMITY + sensor])
        darkest = min(darkest, registers[_AMBIENT + sensor])
    side = max(registers[_PROXIMITY + _SIDES[0]], registers[_PROXIMITY + _SIDES[1]]) / units.COUNTS_LIMIT
    left, right = float(registers[_LEFT_SETPOINT]), float(registers[_RIGHT_SETPOINT])
    part = nearest / units.COUNTS_LIMIT
    x, y = position
    dx, dy = x - sums[LAST_X], y - sums[LAST_Y]
    if sums[PERIODS] > 0:
        sums[DISTANCE] += math.sqrt(dx * dx + dy * dy)
        sums[FORWARD] += dx * ahead[0] + dy * ahead[1]
    sums[LAST_X], sums[LAST_Y] = x, y
    sums[PERIODS] += 1
    sums[AVOIDANCE] += fitness.obstacle_avoidance(left, right, part)
    sums[SEEKING] += fitness.light_seeking(float(darkest), dark, floor)
    sums[FOLLOWING] += fitness.wall_following(left, right, side)
    if home[2] > 0 and sums[CHARGE] > 0:
        dx, dy = x - home[0], y - home[1]
        if dx * dx + dy * dy <= home[2] * home[2]:
            sums[CHARGE] = home[3]  # at home the fitness is 0 and the cells are full at once
        else:
            sums[HOMING] += fitness.homing(left, right, part)
            sums[CHARGE] -= period


def drive(registers: kernel.Registers, left: float, right: float) -> bool:
    """Set both speeds [pulses/10 ms] as command D does, rounded and clipped; return False if not finite."""
    if not (math.isfinite(left) and math.isfinite(right)):
        return False
    limit = float(_SPEED_LIMIT)
    kernel.set_speed(registers, 0, round(min(max(left, -limit), limit)))
    kernel.set_speed(registers, _RIGHT, round(min(max(right, -limit), limit)))
    return True


def _control(registers: kernel.Registers, controller: ControllerState, dark: float, floor: float) -> bool:
    """Run the controller once; return False if a speed is not finite."""
    if controller.kind == BRAITENBERG:
        kernel.wander(registers)
    elif controller.kind == NETWORK:
        values = controller.values
        for sensor in range(_N):
            values[sensor] = registers[_PROXIMITY + sensor] / units.COUNTS_LIMIT
        for sensor in range(controller.sizes[0] - _N):
            values[_N + sensor] = (dark - registers[_AMBIENT + sensor]) / (dark - floor)
        out = networks.forward(
            controller.sizes, controller.recurrent, controller.genes, controller.memory, values
        )
        return drive(registers, controller.top_speed * values[out], controller.top_speed * values[out + 1])
    elif controller.kind == FUNCTION:
        raycast.decide(controller.function, registers, controller.memory, controller.genes, controller.speeds)
        return drive(registers, controller.speeds[0], controller.speeds[1])
    return True


def _tick(
    indices: SimIndices,
    registers: kernel.Registers,
    state: Vector[int],
    qpos: Vector[float],
    ctrl: Vector[float],
    voltage: float,
) -> None:
    """Run the board's own control loops once, from encoders to motor voltages."""
    if state[POWERED]:
        left = units.wheel_pulses(qpos[indices.left_angle])
        right = units.wheel_pulses(qpos[indices.right_angle])
        kernel.tick(registers, left, right)
        if state[DEMO] and registers[_SCAN] == 0:
            kernel.wander(registers)
    ctrl[indices.left_motor] = units.duty_voltage(registers[_LEFT_DUTY], voltage)
    ctrl[indices.right_motor] = units.duty_voltage(registers[_RIGHT_DUTY], voltage)


def _update_supply(
    indices: SimIndices, registers: kernel.Registers, state: Vector[int], force: Vector[float], voltage: float
) -> None:
    """Measure the supply; below its minimum voltage reset and stop the processor."""
    left, right = registers[_LEFT_DUTY], registers[_RIGHT_DUTY]
    current = units.IDLE_CURRENT
    current += units.supply_current(left, force[indices.left_motor] / indices.motor_constant)
    current += units.supply_current(right, force[indices.right_motor] / indices.motor_constant)
    kernel.measure(registers, units.supply_counts(voltage), round(current * 1000))
    if voltage < units.PROCESSOR_VOLTAGE and state[POWERED]:
        kernel.reset(registers)
        registers[_LEFT_DUTY], registers[_RIGHT_DUTY] = left, right
        state[POWERED] = 0


def _fits(positions: Vector[float], speeds: Vector[float], joints: Vector[float], limit: float) -> bool:
    """Return whether a state is within the bounds of the physics."""
    if not _square(positions) <= len(positions) * limit * limit:
        return False
    return _square(speeds) <= len(speeds) * FASTEST * FASTEST and _square(joints) < math.inf


def _warned(warnings: Vector[int]) -> bool:
    """Return whether MuJoCo has warned."""
    for i in range(len(warnings)):
        if warnings[i]:
            return True
    return False


def _square(numbers: Vector[float]) -> float:
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i] * numbers[i]
    return total
