"""Core of the Khepera IV: microcontroller, sensors, motors and battery of a robot.

At the end of a control period of 10 ms it updates

    1. pulses of the encoders, the dsPIC's control, voltage of the motors
    2. the accelerometer, and the gyroscope if a value is due
    3. the battery's charge; an empty one stops the robot

Infrared sensors record a moment every 5 ms, an enabled ultrasonic one every 20 ms. A moment is evaluated when
its readings are read. The functions are `compilable`, see `robots.core`.
"""

import math
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, cast

import mujoco
import numpy as np

from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.core import Core, RobotState, register
from khep_twin.robots.khepera4 import dspic, gauge, inertial, infrared, ultrasonic
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC, DspicState
from khep_twin.robots.khepera4.inertial import PACKET_SIZE, InertialState
from khep_twin.robots.khepera4.infrared import Ground
from khep_twin.robots.khepera4.model import BODY, KHEPERA_4, SAMPLED
from khep_twin.robots.khepera4.motor_control import N_MOTOR, PWM_LIMIT, Motor, stop
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.server import N_VEHICLE, WANDERING, Kh4Server
from khep_twin.robots.khepera4.ultrasonic import Sonar
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import DeviceFaults, drive_motor, set_reading
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import (
    Beams,
    BeamScene,
    Scene,
    copy_moment,
    joint_position,
    joint_speed,
    motor_torque,
    save_moment,
    set_motor,
    update_frames,
)
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row
from khep_twin.sensors import core_fields

PULSES_PER_TURN = BODY.pulses_per_turn
"""Pulses of an encoder in a turn of its wheel (manual)."""

INFRARED, BURST, ECHO = 0, 1, 2
"""Moments of a robot: of its infrared sensors, of the last burst, and of the last complete burst of each
ultrasonic sensor, from ECHO on."""
N_MOMENTS = ECHO + N_ULTRASONIC

NONE = -1
"""No time of a moment; no ultrasonic sensor."""

(_DUTY,) = (channel.registers[0] for channel in SAMPLED if channel.name == "duty")
_CONTROL, _ULTRASONIC_WORDS = int(DspicRegister.CONTROL), int(DspicRegister.ULTRASONIC)
_SPEED_CONTROL, _OPEN_LOOP, _MOVE = int(Control.SPEED), int(Control.OPEN_LOOP), int(Control.POSITION)
_SPEED_ORDER, _PWM_ORDER = int(DspicRegister.SPEED_ORDER_LEFT), int(DspicRegister.PWM_ORDER_LEFT)
_POSITION_ORDER, _ON_TARGET = int(DspicRegister.POSITION_ORDER_LEFT), int(Motor.ON_TARGET)
_D, _L, _F = map(ord, "DLF")
_ENABLED = int(DspicRegister.ULTRASONIC_ENABLED)
_LEFT_PWM, _RIGHT_PWM = int(Motor.PWM), N_MOTOR + int(Motor.PWM)


class Khepera4State(NamedTuple):
    """State of one robot.

    Attributes:
        angles: Indices of the wheels' positions, left and right (2,).
        speeds: Indices of the wheels' speeds (2,).
        motors: Indices of the motors (2,).
        pose: Index of the robot's pose.
        velocity: Index of the robot's velocity.
        radius: Radius of the robot [m].
        motor_constant: Torque per current [N m/A].
        idle_current: Current with the motors at rest [A].
        is_discharged: 1 if the battery is discharged during the run.
        first_moment: Number of its first moment.
        sensors: Infrared sensors.
        faults: Faults of sensors and motors.
        ground: Those that look at the floor.
        sonar: Rays of the ultrasonic sensors.
        beams: Buffers for them.
        dspic: State of the microcontroller.
        inertial: State of accelerometer and gyroscope.
        gauge: State of the battery and its gauge (N_GAUGE,).
        zeros: Pulses of the wheels at which the encoders count zero (2,).
        burst: Sensor of the last burst, or NONE (1,).
        distances: Last reading of each ultrasonic sensor (N_ULTRASONIC,) [cm].
        is_eager: 1 if a burst is evaluated immediately, without a moment (1,).
        burst_distance: Then the distance by the last burst (1,) [cm].
        times: Time of each moment, NONE if there is nothing to evaluate (N_MOMENTS,) [ns].
        registers: Registers as in logs, in the order of `CHANNELS` (n_registers,).
        vehicle: State of the server's Braitenberg vehicle (N_VEHICLE,).
        noise: Key of the robot's random draws, as two words (2,).
    """

    angles: Sequence[int]
    speeds: Sequence[int]
    motors: Sequence[int]
    pose: int
    velocity: int
    radius: float
    motor_constant: float
    idle_current: float
    is_discharged: int
    first_moment: int
    sensors: RobotSensors
    faults: DeviceFaults
    ground: Ground
    sonar: Sonar
    beams: Beams
    dspic: DspicState
    inertial: InertialState
    gauge: Vector[float]
    zeros: Vector[int]
    burst: Vector[int]
    distances: Vector[int]
    is_eager: Vector[int]
    burst_distance: Vector[int]
    times: Vector[int]
    registers: Vector[int]
    vehicle: Vector[int]
    noise: Vector[int]


def _make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera4State:
    ground = measured.ground
    assert ground is not None  # checked with the playpen
    battery = np.zeros(gauge.N_GAUGE)
    battery[gauge.USED] = gauge.used_charge(entry.battery_used_min)
    return Khepera4State(
        **core_fields(model, indices, measured, entry, first_moment),
        velocity=indices.velocity,
        idle_current=entry.body.idle_current,
        is_discharged=int(entry.battery_used_min is not None),
        first_moment=first_moment,
        ground=Ground(
            list(map(float, ground.white_counts)),
            float(ground.nothing_counts),
            float(ground.noise_counts),
            ground.spot_mm * 1e-3,
            int(measured.ambient.rises_with_light),
        ),
        sonar=(sonar := ultrasonic.make_sonar()),
        beams=Beams.of(len(sonar.gains)),
        dspic=dspic.power_up(),
        inertial=inertial.at_rest(),
        gauge=cast(Vector[float], battery),
        zeros=np.zeros(2, np.int64),
        burst=np.full(1, NONE),
        distances=np.full(N_ULTRASONIC, ultrasonic.NO_ECHO),
        is_eager=np.zeros(1, np.int64),
        burst_distance=np.zeros(1, np.int64),
        times=np.full(N_MOMENTS, NONE),
        registers=np.zeros(KHEPERA_4.episode_interface.n_registers, np.int64),
        vehicle=np.zeros(N_VEHICLE, np.int64),
    )


@compilable
def _sense(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Record the moments of a step, if any are due."""
    time_ns = simulated.counters[STEPS] * simulated.timing.step_ns
    if start >= 0 and time_ns % infrared.PERIOD_NS == 0:
        _record(robot, simulated, inputs, time_ns)


@compilable
def _record(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> None:
    """Record the moments that are due at a time [ns]."""
    scene, times, first = simulated.scene, robot.times, robot.first_moment
    powers = inputs.powers[powers_row(simulated, inputs)]
    save_moment(scene, first + INFRARED, powers)
    times[INFRARED] = time_ns
    if time_ns % ultrasonic.PERIOD_NS:
        return
    last = robot.burst[0]
    if robot.is_eager[0] and last != NONE:
        _set_distance(robot, last, robot.burst_distance[0])
    elif last != NONE:
        copy_moment(scene, first + BURST, first + ECHO + last)
        times[ECHO + last] = times[BURST]
    robot.burst[0] = _next_sensor(last, robot.dspic.memory[_ENABLED])
    if robot.burst[0] == NONE:
        return
    if robot.is_eager[0]:
        update_frames(scene)
        robot.burst_distance[0] = _measure_distance(robot, scene, inputs, robot.burst[0], time_ns)
    else:
        save_moment(scene, first + BURST, powers)
    times[BURST] = time_ns


@compilable
def _next_sensor(last: int, enabled_mask: int) -> int:
    """Return the enabled ultrasonic sensor after the last one, or NONE."""
    for offset in range(1, N_ULTRASONIC + 1):
        sensor = (last + offset) % N_ULTRASONIC
        if enabled_mask >> sensor & 1:
            return sensor
    return NONE


def _scan(robot: Khepera4State, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure with all infrared sensors now."""
    save_moment(simulated.scene, robot.first_moment + INFRARED, inputs.powers[0])
    robot.times[INFRARED] = simulated.counters[STEPS] * simulated.timing.step_ns


@compilable
def _start(robot: Khepera4State, simulated: Simulated, inputs: StepInputs) -> bool:
    """Count from the wheels' present angles, and measure at time 0."""
    robot.zeros[0] = wheel_pulses(joint_position(simulated.scene, robot.angles[0]))
    robot.zeros[1] = wheel_pulses(joint_position(simulated.scene, robot.angles[1]))
    gauge.write_block(robot.dspic.memory, robot.gauge)
    _record(robot, simulated, inputs, 0)
    return False


@compilable
def _tick(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run a control period; return True if it has stopped the robot, or the server's vehicle drives."""
    if not robot.dspic.powered[0]:
        return False
    scene, motors = simulated.scene, robot.dspic.motors
    left = wheel_pulses(joint_position(scene, robot.angles[0])) - robot.zeros[0]
    right = wheel_pulses(joint_position(scene, robot.angles[1])) - robot.zeros[1]
    dspic.tick(robot.dspic, left, right)
    voltage, current = gauge.battery_voltage(robot.gauge), robot.idle_current
    current += _drive(scene, robot, 0, motors[_LEFT_PWM], voltage)
    current += _drive(scene, robot, 1, motors[_RIGHT_PWM], voltage)
    _measure_motion(scene, robot, inputs, time_ns)
    if gauge.draw_current(robot.gauge, robot.is_discharged, current):
        gauge.write_block(robot.dspic.memory, robot.gauge)
    if voltage <= gauge.CUT_OFF:
        _cut_off(scene, robot)
        return True
    return robot.vehicle[WANDERING] != 0


@compilable
def wheel_pulses(angle: float) -> int:
    """Return the pulses of an encoder at a wheel's angle [rad]."""
    return math.floor(angle * (PULSES_PER_TURN / math.tau) + 0.5)


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


@compilable
def _evaluate(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    """Evaluate the moment INFRARED, or that of an ultrasonic sensor from ECHO on."""
    if part == INFRARED:
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[0])
    else:
        sensor, scene, time_ns = part - ECHO, simulated.scene, robot.times[part]
        _set_distance(robot, sensor, _measure_distance(robot, scene, inputs, sensor, time_ns))
        robot.times[part] = NONE


@compilable
def _set_distance(robot: Khepera4State, sensor: int, distance: int) -> None:
    """Set the reading of an ultrasonic sensor; a dead one receives no echo (assumed)."""
    number, silence = N_INFRARED + sensor, ultrasonic.NO_ECHO
    set_reading(robot.distances, sensor, robot.faults, number, distance, silence)


@compilable
def _measure_distance(
    robot: Khepera4State, scene: BeamScene, inputs: StepInputs, sensor: int, time_ns: int
) -> int:
    """Return the reading of an ultrasonic sensor in a scene at its burst."""
    centre, beams, tables = _centre(scene, robot.pose), robot.beams, inputs.tables
    return ultrasonic.measure(
        scene, robot.sensors, centre, robot.sonar, beams, tables, robot.noise, time_ns, sensor
    )


@compilable
def _evaluate_infrared(
    robot: Khepera4State, simulated: Simulated, inputs: StepInputs, powers: Sequence[float]
) -> None:
    """Measure with the infrared sensors in a scene at their moment."""
    scene, light, memory, time_ns = (
        simulated.scene,
        simulated.light,
        robot.dspic.memory,
        robot.times[INFRARED],
    )
    tables, noise, sensors, faults = inputs.tables, robot.noise, robot.sensors, robot.faults
    infrared.measure(scene, sensors, faults, robot.ground, light, powers, tables, noise, time_ns, memory)
    robot.times[INFRARED] = NONE


@compilable
def _centre(scene: BeamScene, pose: int) -> tuple[float, float, float]:
    """Return the position of a robot."""
    return joint_position(scene, pose), joint_position(scene, pose + 1), joint_position(scene, pose + 2)


WORDS = (
    (int(DspicRegister.PROXIMITY), 2, 0, 2, N_INFRARED),
    (int(DspicRegister.AMBIENT), 2, 0, 2, N_INFRARED),
    (int(DspicRegister.ULTRASONIC), 2, 0, 2, N_ULTRASONIC),
    (int(DspicRegister.SPEED_LEFT), 2, 1, 2, 2),
    (int(DspicRegister.SPEED_ORDER_LEFT), 2, 1, 2, 2),
    (int(DspicRegister.POSITION_LEFT), 4, 1, 4, 2),
    (int(DspicRegister.POSITION_ORDER_LEFT), 4, 1, 4, 2),
    (0, 1, 0, 0, 2),  # places of both PWM, which are not in the memory
    (int(DspicRegister.LEDS), 1, 0, 1, 9),
    (int(DspicRegister.ACCELEROMETER), 2, 1, 2 * PACKET_SIZE, 3),
    (int(DspicRegister.GYROSCOPE), 2, 1, 2 * PACKET_SIZE, 3),
    (int(DspicRegister.BATTERY) + 10, 2, 0, 2, 1),  # voltage
    (int(DspicRegister.BATTERY) + 4, 2, 1, 2, 1),  # current
    (int(DspicRegister.BATTERY) + 1, 2, 0, 2, 1),  # charge
    (int(DspicRegister.BATTERY) + 8, 2, 1, 2, 1),  # temperature
    (int(DspicRegister.CONTROL), 1, 0, 1, 1),
    (int(DspicRegister.ON_TARGET), 1, 0, 1, 1),
    (int(DspicRegister.ULTRASONIC_ENABLED), 1, 0, 1, 1),
    (int(DspicRegister.STATUS_LED), 1, 0, 1, 1),
)
"""Numbers of the dsPIC's memory in the order of `CHANNELS`: first byte, size, 1 if signed, distance from one
to the next [bytes], and their number."""


@compilable
def fill_registers(robot: Khepera4State) -> None:
    """Set the registers to the numbers of the dsPIC."""
    index, registers, memory = 0, robot.registers, robot.dspic.memory
    for first, size, is_signed, stride, count in WORDS:
        for number in range(count):
            value = dspic.read_signed(memory, first + number * stride, size)
            registers[index] = value if is_signed or value >= 0 else value + (1 << 8 * size)
            index += 1
    registers[_DUTY] = robot.dspic.motors[_LEFT_PWM]
    registers[_DUTY + 1] = robot.dspic.motors[_RIGHT_PWM]


@compilable
def _update_registers(robot: Khepera4State, simulated: Simulated, inputs: StepInputs) -> None:
    """Evaluate the infrared sensors, whose moment is the present, and set the registers."""
    if robot.times[INFRARED] != NONE:
        update_frames(simulated.scene)
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[powers_row(simulated, inputs)])
    for sensor in range(N_ULTRASONIC):
        is_enabled = robot.dspic.memory[_ENABLED] >> sensor & 1 and robot.is_eager[0]
        distance = robot.distances[sensor] if is_enabled else ultrasonic.DISABLED
        dspic.write_number(robot.dspic.memory, _ULTRASONIC_WORDS + 2 * sensor, 2, distance)
    fill_registers(robot)


def _request_terms(record: Any, names: Collection[str]) -> None:
    """Evaluate each burst immediately if the ultrasonic sensors are among the terms."""
    record["is_eager"] = "ultrasonic" in names


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
    dspic.write_number(memory, register, size, left)
    dspic.write_number(memory, register + size, size, right)


@compilable
def _set_speeds(robot: Khepera4State, left: int, right: int) -> None:
    """Set the speeds as the server's command D does [pulses/10 ms]."""
    _command(robot, _D, left, right)


@compilable
def _echo(robot: RobotState, scene: BeamScene, sensor: int) -> float:
    """Return the distance by level rays of an ultrasonic sensor, which meet all upright obstacles first."""
    n_rays, centre, beams = ultrasonic.N_LEVEL, _centre(scene, robot.pose), robot.beams
    vectors, normals = beams.vectors[: 3 * n_rays], beams.normals[: 3 * n_rays]
    level = Beams(vectors, beams.lengths[:n_rays], normals, beams.geoms[:n_rays])
    first = ultrasonic.FIRST_LEVEL
    nearest = ultrasonic.cast(scene, robot.sensors, centre, robot.sonar, level, sensor, first)
    return 0.0 if nearest < ultrasonic.NEAREST else nearest if nearest <= ultrasonic.RANGE else math.inf


def _program(entry: RobotEntry, state: Khepera4State) -> Kh4Server:
    """Return the server of a state, started."""
    server = Kh4Server(dspic.Dspic(state.dspic), state.vehicle)
    server.receive(b"\n")
    return server


@compilable
def _is_powered(robot: Khepera4State) -> bool:
    """Return whether the supply suffices."""
    return robot.dspic.powered[0] != 0


_PARTS = "motor_control", "dspic", "inertial", "gauge", "infrared", "ultrasonic", "core"

CORE = register(
    Core(
        name="khepera4",
        state=Khepera4State,
        make_state=_make_state,
        changing=(
            *("dspic", "inertial", "gauge", "zeros", "burst", "distances", "burst_distance"),
            *("times", "vehicle", "beams", "registers"),
        ),
        n_moments=N_MOMENTS,
        modules=("khep_twin.board.kernel", *(f"khep_twin.robots.khepera4.{part}" for part in _PARTS)),
        sense=_sense,
        tick=_tick,
        start=_start,
        evaluate=_evaluate,
        scan=_scan,
        interface=KHEPERA_4.interface,
        request_terms=_request_terms,
        update_registers=_update_registers,
        set_speeds=_set_speeds,
        is_powered=_is_powered,
        commands="DLF",
        command=_command,
        counter_commands="IZ",
        echo=_echo,
        program=_program,
    )
)
