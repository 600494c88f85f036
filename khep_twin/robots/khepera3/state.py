"""State of a Khepera III in the stepping core, and its measurements.

Infrared sensors record a moment every 33 ms (manual), active ultrasonic ones in turn every 50 ms (assumed).
The functions are `compilable`, see `robots.measuring_core`.
"""

from typing import cast

import mujoco
import numpy as np

from khep_twin.board import lithium_cells
from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera3 import motor_control
from khep_twin.robots.khepera3.model import BODY, FIRST, SONAR
from khep_twin.robots.khepera3.motor_control import MotorState, Pic, direction
from khep_twin.robots.khepera3.registers import NO_ECHO, SETTINGS, ControlType, MotorRegister, Setting
from khep_twin.robots.measuring_core import INFRARED, MeasuringFields, measuring_fields
from khep_twin.sensing import sonar
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import set_reading
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import BeamScene
from khep_twin.sensing.simulated import StepInputs

N_ULTRASONIC = len(SONAR.names)

POWERED, TIMER_ZERO_MS, SCAN_MS, LEDS, SETTING = 0, 1, 2, 3, 5
"""Indices in the state of the board: whether the supply suffices, the timer's zero, time of the last infrared
readings, states of two LEDs, and the configuration."""
N_BOARD = SETTING + len(SETTINGS)

MAX_ECHOES = 5
N_ECHO = 1 + 3 * MAX_ECHOES
"""Numbers of an ultrasonic reading: number of echoes; distance [cm], amplitude and time [ms] of each."""

USED, CURRENT, AVERAGE = range(3)
"""Indices in the state of the battery: used charge [C], current and average current [A]."""
N_BATTERY = 3

CAPACITY, FULL_MIN = 1.4 * 3600, 240
"""Charge of a full battery [C], and its time of use [min] (manual)."""


@state_class
class Khepera3State(MeasuringFields):
    """State of one robot.

    Attributes (see also `MeasuringFields`):
        left: Left motor controller.
        right: Right motor controller.
        board: State of the dsPIC (N_BOARD,).
        echoes: Last reading of each ultrasonic sensor (N_ULTRASONIC * N_ECHO,).
        burst_echoes: Reading of the last burst that was evaluated (N_ECHO,).
        battery: State of the battery (N_BATTERY,).
    """

    left: MotorState
    right: MotorState
    board: Vector[int]
    echoes: Vector[int]
    burst_echoes: Vector[int]
    battery: Vector[float]


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera3State:
    """Return the state of a robot at power-up."""
    used = lithium_cells.used_charge(CAPACITY, entry.battery_used_min, FULL_MIN)
    return Khepera3State(
        **measuring_fields(model, indices, measured, entry, first_moment),
        left=motor_control.power_up(-1),
        right=motor_control.power_up(1),
        board=np.array([1, 0, 0, 0, 0, *SETTINGS]),
        echoes=np.zeros(N_ULTRASONIC * N_ECHO, np.int64),
        burst_echoes=np.zeros(N_ECHO, np.int64),
        battery=cast(Vector[float], np.array([used, 0.0, 0.0])),
    )


SCAN_NS, BURST_NS = 33_000_000, 50_000_000
"""Periods of the infrared sensors and of bursts [ns]."""

AMPLITUDE, MAX_AMPLITUDE = 140, 4095
"""Amplitude of an echo at the threshold, with which a wall at 27 cm returns the manual's 2900 (assumed), and
the largest one."""

_MS = 1_000_000
_N_INFRARED = len(BODY.sensors)
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
    level = charge_level(battery[USED], CAPACITY)
    registers[_BATTERY] = round(1000 * cells_voltage(level))
    registers[_BATTERY + 1] = round(1000 * battery[CURRENT])
    registers[_BATTERY + 2] = round(level * CAPACITY / 3.6)


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
    registers[_LEDS + side] = robot.board[LEDS + side]
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
        reading[echo + 2] = max(time_ns // _MS - robot.board[TIMER_ZERO_MS], 0)


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
    robot.board[SCAN_MS] = robot.times[INFRARED] // SCAN_NS * (SCAN_NS // _MS)
