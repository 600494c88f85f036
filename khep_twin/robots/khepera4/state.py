"""State of a Khepera IV in the stepping core."""

from typing import cast

import mujoco
import numpy as np

from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera4 import dspic, gauge, inertial
from khep_twin.robots.khepera4.channels import NO_ECHO
from khep_twin.robots.khepera4.dspic import N_ULTRASONIC, DspicState
from khep_twin.robots.khepera4.inertial import InertialState
from khep_twin.robots.measuring_core import MeasuringFields, measuring_fields
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices


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
