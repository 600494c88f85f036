"""State of a Khepera IV in the stepping core."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import mujoco
import numpy as np

from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera4 import dspic, gauge, inertial, ultrasonic
from khep_twin.robots.khepera4.dspic import N_ULTRASONIC, DspicState
from khep_twin.robots.khepera4.inertial import InertialState
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.vehicle import N_VEHICLE
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.bursts import ECHO, NONE
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import DeviceFaults
from khep_twin.sensing.ground import Ground
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams
from khep_twin.sensing.sonar import Sonar
from khep_twin.sensors import core_fields

N_MOMENTS = ECHO + N_ULTRASONIC


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
        sonar: Ultrasonic sensors.
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


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera4State:
    """Return the state of a robot at power-up."""
    battery = np.zeros(gauge.N_GAUGE)
    battery[gauge.USED] = gauge.used_charge(entry.battery_used_min)
    return Khepera4State(
        **core_fields(model, indices, measured, entry, first_moment),
        velocity=indices.velocity,
        idle_current=entry.body.idle_current,
        is_discharged=int(entry.battery_used_min is not None),
        first_moment=first_moment,
        ground=Ground.of(measured, entry.body.ground_height, lens=0.002),  # assumed
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
