"""State of a Khepera IV in the stepping core, and its measurements.

Infrared sensors record a moment every 5 ms, an enabled ultrasonic one every 20 ms (manual). The latter miss
walls turned by 55 degrees or more beyond some 0.4 m. The functions are `compilable`, see
`robots.measuring_core`.
"""

from typing import cast

import mujoco
import numpy as np

from khep_twin.board.lithium_cells import used_charge
from khep_twin.board.memory import read_signed, write_number
from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera4 import dspic, gauge, inertial
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC, DspicState
from khep_twin.robots.khepera4.inertial import PACKET_SIZE, InertialState
from khep_twin.robots.khepera4.model import SAMPLED
from khep_twin.robots.khepera4.motor_control import LEFT_PWM, RIGHT_PWM
from khep_twin.robots.khepera4.registers import DISABLED, NO_ECHO, DspicRegister
from khep_twin.robots.measuring_core import MeasuringFields, measuring_fields
from khep_twin.sensing import sonar
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import sensor_reading, set_reading
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import BeamScene
from khep_twin.sensing.simulated import StepInputs


@state_class
class Khepera4State(MeasuringFields):
    """State of one robot.

    Attributes (see also `MeasuringFields`):
        velocity: Index of the robot's velocity.
        dspic: State of the microcontroller.
        inertial: State of accelerometer and gyroscope.
        gauge: State of the battery and its gauge (N_GAUGE,).
        zeros: Pulses of the wheels at which the encoders count zero (2,).
        distances: Last reading of each ultrasonic sensor (N_ULTRASONIC,) [cm].
        burst_distance: Distance by the last burst that was evaluated (1,) [cm].
    """

    velocity: int
    dspic: DspicState
    inertial: InertialState
    gauge: Vector[float]
    zeros: Vector[int]
    distances: Vector[int]
    burst_distance: Vector[int]


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera4State:
    """Return the state of a robot at power-up."""
    battery = np.zeros(gauge.N_GAUGE)
    battery[gauge.USED] = used_charge(gauge.CAPACITY, entry.battery_used_min, gauge.FULL_MIN)
    return Khepera4State(
        **measuring_fields(model, indices, measured, entry, first_moment),
        velocity=indices.velocity,
        dspic=dspic.power_up(),
        inertial=inertial.at_rest(),
        gauge=cast(Vector[float], battery),
        zeros=np.zeros(2, np.int64),
        distances=np.full(N_ULTRASONIC, NO_ECHO),
        burst_distance=np.zeros(1, np.int64),
    )


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

INFRARED_NS, BURST_NS = 5_000_000, 20_000_000
"""Periods of the infrared sensors and of bursts [ns]."""

(_DUTY,) = (channel.registers[0] for channel in SAMPLED if channel.name == "duty")
_PROXIMITY, _AMBIENT = int(DspicRegister.PROXIMITY), int(DspicRegister.AMBIENT)
_ENABLED, _ULTRASONIC_WORDS = int(DspicRegister.ULTRASONIC_ENABLED), int(DspicRegister.ULTRASONIC)


@compilable
def fill_registers(robot: Khepera4State) -> None:
    """Set the registers to the numbers of the dsPIC."""
    index, registers, memory = 0, robot.registers, robot.dspic.memory
    for first, size, is_signed, stride, count in WORDS:
        for number in range(count):
            value = read_signed(memory, first + number * stride, size)
            registers[index] = value if is_signed or value >= 0 else value + (1 << 8 * size)
            index += 1
    registers[_DUTY] = robot.dspic.motors[LEFT_PWM]
    registers[_DUTY + 1] = robot.dspic.motors[RIGHT_PWM]


@compilable
def write_distances(robot: Khepera4State, are_known: int) -> None:
    """Set the dsPIC's distances to those of the enabled sensors if they are known."""
    for sensor in range(N_ULTRASONIC):
        is_enabled = robot.dspic.memory[_ENABLED] >> sensor & 1 and are_known
        distance = robot.distances[sensor] if is_enabled else DISABLED
        write_number(robot.dspic.memory, _ULTRASONIC_WORDS + 2 * sensor, 2, distance)


@compilable
def fill_all(robot: Khepera4State) -> None:
    """Set the registers, those of the ultrasonic sensors to the distances of an eager robot."""
    write_distances(robot, robot.is_eager[0])
    fill_registers(robot)


@compilable
def active_mask(robot: Khepera4State) -> int:
    """Return the mask of the enabled ultrasonic sensors."""
    return robot.dspic.memory[_ENABLED]


@compilable
def measure_burst(
    robot: Khepera4State, scene: BeamScene, inputs: StepInputs, sensor: int, time_ns: int
) -> None:
    """Measure with an ultrasonic sensor in a scene at its burst."""
    distance = sonar.cast(scene, robot.sensors, robot.pose, robot.sonar, robot.beams, sensor, 0)
    number = time_ns // BURST_NS
    robot.burst_distance[0] = sonar.reading_of(robot.sonar, distance, inputs.tables, robot.noise, number)


@compilable
def keep_burst(robot: Khepera4State, sensor: int) -> None:
    """Set the reading of an ultrasonic sensor; a dead one receives no echo (assumed)."""
    number, distance = N_INFRARED + sensor, robot.burst_distance[0]
    set_reading(robot.distances, sensor, robot.faults, number, distance, NO_ECHO)


@compilable
def set_infrared(robot: Khepera4State, channel: int, proximity: int, ambient: int) -> None:
    """Set the registers of an infrared sensor."""
    memory, darkest = robot.dspic.memory, robot.ground.darkest
    for word, reading, dead in ((_PROXIMITY, proximity, 0), (_AMBIENT, ambient, darkest)):
        start = word + 2 * channel
        reading = sensor_reading(robot.faults, channel, reading, read_signed(memory, start, 2), dead)
        write_number(memory, start, 2, reading)
