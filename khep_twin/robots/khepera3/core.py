"""Core of the Khepera III: motor controllers and battery of a robot.

At the end of a control period of 10 ms it updates pulses of the encoders, controllers, voltage of the motors,
and the battery's charge; an empty one stops the robot. `measurements` has the sensors. The functions are
`compilable`, see `robots.core`.
"""

import math

from khep_twin.board.kernel import wrap
from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.core import Core, register
from khep_twin.robots.khepera3 import measurements
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.channels import PWM_LIMIT
from khep_twin.robots.khepera3.letters import Letters
from khep_twin.robots.khepera3.model import KHEPERA_3, version_of
from khep_twin.robots.khepera3.motor_control import (
    N_MOTOR,
    Motor,
    control_motor,
    direction,
    halt,
    measured_speed,
    set_order,
)
from khep_twin.robots.khepera3.registers import N_BYTES, SINGLE_COUNT, Control, Mode, MotorRegister
from khep_twin.robots.khepera3.state import (
    AVERAGE,
    CAPACITY,
    CURRENT,
    N_MOMENTS,
    POWERED,
    USED,
    WANDERING,
    Khepera3State,
    make_state,
)
from khep_twin.sensing.device_faults import drive_motor
from khep_twin.sensing.scene import Scene, joint_position, joint_speed, motor_torque, set_motor
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.sensing.sonar import cast_level_rays
from khep_twin.units import TICK_NS

CUT_OFF = 6.0
"""Voltage at which the robot stops [V] (assumed)."""

_AVERAGE_TICKS = 3000
"""Control periods over which the gauge takes its average current (assumed)."""

_TICK_S = TICK_NS * 1e-9
_POSITION, _SPEED, _PWM, _CURRENT = map(int, (Motor.POSITION, Motor.SPEED, Motor.PWM, Motor.CURRENT))
_HARDWARE_OPTIONS, _MODE = int(MotorRegister.HARDWARE_OPTIONS), int(MotorRegister.MODE)
_IDLE = int(Mode.IDLE)
_CONSTANT, _OPEN_LOOP = int(Control.SPEED), int(Control.OPEN_LOOP)
_MOVE, _MOVE_PROFILE = int(Control.POSITION), int(Control.POSITION_PROFILE)
_L, _F, _P = map(ord, "LFP")


@compilable
def _start(robot: Khepera3State, simulated: Simulated, inputs: StepInputs) -> bool:
    """Count from the wheels' present angles, and measure at time 0."""
    for side in range(2):
        robot.counts[side] = wheel_pulses(robot, joint_position(simulated.scene, robot.angles[side]))
    robot.battery[CURRENT] = robot.battery[AVERAGE] = robot.idle_current
    measurements.record(robot, simulated, inputs, 0, simulated.timing.step_ns)
    return False


@compilable
def _tick(robot: Khepera3State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run a control period; return True if it has stopped the robot, or the vehicle of letter A drives."""
    battery, scene = robot.battery, simulated.scene
    if not robot.board[POWERED]:
        return False
    voltage, current = cells_voltage(charge_level(battery[USED], CAPACITY)), robot.idle_current
    current += _drive(scene, robot, 0, voltage) + _drive(scene, robot, 1, voltage)
    battery[CURRENT] = current
    battery[AVERAGE] += (current - battery[AVERAGE]) / _AVERAGE_TICKS
    if robot.is_discharged:
        battery[USED] = min(battery[USED] + current * _TICK_S, CAPACITY)
    if voltage > CUT_OFF:
        return robot.vehicle[WANDERING] != 0
    robot.board[POWERED] = 0
    for side in range(2):
        halt(robot.controllers, side * N_MOTOR)
        robot.memory[side * N_BYTES + _MODE] = _IDLE
        set_motor(scene, robot.motors[side], 0.0)
    return True


@compilable
def _drive(scene: Scene, robot: Khepera3State, side: int, voltage: float) -> float:
    """Run a motor controller, and drive its motor; return the current from the battery [A]."""
    memory, numbers, motor = robot.memory, robot.controllers, side * N_MOTOR
    pulses, sign = wheel_pulses(robot, joint_position(scene, robot.angles[side])), direction(memory, side)
    divisor = 4 if memory[side * N_BYTES + _HARDWARE_OPTIONS] & SINGLE_COUNT else 1
    way = pulses // divisor - robot.counts[side] // divisor
    robot.counts[side] = pulses
    amperes = motor_torque(scene, robot.motors[side]) / robot.motor_constant
    rate = joint_speed(scene, robot.speeds[side]) * robot.pulses_per_radian
    numbers[motor + _POSITION] = wrap(numbers[motor + _POSITION] + sign * way)
    numbers[motor + _SPEED] = sign * measured_speed(rate)
    numbers[motor + _CURRENT] = sign * round(1000 * amperes)
    control_motor(memory, numbers, side)
    duty, speed, constant = sign * numbers[motor + _PWM] / PWM_LIMIT, robot.speeds[side], robot.motor_constant
    drive_motor(scene, robot.faults, side, robot.motors[side], speed, constant, duty * voltage)
    return max(duty * amperes, 0.0)


@compilable
def wheel_pulses(robot: Khepera3State, angle: float) -> int:
    """Return the pulses of an encoder at a wheel's angle [rad]."""
    return math.floor(angle * robot.pulses_per_radian + 0.5)


@compilable
def _command(robot: Khepera3State, letter: int, left: int, right: int) -> None:
    """Execute D, F, L or P, with the signs of the motor controllers."""
    control = _CONSTANT
    if letter == _L:
        control = _OPEN_LOOP
    elif letter == _P:
        control = _MOVE
    elif letter == _F:
        control = _MOVE_PROFILE
    set_order(robot.memory, robot.controllers, 0, control, left)
    set_order(robot.memory, robot.controllers, 1, control, right)


@compilable
def _set_speeds(robot: Khepera3State, left: int, right: int) -> None:
    """Set the speeds forwards, by any options of the motor controllers."""
    memory, numbers = robot.memory, robot.controllers
    set_order(memory, numbers, 0, _CONSTANT, left * direction(memory, 0))
    set_order(memory, numbers, 1, _CONSTANT, right * direction(memory, 1))


@compilable
def _is_powered(robot: Khepera3State) -> bool:
    """Return whether the supply suffices."""
    return robot.board[POWERED] != 0


def _program(entry: RobotEntry, state: Khepera3State) -> Letters:
    """Return the program on the line of a state, started."""
    letters = Letters(Bus(state, version_of(entry.robot_model)), state.vehicle, entry.rom)
    letters.receive(b"\n")
    return letters


_PARTS = "motor_control", "measurements", "core"

CORE = register(
    Core(
        name="khepera3",
        state=Khepera3State,
        make_state=make_state,
        changing=(
            *("memory", "controllers", "counts", "board", "echoes", "burst", "times", "battery"),
            *("vehicle", "beams", "registers"),
        ),
        n_moments=N_MOMENTS,
        modules=(
            *("khep_twin.board.kernel", "khep_twin.board.lithium_cells", "khep_twin.sensing.ground"),
            *("khep_twin.sensing.sonar", *(f"khep_twin.robots.khepera3.{part}" for part in _PARTS)),
        ),
        sense=measurements.sense,
        tick=_tick,
        start=_start,
        evaluate=measurements.evaluate,
        scan=measurements.scan,
        interface=KHEPERA_3.interface,
        request_terms=measurements.request_terms,
        update_registers=measurements.update_registers,
        set_speeds=_set_speeds,
        is_powered=_is_powered,
        commands="DFLP",
        command=_command,
        counter_commands="IZM",
        echo=cast_level_rays,
        program=_program,
    )
)
