"""Core of the Toy: every 20 ms its sensors, every 10 ms its speed controllers; all state is in registers."""

import math
from typing import Any

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.robots.core import Core, register
from khep_twin.sensing.beams import cast_level_ray
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.device_faults import drive_motor, set_reading
from khep_twin.sensing.noise import draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.scene import Beams, joint_position, joint_speed
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row
from khep_twin.sensors import RobotFields, core_fields
from toy_robot.model import BODY, TOY

N_INFRARED, PERIOD_NS, REACH = 5, 20_000_000, 1.5
PROXIMITY, AMBIENT, ULTRASONIC, SPEED, SETPOINT, POSITION, N_REGISTERS = 0, 5, 10, 11, 13, 15, 17
"""Indices of the registers."""

_MM_PER_RAD, _PULSES_PER_RAD = 1000 * BODY.wheel_radius, BODY.pulses_per_turn / math.tau
(_EYE,) = BODY.sonar.places


@state_class
class ToyState(RobotFields):
    """State of one robot: the usual fields, the beam of its ultrasonic sensor, and registers."""

    beam: Beams
    registers: Vector[int]


def _make_state(*setup: Any) -> ToyState:
    return ToyState(**core_fields(*setup), beam=Beams.of(1), registers=np.zeros(N_REGISTERS, np.int64))


@compilable
def _measure(robot: ToyState, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure with all sensors."""
    scene, sensors, registers = simulated.scene, robot.sensors, robot.registers
    powers = inputs.powers[powers_row(simulated, inputs)]
    time_ns = simulated.counters[STEPS] * simulated.timing.step_ns
    for channel in range(N_INFRARED):
        noise = draws(inputs.tables, robot.noise, time_ns // PERIOD_NS * N_INFRARED + channel)
        near, light = convert(scene, sensors, simulated.light, powers, time_ns, channel, noise)
        set_reading(registers, PROXIMITY + channel, robot.faults, channel, near, 0)
        set_reading(registers, AMBIENT + channel, robot.faults, channel, light, sensors.ambient.ceiling)
    distance = cast_level_ray(scene, sensors, robot.beam, robot.pose, _EYE, REACH)
    set_reading(registers, ULTRASONIC, robot.faults, N_INFRARED, max(round(1000 * distance), 0), 0)


@compilable
def _sense(robot: ToyState, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Measure if it is time, and before time 0."""
    if simulated.counters[STEPS] * simulated.timing.step_ns % PERIOD_NS == 0:
        _measure(robot, simulated, inputs)


@compilable
def _tick(robot: ToyState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run the speed controllers, and count the wheels' ways."""
    scene, registers, constant, axles = simulated.scene, robot.registers, robot.motor_constant, robot.speeds
    for side in range(2):
        speed, setpoint = joint_speed(scene, axles[side]), registers[SETPOINT + side] / _MM_PER_RAD
        voltage = constant * (setpoint + 4 * (setpoint - speed))
        drive_motor(scene, robot.faults, side, robot.motors[side], axles[side], constant, voltage)
        registers[SPEED + side] = round(speed * _MM_PER_RAD)
        registers[POSITION + side] = round(joint_position(scene, robot.angles[side]) * _PULSES_PER_RAD)
    return False


_MODULES, _CHANGING = ("toy_robot.core", "khep_twin.sensing.beams"), ("registers", "beam")
CORE = register(
    Core("toy", ToyState, _make_state, _CHANGING, _MODULES, _sense, _tick, _measure, interface=TOY.interface)
)
