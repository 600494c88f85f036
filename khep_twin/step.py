"""One step of the simulation: physics, sensors, control and supply, in this order.

    1. physics, with the motor voltages of the last control tick; one step of it may span several steps
    2. the next sensor of each robot is converted at the pose before the physics step
    3. every 10 ms the control tick: encoders, speed, controllers, duty, voltage
    4. every 20 ms the supply is measured; below its minimum voltage the processor stops

`advance` runs steps until code outside must act, for example for alternating lamps or turrets. It then
returns, and resumes from there when it is called again. It uses only numbers, arrays and named tuples, and
runs plain and compiled; `khep_twin.simulation` provides the data.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

from khep_twin import units
from khep_twin.board import battery, kernel
from khep_twin.compilable import compilable, compilable_once
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.light import Light
from khep_twin.sensing.noise import Tables, draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import (
    Scene,
    has_warned,
    in_bounds,
    joint_position,
    joint_speed,
    motor_torque,
    set_motor,
    step,
)


class Reason(IntEnum):
    """Reason for which `advance` returns; those from WARNED on end a run."""

    DONE = 0  # all steps are done
    STEPPED = 1  # the physics of a step is done, with Stop.STEPPED
    TICKED = 2  # a control tick is done, with Stop.TICKED
    STOPPED = 3  # the processor of a robot has stopped
    WARNED = 4  # the physics engine has warned
    OUT_OF_BOUNDS = 5  # the physics has left its bounds
    NO_SPEED = 6  # a controller of `khep_twin.episodes.stepping` returned a speed that is not finite


class Stop(IntEnum):
    """Bits of `stops`: points at which `advance` returns to its caller."""

    STEPPED = 1  # after each step of the physics
    TICKED = 2  # after each control tick
    AWAITED = 4  # in `khep_twin.episodes.stepping`: when all robots await the caller's speeds


Phase = IntEnum("Phase", ["DONE", "STEPPED", "TICKED"], start=0)
"""Part of a step that is done: the whole step; its physics; also its sensor conversions and control tick."""

STEPS, PHASE, FIRST_POWERS_STEP, N_CONVERSIONS = 0, 1, 2, 3
"""Indices in `Simulated.counters`: steps done, `Phase` of the step, step of the first row of
`StepInputs.powers`, and number of sensor conversions of each robot so far, which indexes its noise."""
N_COUNTERS = 4

SOUND, STUCK, DEAD = 0, 1, 2
"""States of a sensor; a stuck one repeats its last reading, the receiver of a dead one passes no current."""

_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_LEFT_DUTY, _RIGHT_DUTY = kernel.DUTIES
_LEFT_ENCODER, _RIGHT_ENCODER = int(kernel.Wheel.ENCODER), kernel.RIGHT + int(kernel.Wheel.ENCODER)


class Timing(NamedTuple):
    """Durations in steps, and bounds.

    Attributes:
        step_ns: Step [ns].
        steps_per_motion: Steps per physics step, which runs before the first of them.
        conversions: Sensor conversions in each step.
        steps_per_tick: Steps per tick of the control loops.
        steps_per_supply: Steps per measurement of the supply.
        limit: Largest coordinate [m].
    """

    step_ns: int
    steps_per_motion: int
    conversions: int
    steps_per_tick: int
    steps_per_supply: int
    limit: float


class RobotState(NamedTuple):
    """One robot.

    Attributes:
        left_angle: Index of the left wheel's position.
        right_angle: Index of the right wheel's position.
        left_speed: Index of the left wheel's speed.
        right_speed: Index of the right wheel's speed.
        left_motor: Index of the left motor.
        right_motor: Index of the right motor.
        pose: Index of the robot's pose.
        radius: Radius of the robot [m].
        motor_constant: Torque per current [N m/A].
        idle_current: Supply current with the motors at rest [A].
        used_min: Use of the cells before the run [min]; or `battery.CHARGER`.
        sensors: Sensors of the robot.
        registers: State of the board (N_REGISTERS,).
        processor: State of the processor (N_PROCESSOR,).
        sensor_states: State of each sensor, SOUND, STUCK or DEAD (8,).
        strengths: Fractions of their torque that the left and right motor produce (2,).
        voltage: Last measured supply voltage (1,) [V].
        noise: Key of the robot's random draws, as two words (2,).
    """

    left_angle: int
    right_angle: int
    left_speed: int
    right_speed: int
    left_motor: int
    right_motor: int
    pose: int
    radius: float
    motor_constant: float
    idle_current: float
    used_min: float
    sensors: RobotSensors
    registers: kernel.Registers
    processor: Vector[int]
    sensor_states: Vector[int]
    strengths: Vector[float]
    voltage: Vector[float]
    noise: Vector[int]


class Simulated(NamedTuple):
    """Scene, robots and lamps of a simulation.

    Attributes:
        scene: Scene.
        timing: Divisions of time.
        light: Lamps of the scene.
        robots: Robots of the scene.
        counters: Counters of the simulation (N_COUNTERS,).
    """

    scene: Any
    timing: Timing
    light: Light
    robots: Sequence[RobotState]
    counters: Vector[int]


class StepInputs(NamedTuple):
    """Powers of the lamps for a range of steps, and the distributions of random draws.

    Attributes:
        powers: Powers of the lamps (n_steps or 1, n_lamps) [W].
        tables: Quantiles of the random draws, see `sensing.noise`.
    """

    powers: Sequence[Sequence[float]]
    tables: Tables


@compilable
def advance(simulated: Simulated, inputs: StepInputs, end_step: int, stops: int) -> int:
    """Run steps until `end_step` of them are done; return DONE, or the reason for an earlier return.

    Args:
        simulated: Scene, robots and lamps.
        inputs: Lamps of all of these steps, and random draws.
        end_step: Number of steps since the start of the run.
        stops: Sum of `Stop` values at which to return earlier.
    """
    scene, timing, robots, counters = simulated.scene, simulated.timing, simulated.robots, simulated.counters
    while counters[PHASE] != Phase.DONE or counters[STEPS] < end_step:
        if counters[PHASE] == Phase.DONE:
            if counters[STEPS] % timing.steps_per_motion == 0:
                step(scene)
            counters[STEPS] += 1
            counters[PHASE] = Phase.STEPPED
            if stops & Stop.STEPPED:
                return Reason.STEPPED
        steps = counters[STEPS]
        if counters[PHASE] == Phase.STEPPED:
            _scan(simulated, inputs, (steps - 1) * timing.conversions)
            counters[PHASE] = Phase.TICKED
            if steps % timing.steps_per_tick == 0:
                if not in_bounds(scene, timing.limit):
                    return Reason.OUT_OF_BOUNDS
                for i in range(len(robots)):
                    _tick(scene, robots[i])
                if stops & Stop.TICKED:
                    return Reason.TICKED
        counters[PHASE] = Phase.DONE
        if steps % timing.steps_per_supply == 0:
            if has_warned(scene):
                return Reason.WARNED
            stopped = False
            for i in range(len(robots)):
                stopped = update_supply(scene, robots[i], steps * timing.step_ns) or stopped
            if stopped:
                return Reason.STOPPED
    return Reason.DONE


@compilable_once
def switch_on(simulated: Simulated, inputs: StepInputs) -> int:
    """Run the scan before time 0, which fills all registers; return a reason as `advance` does."""
    scene, timing, robots = simulated.scene, simulated.timing, simulated.robots
    # MuJoCo's rangefinders, which turrets may need, have values from the second step on.
    step(scene)
    for start in range(-units.N_SENSORS, 0, timing.conversions):
        step(scene)
        _scan(simulated, inputs, start)
    stopped = False
    for i in range(len(robots)):
        read_encoders(scene, robots[i])
        stopped = update_supply(scene, robots[i], 0) or stopped
    if not in_bounds(scene, timing.limit):
        return Reason.OUT_OF_BOUNDS
    if has_warned(scene):
        return Reason.WARNED
    return Reason.STOPPED if stopped else Reason.DONE


@compilable
def convert_sensor(
    simulated: Simulated, inputs: StepInputs, robot: int, row: int, time_ns: int, channel: int
) -> None:
    """Convert one sensor of a robot.

    Args:
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        robot: Index of the robot.
        row: Row of the lamps' powers.
        time_ns: Time of the conversion [ns].
        channel: Number of the sensor.
    """
    state = simulated.robots[robot]
    registers = state.registers
    noise = draws(inputs.tables, state.noise, simulated.counters[N_CONVERSIONS])
    proximity, ambient = convert(
        simulated.scene, state.sensors, simulated.light, inputs.powers[row], time_ns, channel, noise
    )
    if state.sensor_states[channel] == STUCK:
        proximity, ambient = registers[_PROXIMITY + channel], registers[_AMBIENT + channel]
    elif state.sensor_states[channel] == DEAD:
        proximity, ambient = 0, state.sensors.ambient.ceiling
    kernel.convert(registers, proximity, ambient)


@compilable
def read_encoders(scene: Scene, robot: RobotState) -> None:
    """Set the encoders to the wheels' present angles."""
    robot.registers[_LEFT_ENCODER] = units.wheel_pulses(joint_position(scene, robot.left_angle))
    robot.registers[_RIGHT_ENCODER] = units.wheel_pulses(joint_position(scene, robot.right_angle))


@compilable
def update_supply(scene: Scene, robot: RobotState, time_ns: int) -> bool:
    """Measure the supply; return True if its voltage is too low, which resets and stops the processor."""
    registers = robot.registers
    left, right = registers[_LEFT_DUTY], registers[_RIGHT_DUTY]
    robot.voltage[0] = voltage = battery.voltage(robot.used_min, time_ns)
    current = robot.idle_current
    current += units.supply_current(left, motor_torque(scene, robot.left_motor) / robot.motor_constant)
    current += units.supply_current(right, motor_torque(scene, robot.right_motor) / robot.motor_constant)
    kernel.measure(registers, units.supply_counts(voltage), round(current * 1000))
    if voltage >= units.PROCESSOR_VOLTAGE or not robot.processor[kernel.POWERED]:
        return False
    kernel.reset(registers)
    # The motors keep their duty.
    registers[_LEFT_DUTY], registers[_RIGHT_DUTY] = left, right
    robot.processor[kernel.POWERED] = 0
    return True


@compilable
def weak_voltage(strength: float, voltage: float, constant: float, speed: float) -> float:
    """Return the voltage [V] at which a motor produces a fraction of its torque.

    A motor without current has only its back-EMF (the voltage that it generates), and no torque.

    Args:
        strength: Fraction of the torque.
        voltage: Voltage of its duty [V].
        constant: Torque per current [N m/A], or voltage per speed.
        speed: Speed of the wheel [rad/s].
    """
    return strength * voltage + (1 - strength) * (constant * speed)


@compilable_once
def _scan(simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Convert the sensors of each robot in one step; `start` is the number of the first conversion."""
    counters, conversions = simulated.counters, simulated.timing.conversions
    row = 0 if len(inputs.powers) == 1 else counters[STEPS] - 1 - counters[FIRST_POWERS_STEP]
    for offset in range(conversions):
        for robot in range(len(simulated.robots)):
            time_ns, channel = ((start + offset) * units.STEP_NS, (start + offset) % units.N_SENSORS)
            convert_sensor(simulated, inputs, robot, row, time_ns, channel)
        counters[N_CONVERSIONS] += 1


@compilable
def _tick(scene: Scene, robot: RobotState) -> None:
    """Run the board's control loops once, from encoders to motor voltages."""
    registers = robot.registers
    left = units.wheel_pulses(joint_position(scene, robot.left_angle))
    right = units.wheel_pulses(joint_position(scene, robot.right_angle))
    kernel.run(registers, robot.processor, left, right)
    left_voltage = units.duty_voltage(registers[_LEFT_DUTY], robot.voltage[0])
    right_voltage = units.duty_voltage(registers[_RIGHT_DUTY], robot.voltage[0])
    if robot.strengths[0] != 1:
        speed = joint_speed(scene, robot.left_speed)
        left_voltage = weak_voltage(robot.strengths[0], left_voltage, robot.motor_constant, speed)
    if robot.strengths[1] != 1:
        speed = joint_speed(scene, robot.right_speed)
        right_voltage = weak_voltage(robot.strengths[1], right_voltage, robot.motor_constant, speed)
    set_motor(scene, robot.left_motor, left_voltage)
    set_motor(scene, robot.right_motor, right_voltage)
