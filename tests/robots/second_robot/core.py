"""Core of the Scout. A burst of an ultrasonic sensor is a moment, which is evaluated when it is read."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.robots.core import Core, register
from khep_twin.sensing import scene as queries
from khep_twin.sensing.beams import cast_level_ray
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.device_faults import drive_motor, set_reading
from khep_twin.sensing.noise import draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row
from khep_twin.sensors import RobotFields, core_fields
from second_robot import model
from second_robot.model import AMBIENT, BATTERY, BODY, PROXIMITY, SCOUT, ULTRASONIC

INFRARED_NS, BURST_NS, FULL, EMPTY, CAPACITY = 25_000_000, 40_000_000, 8.4, 6.0, 2160.0
"""Periods; voltages of a full and of an empty battery [V], and its charge [C], which lasts an hour."""
POWERED, EAGER, TIMES, N_FLAGS, NONE, USED, VOLTAGES, N_LEVELS = 0, 1, 2, 5, -1, 0, 1, 3
"""Indices in `flags`, with times of bursts that are not evaluated, and in `levels`."""
N_RING, N_SONAR, _PLACES = len(model.RING), len(model.SONAR), tuple(BODY.sonar.places)
_PULSES_PER_RAD, _IDLE_CURRENT = BODY.pulses_per_turn / math.tau, BODY.idle_current


@state_class
class ScoutState(RobotFields):
    """State of one robot; `ground` has the counts above white, those of nothing, and their noise."""

    ground: Sequence[float]
    is_discharged: int
    first_moment: int
    beam: queries.Beams
    registers: Vector[int]
    flags: Vector[int]
    levels: Vector[float]


def _make_state(scene: Any, indices: Any, measured: Any, entry: Any, first_moment: int) -> ScoutState:
    ground, used_min = measured.ground, entry.battery_used_min
    return ScoutState(
        **core_fields(scene, indices, measured, entry, first_moment),
        ground=[*map(float, (*ground.white_counts, ground.nothing_counts, ground.noise_counts))],
        is_discharged=int(used_min is not None),
        first_moment=first_moment,
        beam=queries.Beams.of(1),
        registers=np.repeat([0, model.NO_ECHO, 0], [ULTRASONIC, N_SONAR, model.N_REGISTERS - model.SPEED]),
        flags=np.array([1, 0, *[NONE] * N_SONAR]),
        levels=np.array([CAPACITY * min((used_min or 0) / 60, 1), 0, 0]),
    )


@compilable
def _look(robot: ScoutState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> None:
    scene, registers, powers = simulated.scene, robot.registers, inputs.powers[powers_row(simulated, inputs)]
    for channel in range(len(robot.sensors.cameras)):
        noise = draws(inputs.tables, robot.noise, 8 * (time_ns // INFRARED_NS) + channel)
        if channel < N_RING:
            near, light = convert(scene, robot.sensors, simulated.light, powers, time_ns, channel, noise)
            set_reading(registers, PROXIMITY + channel, robot.faults, channel, near, 0)
            darkest = robot.sensors.ambient.ceiling
            set_reading(registers, AMBIENT + channel, robot.faults, channel, light, darkest)
            continue
        x, y, z = queries.position(scene, robot.sensors, channel)
        frame = queries.sensor_frame(scene, robot.sensors, channel)
        length, grey = queries.ray(scene, robot.sensors, (x, y, z), (-frame[2], -frame[5], -frame[8]))
        white, dark, deviation = robot.ground[channel - N_RING], robot.ground[-2], robot.ground[-1]
        level = dark + (white - dark) * (grey if 0 <= length < 2 * z else 0.0) + deviation * noise[0]
        counts = min(max(round(level), 0), 1023)
        set_reading(registers, PROXIMITY + channel, robot.faults, channel, counts, 0)
        registers[AMBIENT + channel] = round(robot.sensors.ambient.dark)


@compilable
def _measure_distance(
    robot: ScoutState, scene: queries.BeamScene, inputs: StepInputs, sensor: int, time_ns: int
) -> None:
    reach, noise = model.REACH_MM / 1000, draws(inputs.tables, robot.noise, 2**40 + time_ns // BURST_NS)[0]
    length = cast_level_ray(scene, robot.sensors, robot.beam, robot.pose, _PLACES[sensor], reach)
    reading = round(1000 * length + 2 * noise)
    nearest = 0 if reading < model.NEAREST_MM else min(reading, model.REACH_MM)
    distance, number = model.NO_ECHO if length < 0 else nearest, len(robot.sensors.cameras) + sensor
    set_reading(robot.registers, ULTRASONIC + sensor, robot.faults, number, distance, model.NO_ECHO)


@compilable
def _burst(robot: ScoutState, simulated: Simulated, inputs: StepInputs, sensor: int, time_ns: int) -> None:
    if robot.flags[EAGER]:
        queries.update_frames(simulated.scene)
        _measure_distance(robot, simulated.scene, inputs, sensor, time_ns)
        return
    powers = inputs.powers[powers_row(simulated, inputs)]
    queries.save_moment(simulated.scene, robot.first_moment + sensor, powers)
    robot.flags[TIMES + sensor] = time_ns


@compilable
def _sense(robot: ScoutState, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    time_ns = simulated.counters[STEPS] * simulated.timing.step_ns
    if start >= 0 and time_ns % INFRARED_NS == 0:
        _look(robot, simulated, inputs, time_ns)
    if start >= 0 and time_ns % BURST_NS == 0:
        _burst(robot, simulated, inputs, time_ns // BURST_NS % N_SONAR, time_ns)


@compilable
def _scan(robot: ScoutState, simulated: Simulated, inputs: StepInputs) -> None:
    time_ns = simulated.counters[STEPS] * simulated.timing.step_ns
    _look(robot, simulated, inputs, time_ns)
    for sensor in range(N_SONAR):
        _burst(robot, simulated, inputs, sensor, time_ns)


@compilable
def _start(robot: ScoutState, simulated: Simulated, inputs: StepInputs) -> bool:
    _scan(robot, simulated, inputs)
    return _measure_supply(robot, simulated, 0)


@compilable
def _measure_supply(robot: ScoutState, simulated: Simulated, time_ns: int) -> bool:
    current, levels = _IDLE_CURRENT, robot.levels
    for side in range(2):
        current += abs(queries.motor_torque(simulated.scene, robot.motors[side])) / robot.motor_constant
    levels[USED] = min(levels[USED] + robot.is_discharged * current * 0.02, CAPACITY)  # in 20 ms
    robot.registers[BATTERY] = round(1000 * (FULL - (FULL - EMPTY) * levels[USED] / CAPACITY))
    has_stopped = levels[USED] >= CAPACITY and robot.flags[POWERED] != 0
    if has_stopped:
        robot.flags[POWERED] = 0
    return has_stopped


@compilable
def _tick(robot: ScoutState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    scene, registers, levels = simulated.scene, robot.registers, robot.levels
    limit = robot.flags[POWERED] * registers[BATTERY] / 1000
    for side in range(2):
        speed = queries.joint_speed(scene, robot.speeds[side])
        angle = queries.joint_position(scene, robot.angles[side])
        registers[model.SPEED + side] = round(100 * speed)
        registers[model.POSITION + side] = round(angle * _PULSES_PER_RAD)
        error = registers[model.SETPOINT + side] / 100 - speed
        level = levels[VOLTAGES + side] = min(max(levels[VOLTAGES + side] + 0.02 * error, -limit), limit)
        voltage, constant = min(max(level + 0.15 * error, -limit), limit), robot.motor_constant
        drive_motor(scene, robot.faults, side, robot.motors[side], robot.speeds[side], constant, voltage)
    return False


@compilable
def _evaluate(robot: ScoutState, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    _measure_distance(robot, simulated.scene, inputs, part, robot.flags[TIMES + part])
    robot.flags[TIMES + part] = NONE


@compilable
def _is_powered(robot: ScoutState) -> bool:
    return robot.flags[POWERED] != 0


def _request_terms(record: Any, names: Any) -> None:
    record["flags"][EAGER] = "ultrasonic" in names


_MODULES = "second_robot.core", "khep_twin.sensing.beams"
_CHANGING, _FUNCTIONS = ("registers", "flags", "levels", "beam"), (_sense, _tick, _scan, _start)
_SUPPLY_AND_MOMENTS = _measure_supply, _evaluate, N_SONAR, SCOUT.interface, _request_terms
CORE = register(
    Core(
        *("scout", ScoutState, _make_state, _CHANGING, _MODULES, *_FUNCTIONS, *_SUPPLY_AND_MOMENTS),
        is_powered=_is_powered,
    )
)
