"""Core of the Khepera III: motor controllers and battery of a robot.

At the end of a control period of 10 ms it updates pulses of the encoders, controllers, voltage of the motors,
and the battery's charge; an empty one stops the robot. `state` has the sensors. The functions are
`compilable`, see `robots.core`.
"""

from collections.abc import Collection

from khep_twin.board.kernel import wrap
from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera3 import motor_control, state
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.letters import Letters, program_of
from khep_twin.robots.khepera3.model import KHEPERA_3
from khep_twin.robots.khepera3.motor_control import MotorState, Pic, direction
from khep_twin.robots.khepera3.registers import (
    PWM_LIMIT,
    SINGLE_COUNT,
    ControlType,
    MotorRegister,
    PicMode,
    Setting,
)
from khep_twin.robots.khepera3.state import Khepera3State
from khep_twin.robots.measuring_core import measuring_core, request_terms, wheel_pulses
from khep_twin.robots.vehicle import WANDERING
from khep_twin.sensing.buffers import RobotState
from khep_twin.sensing.device_faults import drive_motor
from khep_twin.sensing.scene import Scene, joint_position, joint_speed, motor_torque, set_motor
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.units import TICK_NS

CUT_OFF = 6.0
"""Voltage at which the battery switches itself off [V] (manual)."""

_AVERAGE_TICKS = 3000
"""Control periods over which the gauge takes its average current (assumed)."""

_L, _F, _P = map(ord, "LFP")


@compilable
def _start(robot: Khepera3State, simulated: Simulated) -> None:
    """Count from the wheels' present angles."""
    scene = simulated.scene
    robot.left.numbers[Pic.PULSES] = wheel_pulses(robot, joint_position(scene, robot.angles[0]))
    robot.right.numbers[Pic.PULSES] = wheel_pulses(robot, joint_position(scene, robot.angles[1]))
    robot.battery[state.CURRENT] = robot.battery[state.AVERAGE] = robot.idle_current


@compilable
def _tick(robot: Khepera3State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run a control period; return True if it has stopped the robot, or the vehicle of letter A drives."""
    battery, scene = robot.battery, simulated.scene
    if not robot.board[state.POWERED]:
        return False
    voltage = cells_voltage(charge_level(battery[state.USED], state.CAPACITY))
    current = robot.idle_current
    current += _drive(scene, robot, 0, robot.left, voltage)
    current += _drive(scene, robot, 1, robot.right, voltage)
    battery[state.CURRENT] = current
    battery[state.AVERAGE] += (current - battery[state.AVERAGE]) / _AVERAGE_TICKS
    if robot.is_discharged:
        battery[state.USED] = min(battery[state.USED] + current * (TICK_NS * 1e-9), state.CAPACITY)
    if voltage > CUT_OFF:
        return robot.vehicle[WANDERING] != 0
    robot.board[state.POWERED] = battery[state.CURRENT] = 0
    _cut_off(scene, robot, 0, robot.left)
    _cut_off(scene, robot, 1, robot.right)
    return True


@compilable
def _cut_off(scene: Scene, robot: Khepera3State, side: int, motor: MotorState) -> None:
    """Stop a motor, and switch off the LED of the same number, for lack of voltage."""
    for number in range(Pic.PULSES):
        motor.numbers[number] = 0
    motor.memory[MotorRegister.MODE] = PicMode.IDLE
    robot.board[state.LEDS + side] = 0
    set_motor(scene, robot.motors[side], 0.0)


@compilable
def _drive(scene: Scene, robot: Khepera3State, side: int, motor: MotorState, voltage: float) -> float:
    """Run a motor controller, and drive its motor; return the current from the battery [A]."""
    numbers, constant, sign = motor.numbers, robot.motor_constant, direction(motor)
    pulses = wheel_pulses(robot, joint_position(scene, robot.angles[side]))
    divisor = 4 if motor.memory[MotorRegister.HARDWARE_OPTIONS] & SINGLE_COUNT else 1
    way = pulses // divisor - numbers[Pic.PULSES] // divisor
    amperes = motor_torque(scene, robot.motors[side]) / constant
    rate = joint_speed(scene, robot.speeds[side]) * robot.pulses_per_radian
    numbers[Pic.PULSES] = pulses
    numbers[Pic.POSITION] = wrap(numbers[Pic.POSITION] + sign * way)
    numbers[Pic.SPEED] = sign * motor_control.measured_speed(rate)
    numbers[Pic.CURRENT] = sign * round(1000 * amperes)
    motor_control.control_motor(motor)
    duty = sign * numbers[Pic.PWM] / PWM_LIMIT
    drive_motor(scene, robot.faults, side, robot.motors[side], robot.speeds[side], constant, duty * voltage)
    return max(duty * amperes, 0.0)


@compilable
def _command(robot: Khepera3State, letter: int, left: int, right: int) -> None:
    """Execute D, F, L or P, with the signs of the motor controllers."""
    control = ControlType.SPEED.value
    if letter == _L:
        control = ControlType.OPEN_LOOP.value
    elif letter == _P:
        control = ControlType.POSITION.value
    elif letter == _F:
        control = ControlType.POSITION_PROFILE.value
    motor_control.set_order(robot.left, control, left)
    motor_control.set_order(robot.right, control, right)


@compilable
def _set_speeds(robot: Khepera3State, left: int, right: int) -> None:
    """Set the speeds forwards, by any options of the motor controllers."""
    motor_control.set_order(robot.left, ControlType.SPEED.value, left * direction(robot.left))
    motor_control.set_order(robot.right, ControlType.SPEED.value, right * direction(robot.right))


@compilable
def _is_powered(robot: Khepera3State) -> bool:
    """Return whether the supply suffices."""
    return robot.board[state.POWERED] != 0


def _request_terms(record: RobotState, names: Collection[str]) -> None:
    """Let all ultrasonic sensors measure, each burst immediately, if they are among the terms."""
    request_terms(record, names)
    if "ultrasonic" in names:
        record["board"][state.SETTING + Setting.ULTRASONIC] = (1 << state.N_ULTRASONIC) - 1


def _program(entry: RobotEntry, robot: Khepera3State) -> Letters:
    """Return the program on the line of a state, started."""
    letters = program_of(Bus(robot, entry.robot_model), entry.rom)
    letters.receive(b"\n")
    return letters


CORE = measuring_core(
    KHEPERA_3,
    Khepera3State,
    _start,
    state.SCAN_NS,
    state.set_infrared,
    state.BURST_NS,
    state.active_mask,
    state.measure_burst,
    state.keep_burst,
    state.fill_registers,
    make_state=state.make_state,
    changing=("left", "right", "board", "echoes", "burst_echoes", "battery"),
    modules=("motor_control", "state", "core"),
    tick=_tick,
    set_speeds=_set_speeds,
    is_powered=_is_powered,
    commands="DFLP",
    command=_command,
    counter_commands="IM",
    program=_program,
    request_terms=_request_terms,
)
