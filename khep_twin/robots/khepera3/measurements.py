"""Measurements of a Khepera III: moments of its sensors, their evaluation, and the registers of a log.

Infrared sensors record a moment every 33 ms (manual), active ultrasonic ones in turn every 50 ms (assumed).
A moment is evaluated when its readings are read. The functions are `compilable`, see `robots.core`.
"""

from collections.abc import Collection, Sequence

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.robots.khepera3 import state
from khep_twin.robots.khepera3.channels import GROUND, NO_ECHO, RING
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.motor_control import MotorState, Pic, direction
from khep_twin.robots.khepera3.registers import ControlType, MotorRegister, Setting
from khep_twin.robots.khepera3.state import MAX_ECHOES, N_ECHO, N_ULTRASONIC, SETTING, Khepera3State
from khep_twin.sensing import sonar
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.bursts import ECHO, INFRARED, NONE, RobotState, record_scan, start_burst
from khep_twin.sensing.device_faults import DEAD, STUCK, set_reading
from khep_twin.sensing.ground import convert_any
from khep_twin.sensing.noise import draws
from khep_twin.sensing.scene import BeamScene, update_frames
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row

SCAN_NS, BURST_NS = 33_000_000, 50_000_000
"""Periods of the infrared sensors and of bursts [ns]."""

AMPLITUDE, MAX_AMPLITUDE = 140, 4095
"""Amplitude of an echo at the threshold, with which a wall at 27 cm returns the manual's 2900 (assumed), and
the largest one."""

_MS = 1_000_000
_N_INFRARED = len(RING) + len(GROUND)
_PROXIMITY, _AMBIENT, _ULTRASONIC = FIRST["proximity"], FIRST["ambient"], FIRST["ultrasonic"]
_SPEED, _POSITION, _DUTY, _CURRENT = (FIRST[name] for name in ("speed", "position", "duty", "current"))
_LEDS, _BATTERY, _CONTROL = FIRST["leds"], FIRST["battery"], FIRST["control"]


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
    if time_ns % SCAN_NS < step_ns:
        record_scan(robot, simulated, inputs, time_ns)
    if time_ns % BURST_NS >= step_ns:
        return
    last, active_mask = robot.burst[0], robot.board[SETTING + Setting.ULTRASONIC]
    if robot.is_eager[0] and last != NONE:
        for index in range(N_ECHO):
            robot.echoes[last * N_ECHO + index] = robot.burst_echoes[index]
    if start_burst(robot, simulated, inputs, time_ns, active_mask):
        _measure_echoes(robot, simulated.scene, inputs, robot.burst[0], time_ns, robot.burst_echoes, 0)


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
    registers, board, battery = robot.registers, robot.board, robot.battery
    for sensor in range(N_ULTRASONIC):
        is_active = board[SETTING + Setting.ULTRASONIC] >> sensor & 1
        registers[_ULTRASONIC + sensor] = robot.echoes[sensor * N_ECHO + 1] if is_active else NO_ECHO
    _fill_motor(robot, 0, robot.left)
    _fill_motor(robot, 1, robot.right)
    level = charge_level(battery[state.USED], state.CAPACITY)
    registers[_BATTERY] = round(1000 * cells_voltage(level))
    registers[_BATTERY + 1] = round(1000 * battery[state.CURRENT])
    registers[_BATTERY + 2] = round(level * state.CAPACITY / 3.6)


@compilable
def _fill_motor(robot: Khepera3State, side: int, motor: MotorState) -> None:
    """Set the registers of a motor and of the LED of the same number."""
    registers, memory, numbers, sign = robot.registers, motor.memory, motor.numbers, direction(motor)
    set_point, control = sign * numbers[Pic.SET_POINT], memory[MotorRegister.CONTROL]
    is_move = control == ControlType.POSITION or control == ControlType.POSITION_PROFILE
    registers[_SPEED + side] = sign * numbers[Pic.SPEED]
    registers[_SPEED + 2 + side] = 0 if is_move else set_point
    registers[_POSITION + side] = sign * numbers[Pic.POSITION]
    registers[_POSITION + 2 + side] = set_point if is_move else 0
    registers[_DUTY + side] = sign * numbers[Pic.PWM]
    registers[_CURRENT + side] = sign * numbers[Pic.CURRENT]
    registers[_LEDS + side] = robot.board[state.LEDS + side]
    registers[_CONTROL + side] = memory[MotorRegister.MODE]
    registers[_CONTROL + 2 + side] = control
    registers[_CONTROL + 4 + side] = memory[MotorRegister.ERRORS]


def request_terms(record: RobotState, names: Collection[str]) -> None:
    """Let all ultrasonic sensors measure, each burst immediately, if they are among the terms."""
    record["is_eager"] = "ultrasonic" in names
    if "ultrasonic" in names:
        record["board"][SETTING + Setting.ULTRASONIC] = (1 << N_ULTRASONIC) - 1


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
    fault, ultrasonic, number = robot.faults.sensors[_N_INFRARED + sensor], robot.sonar, time_ns // BURST_NS
    if fault == STUCK:
        return
    for index in range(N_ECHO):
        reading[first + index] = 0
    n_echoes = min(max(robot.board[SETTING + Setting.N_ECHOES], 0), MAX_ECHOES) if fault != DEAD else 0
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
        reading[echo + 2] = max(time_ns // _MS - robot.board[state.TIMER_ZERO_MS], 0)


@compilable
def _evaluate_infrared(
    robot: Khepera3State, simulated: Simulated, inputs: StepInputs, powers: Sequence[float]
) -> None:
    """Measure with the infrared sensors in a scene at their moment."""
    time_ns, number = robot.times[INFRARED], robot.times[INFRARED] // SCAN_NS
    scene, sensors, ground, light = simulated.scene, robot.sensors, robot.ground, simulated.light
    registers, faults, active_mask = robot.registers, robot.faults, robot.board[SETTING + Setting.INFRARED]
    for channel in range(_N_INFRARED):
        random = draws(inputs.tables, robot.noise, number * _N_INFRARED + channel)
        proximity, ambient = convert_any(scene, sensors, ground, light, powers, time_ns, channel, random)
        if not active_mask >> channel & 1:
            proximity = ambient = 0
        set_reading(registers, _PROXIMITY + channel, faults, channel, proximity, 0)
        set_reading(registers, _AMBIENT + channel, faults, channel, ambient, ground.darkest)
    robot.board[state.SCAN_MS] = number * (SCAN_NS // _MS)
    robot.times[INFRARED] = NONE
