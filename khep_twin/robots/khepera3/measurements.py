"""Measurements of a Khepera III: moments of its sensors, their evaluation, and the registers of a log.

Infrared sensors record a moment every 33 ms (toolbox), an active ultrasonic one in turn every 50 ms (assumed).
A moment is evaluated when its readings are read. The functions are `compilable`, see `robots.core`.
"""

from collections.abc import Collection, Sequence
from typing import Any

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.robots.khepera3.channels import GROUND, NO_ECHO, RING
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.motor_control import N_MOTOR, Motor, direction
from khep_twin.robots.khepera3.registers import N_BYTES, Control, MotorRegister, Setting
from khep_twin.robots.khepera3.state import (
    BURST,
    CAPACITY,
    CURRENT,
    ECHO,
    EVALUATES_BURSTS,
    INFRARED,
    LAST_BURST,
    LEDS,
    MAX_ECHOES,
    N_ECHO,
    N_ULTRASONIC,
    NONE,
    SCAN_MS,
    SETTING,
    TIMER_ZERO_MS,
    USED,
    Khepera3State,
)
from khep_twin.sensing import sonar
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.device_faults import DEAD, STUCK, set_reading
from khep_twin.sensing.ground import convert_any
from khep_twin.sensing.noise import draws
from khep_twin.sensing.scene import BeamScene, copy_moment, save_moment, update_frames
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row

SCAN_NS, BURST_NS = 33_000_000, 50_000_000
"""Periods of the infrared sensors and of bursts [ns]."""

AMPLITUDE = 140
"""Amplitude of an echo at the threshold: with it a wall at 27 cm returns the manual's 2900 (assumed)."""
MAX_AMPLITUDE = 4095

_MS = 1_000_000
N_INFRARED = len(RING) + len(GROUND)
_PROXIMITY, _AMBIENT, _ULTRASONIC = FIRST["proximity"], FIRST["ambient"], FIRST["ultrasonic"]
_SPEED, _POSITION, _DUTY, _CURRENT = (FIRST[name] for name in ("speed", "position", "duty", "current"))
_LEDS, _BATTERY, _CONTROLS = FIRST["leds"], FIRST["battery"], FIRST["control"]
_ACTIVE, _N_ECHOES, _ACTIVE_INFRARED = map(int, (Setting.ULTRASONIC, Setting.N_ECHOES, Setting.INFRARED))
_SET_POINT, _MEASURED_SPEED, _PWM = int(Motor.SET_POINT), int(Motor.SPEED), int(Motor.PWM)
_MOTOR_CURRENT, _FIRST_MOVE, _LAST_MOVE = int(Motor.CURRENT), int(Control.POSITION), int(Control.POSITION_PROFILE)
_CONTROL, _MODE, _ERRORS = int(MotorRegister.CONTROL), int(MotorRegister.MODE), int(MotorRegister.ERRORS)
_CONTROL_REGISTERS = _MODE, _CONTROL, _ERRORS


@compilable
def sense(robot: Khepera3State, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Record the moments of a step, if any are due."""
    if start >= 0:
        step_ns = simulated.timing.step_ns
        record(robot, simulated, inputs, simulated.counters[STEPS] * step_ns, step_ns)


@compilable
def record(
    robot: Khepera3State, simulated: Simulated, inputs: StepInputs, time_ns: int, step_ns: int
) -> None:
    """Record the moments that have become due in a step that ends at a time [ns]."""
    scene, first, times, board = simulated.scene, robot.first_moment, robot.times, robot.board
    powers = inputs.powers[powers_row(simulated, inputs)]
    if time_ns % SCAN_NS < step_ns:
        save_moment(scene, first + INFRARED, powers)
        times[INFRARED] = time_ns
    if time_ns % BURST_NS >= step_ns:
        return
    last = board[LAST_BURST]
    if last != NONE and board[EVALUATES_BURSTS]:
        for index in range(N_ECHO):
            robot.echoes[last * N_ECHO + index] = robot.burst[index]
    elif last != NONE:
        copy_moment(scene, first + BURST, first + ECHO + last)
        times[ECHO + last] = times[BURST]
    sensor = board[LAST_BURST] = _next_sensor(last, board[SETTING + _ACTIVE])
    if sensor == NONE:
        return
    if board[EVALUATES_BURSTS]:
        update_frames(scene)
        _measure_echoes(robot, scene, inputs, sensor, time_ns, robot.burst, 0)
    else:
        save_moment(scene, first + BURST, powers)
    times[BURST] = time_ns


def scan(robot: Khepera3State, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure with all infrared sensors now."""
    save_moment(simulated.scene, robot.first_moment + INFRARED, inputs.powers[0])
    robot.times[INFRARED] = simulated.counters[STEPS] * simulated.timing.step_ns


@compilable
def evaluate(robot: Khepera3State, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    """Evaluate the moment INFRARED, or that of an ultrasonic sensor from ECHO on."""
    if part == INFRARED:
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[0])
    else:
        sensor, time_ns = part - ECHO, robot.times[part]
        _measure_echoes(robot, simulated.scene, inputs, sensor, time_ns, robot.echoes, sensor * N_ECHO)
        robot.times[part] = NONE


@compilable
def update_registers(robot: Khepera3State, simulated: Simulated, inputs: StepInputs) -> None:
    """Evaluate the infrared sensors, whose moment is the present, and set the registers."""
    if robot.times[INFRARED] != NONE:
        update_frames(simulated.scene)
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[powers_row(simulated, inputs)])
    fill_registers(robot)


@compilable
def fill_registers(robot: Khepera3State) -> None:
    """Set the registers besides those of the infrared sensors; motion is positive forwards."""
    registers, board, memory, battery = robot.registers, robot.board, robot.memory, robot.battery
    for sensor in range(N_ULTRASONIC):
        is_active = board[SETTING + _ACTIVE] >> sensor & 1
        registers[_ULTRASONIC + sensor] = robot.echoes[sensor * N_ECHO + 1] if is_active else NO_ECHO
    for side in range(2):
        first, motor, sign = side * N_BYTES, side * N_MOTOR, direction(memory, side)
        set_point = sign * robot.controllers[motor + _SET_POINT]
        is_move = _FIRST_MOVE <= memory[first + _CONTROL] <= _LAST_MOVE
        registers[_SPEED + side] = sign * robot.controllers[motor + _MEASURED_SPEED]
        registers[_SPEED + 2 + side] = 0 if is_move else set_point
        registers[_POSITION + side] = sign * robot.controllers[motor]
        registers[_POSITION + 2 + side] = set_point if is_move else 0
        registers[_DUTY + side] = sign * robot.controllers[motor + _PWM]
        registers[_CURRENT + side] = sign * robot.controllers[motor + _MOTOR_CURRENT]
        registers[_LEDS + side] = board[LEDS + side]
        for index, register in enumerate(_CONTROL_REGISTERS):
            registers[_CONTROLS + 2 * index + side] = memory[first + register]
    level = charge_level(battery[USED], CAPACITY)
    registers[_BATTERY] = round(1000 * cells_voltage(level))
    registers[_BATTERY + 1] = round(1000 * battery[CURRENT])
    registers[_BATTERY + 2] = round(level * CAPACITY / 3.6)


def request_terms(state: Any, names: Collection[str]) -> None:
    """Evaluate each burst immediately if the ultrasonic sensors are among the terms."""
    state["board"][..., EVALUATES_BURSTS] = "ultrasonic" in names


@compilable
def _next_sensor(last: int, active_mask: int) -> int:
    """Return the active ultrasonic sensor after the last one, or NONE."""
    for offset in range(1, N_ULTRASONIC + 1):
        sensor = (last + offset) % N_ULTRASONIC
        if active_mask >> sensor & 1:
            return sensor
    return NONE


@compilable
def _measure_echoes(
    robot: Khepera3State,
    scene: BeamScene,
    inputs: StepInputs,
    sensor: int,
    time_ns: int,
    reading: Vector[int],
    first: int,
) -> None:
    """Set the reading of an ultrasonic sensor, from an index on, in a scene at its burst."""
    fault, ultrasonic, number = robot.faults.sensors[N_INFRARED + sensor], robot.sonar, time_ns // BURST_NS
    if fault == STUCK:
        return
    for index in range(N_ECHO):
        reading[first + index] = 0
    n_echoes = min(max(robot.board[SETTING + _N_ECHOES], 0), MAX_ECHOES) if fault != DEAD else 0
    sonar.cast(scene, robot.sensors, robot.pose, ultrasonic, robot.beams, sensor, 0)
    distance = -1.0
    for index in range(n_echoes):
        distance, loudness = sonar.next_echo(ultrasonic, robot.beams, distance)
        draw = number * MAX_ECHOES + index
        distance_cm = sonar.reading_of(ultrasonic, distance, inputs.tables, robot.noise, draw)
        if distance_cm == NO_ECHO:
            return
        echo = first + 1 + 3 * index
        reading[first] = index + 1
        reading[echo] = distance_cm
        reading[echo + 1] = min(round(AMPLITUDE * loudness), MAX_AMPLITUDE)
        reading[echo + 2] = time_ns // _MS - robot.board[TIMER_ZERO_MS]


@compilable
def _evaluate_infrared(
    robot: Khepera3State, simulated: Simulated, inputs: StepInputs, powers: Sequence[float]
) -> None:
    """Measure with the infrared sensors in a scene at their moment."""
    time_ns, number = robot.times[INFRARED], robot.times[INFRARED] // SCAN_NS
    scene, sensors, ground, light = simulated.scene, robot.sensors, robot.ground, simulated.light
    registers, faults, active_mask = robot.registers, robot.faults, robot.board[SETTING + _ACTIVE_INFRARED]
    for channel in range(N_INFRARED):
        random = draws(inputs.tables, robot.noise, number * N_INFRARED + channel)
        proximity, ambient = convert_any(scene, sensors, ground, light, powers, time_ns, channel, random)
        if not active_mask >> channel & 1:
            proximity = ambient = 0
        set_reading(registers, _PROXIMITY + channel, faults, channel, proximity, 0)
        set_reading(registers, _AMBIENT + channel, faults, channel, ambient, ground.darkest)
    robot.board[SCAN_MS] = number * (SCAN_NS // _MS)
    robot.times[INFRARED] = NONE
