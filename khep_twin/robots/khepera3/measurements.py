"""Measurements of a Khepera III, and the registers of a log.

Infrared sensors record a moment every 33 ms (manual), active ultrasonic ones in turn every 50 ms (assumed).
The functions are `compilable`, see `robots.measuring_core`.
"""

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.robots.khepera3 import state
from khep_twin.robots.khepera3.channels import GROUND, NO_ECHO, RING
from khep_twin.robots.khepera3.model import FIRST
from khep_twin.robots.khepera3.motor_control import MotorState, Pic, direction
from khep_twin.robots.khepera3.registers import ControlType, MotorRegister, Setting
from khep_twin.robots.khepera3.state import MAX_ECHOES, N_ECHO, N_ULTRASONIC, SETTING, Khepera3State
from khep_twin.sensing import sonar
from khep_twin.sensing.bursts import INFRARED
from khep_twin.sensing.device_faults import set_reading
from khep_twin.sensing.scene import BeamScene
from khep_twin.sensing.simulated import StepInputs

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


@compilable
def active_mask(robot: Khepera3State) -> int:
    """Return the mask of the active ultrasonic sensors."""
    return robot.board[SETTING + Setting.ULTRASONIC]


@compilable
def measure_burst(
    robot: Khepera3State, scene: BeamScene, inputs: StepInputs, sensor: int, time_ns: int
) -> None:
    """Measure with an ultrasonic sensor in a scene at its burst."""
    ultrasonic, reading, number = robot.sonar, robot.burst_echoes, time_ns // BURST_NS
    for index in range(N_ECHO):
        reading[index] = 0
    sonar.cast(scene, robot.sensors, robot.pose, ultrasonic, robot.beams, sensor, 0)
    distance = -1.0
    for index in range(min(max(robot.board[SETTING + Setting.N_ECHOES], 0), MAX_ECHOES)):
        distance, loudness = sonar.next_echo(ultrasonic, robot.beams, distance)
        draw = number * MAX_ECHOES + index
        distance_cm = sonar.reading_of(ultrasonic, distance, inputs.tables, robot.noise, draw)
        if distance_cm == NO_ECHO:
            return
        echo = 1 + 3 * index
        reading[0] = index + 1
        reading[echo] = distance_cm
        reading[echo + 1] = min(round(AMPLITUDE * loudness), MAX_AMPLITUDE)
        reading[echo + 2] = max(time_ns // _MS - robot.board[state.TIMER_ZERO_MS], 0)


@compilable
def keep_burst(robot: Khepera3State, sensor: int) -> None:
    """Make the reading of the last burst that of its sensor."""
    for index in range(N_ECHO):
        number, reading = sensor * N_ECHO + index, robot.burst_echoes[index]
        set_reading(robot.echoes, number, robot.faults, _N_INFRARED + sensor, reading, 0)


@compilable
def set_infrared(robot: Khepera3State, channel: int, proximity: int, ambient: int) -> None:
    """Set the registers of an infrared sensor, and the time of the readings."""
    registers, faults = robot.registers, robot.faults
    if not robot.board[SETTING + Setting.INFRARED] >> channel & 1:
        proximity = ambient = 0
    set_reading(registers, _PROXIMITY + channel, faults, channel, proximity, 0)
    set_reading(registers, _AMBIENT + channel, faults, channel, ambient, robot.ground.darkest)
    robot.board[state.SCAN_MS] = robot.times[INFRARED] // SCAN_NS * (SCAN_NS // _MS)
