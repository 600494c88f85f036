"""State of a Khepera IV in the stepping core."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import mujoco
import numpy as np

from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera4 import dspic, gauge, inertial
from khep_twin.robots.khepera4.channels import NO_ECHO
from khep_twin.robots.khepera4.dspic import N_ULTRASONIC, DspicState
from khep_twin.robots.khepera4.inertial import InertialState
from khep_twin.robots.measuring_core import measuring_fields
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import DeviceFaults
from khep_twin.sensing.ground import Ground
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams
from khep_twin.sensing.sonar import Sonar


class Khepera4State(NamedTuple):
    """State of one robot.

    Attributes (the others are in `core_fields` and `measuring_fields`):
        velocity: Index of the robot's velocity.
        dspic: State of the microcontroller.
        inertial: State of accelerometer and gyroscope.
        gauge: State of the battery and its gauge (N_GAUGE,).
        zeros: Pulses of the wheels at which the encoders count zero (2,).
        distances: Last reading of each ultrasonic sensor (N_ULTRASONIC,) [cm].
        burst_distance: Distance by the last burst that was evaluated (1,) [cm].
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
        **measuring_fields(model, indices, measured, entry, first_moment),
        velocity=indices.velocity,
        dspic=dspic.power_up(),
        inertial=inertial.at_rest(),
        gauge=cast(Vector[float], battery),
        zeros=np.zeros(2, np.int64),
        distances=np.full(N_ULTRASONIC, NO_ECHO),
        burst_distance=np.zeros(1, np.int64),
    )
