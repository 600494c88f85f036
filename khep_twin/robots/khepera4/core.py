"""Core of the Khepera IV: microcontroller, motors and battery of a robot.

At the end of a control period of 10 ms it updates

    1. pulses of the encoders, the dsPIC's control, voltage of the motors
    2. the accelerometer, and the gyroscope if a value is due
    3. the battery's charge; an empty one stops the robot

`state` has the other sensors. The functions are `compilable`, see `robots.core`.
"""

from khep_twin.board.memory import write_number
from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera4 import dspic, gauge, inertial, state
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.khepera4.motor_control import LEFT_PWM, N_MOTOR, PWM_LIMIT, RIGHT_PWM, Motor, stop
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.server import Kh4Server
from khep_twin.robots.khepera4.state import Khepera4State
from khep_twin.robots.measuring_core import measuring_core, wheel_pulses
from khep_twin.robots.vehicle import WANDERING
from khep_twin.sensing.device_faults import drive_motor
from khep_twin.sensing.scene import Scene, joint_position, joint_speed, motor_torque, set_motor
from khep_twin.sensing.simulated import Simulated, StepInputs

_CONTROL = int(DspicRegister.CONTROL)
_SPEED_CONTROL, _OPEN_LOOP, _MOVE = int(Control.SPEED), int(Control.OPEN_LOOP), int(Control.POSITION)
_SPEED_ORDER, _PWM_ORDER = int(DspicRegister.SPEED_ORDER_LEFT), int(DspicRegister.PWM_ORDER_LEFT)
_POSITION_ORDER, _ON_TARGET = int(DspicRegister.POSITION_ORDER_LEFT), int(Motor.ON_TARGET)
_D, _L, _F = map(ord, "DLF")


@compilable
def _start(robot: Khepera4State, simulated: Simulated) -> None:
    """Count from the wheels' present angles."""
    robot.zeros[0] = wheel_pulses(robot, joint_position(simulated.scene, robot.angles[0]))
    robot.zeros[1] = wheel_pulses(robot, joint_position(simulated.scene, robot.angles[1]))
    gauge.write_block(robot.dspic.memory, robot.gauge)


@compilable
def _tick(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run a control period; return True if it has stopped the robot, or the server's vehicle drives."""
    if not robot.dspic.powered[0]:
        return False
    scene, motors = simulated.scene, robot.dspic.motors
    left = wheel_pulses(robot, joint_position(scene, robot.angles[0])) - robot.zeros[0]
    right = wheel_pulses(robot, joint_position(scene, robot.angles[1])) - robot.zeros[1]
    dspic.tick(robot.dspic, left, right)
    voltage, current = gauge.battery_voltage(robot.gauge), robot.idle_current
    current += _drive(scene, robot, 0, motors[LEFT_PWM], voltage)
    current += _drive(scene, robot, 1, motors[RIGHT_PWM], voltage)
    _measure_motion(scene, robot, inputs, time_ns)
    if gauge.draw_current(robot.gauge, robot.is_discharged, current):
        gauge.write_block(robot.dspic.memory, robot.gauge)
    if voltage <= gauge.CUT_OFF:
        _cut_off(scene, robot)
        return True
    return robot.vehicle[WANDERING] != 0


@compilable
def _command(robot: Khepera4State, letter: int, left: int, right: int) -> None:
    """Execute D, L or F as the server does."""
    memory, motors = robot.dspic.memory, robot.dspic.motors
    control, register, size = _SPEED_CONTROL, _SPEED_ORDER, 2
    if letter == _L:
        control, register = _OPEN_LOOP, _PWM_ORDER
    elif letter == _F:
        control, register, size = _MOVE, _POSITION_ORDER, 4
        motors[_ON_TARGET] = motors[N_MOTOR + _ON_TARGET] = 0
    if memory[_CONTROL] != control:
        memory[_CONTROL] = control
        stop(motors, 0)
        stop(motors, N_MOTOR)
    write_number(memory, register, size, left)
    write_number(memory, register + size, size, right)


@compilable
def _set_speeds(robot: Khepera4State, left: int, right: int) -> None:
    """Set the speeds as the server's command D does [pulses/10 ms]."""
    _command(robot, _D, left, right)


@compilable
def _is_powered(robot: Khepera4State) -> bool:
    """Return whether the supply suffices."""
    return robot.dspic.powered[0] != 0


def _program(entry: RobotEntry, state: Khepera4State) -> Kh4Server:
    """Return the server of a state, started."""
    server = Kh4Server(dspic.Dspic(state.dspic), state.vehicle)
    server.receive(b"\n")
    return server


@compilable
def _drive(scene: Scene, robot: Khepera4State, side: int, pwm: int, voltage: float) -> float:
    """Drive a motor (0 left, 1 right) with a PWM; return the current that it takes from the battery [A]."""
    motor, speed, constant = robot.motors[side], robot.speeds[side], robot.motor_constant
    drive_motor(scene, robot.faults, side, motor, speed, constant, pwm / PWM_LIMIT * voltage)
    return max(pwm / PWM_LIMIT * motor_torque(scene, motor) / constant, 0.0)


@compilable
def _measure_motion(scene: Scene, robot: Khepera4State, inputs: StepInputs, time_ns: int) -> None:
    """Measure with accelerometer and gyroscope."""
    start, first = robot.velocity, robot.pose + 3
    velocity = joint_speed(scene, start), joint_speed(scene, start + 1), joint_speed(scene, start + 2)
    rate = joint_speed(scene, start + 3), joint_speed(scene, start + 4), joint_speed(scene, start + 5)
    w, x = joint_position(scene, first), joint_position(scene, first + 1)
    y, z = joint_position(scene, first + 2), joint_position(scene, first + 3)
    memory, rotation = robot.dspic.memory, rotation_of(w, x, y, z)
    inertial.measure(robot.inertial, memory, inputs.tables, robot.noise, time_ns, rotation, velocity, rate)


@compilable
def rotation_of(
    w: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the matrix of a rotation, row by row, as MuJoCo computes it from its quaternion."""
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return (
        ww + xx - yy - zz,
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        ww - xx + yy - zz,
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        ww - xx - yy + zz,
    )


@compilable
def _cut_off(scene: Scene, robot: Khepera4State) -> None:
    """Stop the robot for lack of voltage."""
    dspic.reset(robot.dspic)
    robot.dspic.powered[0] = 0
    gauge.write_block(robot.dspic.memory, robot.gauge)
    set_motor(scene, robot.motors[0], 0.0)
    set_motor(scene, robot.motors[1], 0.0)


CORE = measuring_core(
    KHEPERA_4,
    Khepera4State,
    _start,
    state.INFRARED_NS,
    state.set_infrared,
    state.BURST_NS,
    state.active_mask,
    state.measure_burst,
    state.keep_burst,
    state.fill_all,
    make_state=state.make_state,
    changing=("dspic", "inertial", "gauge", "zeros", "distances", "burst_distance"),
    modules=("motor_control", "dspic", "inertial", "gauge", "state", "core"),
    tick=_tick,
    set_speeds=_set_speeds,
    is_powered=_is_powered,
    commands="DLF",
    command=_command,
    counter_commands="IZ",
    program=_program,
)
