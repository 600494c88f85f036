"""State of a Khepera III in the stepping core."""

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import mujoco
import numpy as np

from khep_twin.board import lithium_cells
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera3 import motor_control
from khep_twin.robots.khepera3.channels import ULTRASONIC
from khep_twin.robots.khepera3.model import KHEPERA_3, SONAR
from khep_twin.robots.khepera3.motor_control import MotorState
from khep_twin.robots.khepera3.registers import SETTINGS
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

N_ULTRASONIC = len(ULTRASONIC)
N_MOMENTS = ECHO + N_ULTRASONIC

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


class Khepera3State(NamedTuple):
    """State of one robot.

    Attributes:
        angles: Indices of the wheels' positions, left and right (2,).
        speeds: Indices of the wheels' speeds (2,).
        motors: Indices of the motors (2,).
        pose: Index of the robot's pose.
        radius: Radius of the robot [m].
        motor_constant: Torque per current [N m/A].
        idle_current: Current with the motors at rest [A].
        is_discharged: 1 if the battery is discharged during the run.
        pulses_per_radian: Pulses of an encoder per angle of its wheel [1/rad].
        first_moment: Number of its first moment.
        sensors: Infrared sensors.
        faults: Faults of sensors and motors.
        ground: Sensors of the ground.
        sonar: Ultrasonic sensors.
        beams: Buffers for their rays.
        left: Left motor controller.
        right: Right motor controller.
        board: State of the dsPIC (N_BOARD,).
        echoes: Last reading of each ultrasonic sensor (N_ULTRASONIC * N_ECHO,).
        burst: Sensor of the last burst, or NONE (1,).
        is_eager: 1 if a burst is evaluated immediately, without a moment (1,).
        burst_echoes: Then the reading of the last burst (N_ECHO,).
        times: Time of each moment, NONE if there is nothing to evaluate (N_MOMENTS,) [ns].
        battery: State of the battery (N_BATTERY,).
        vehicle: State of the vehicle (N_VEHICLE,).
        registers: Registers as in logs, in the order of `CHANNELS` (n_registers,).
        noise: Key of the robot's random draws, as two words (2,).
    """

    angles: Sequence[int]
    speeds: Sequence[int]
    motors: Sequence[int]
    pose: int
    radius: float
    motor_constant: float
    idle_current: float
    is_discharged: int
    pulses_per_radian: float
    first_moment: int
    sensors: RobotSensors
    faults: DeviceFaults
    ground: Ground
    sonar: Sonar
    beams: Beams
    left: MotorState
    right: MotorState
    board: Vector[int]
    echoes: Vector[int]
    burst: Vector[int]
    is_eager: Vector[int]
    burst_echoes: Vector[int]
    times: Vector[int]
    battery: Vector[float]
    vehicle: Vector[int]
    registers: Vector[int]
    noise: Vector[int]


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera3State:
    """Return the state of a robot at power-up."""
    used = lithium_cells.used_charge(CAPACITY, entry.battery_used_min, FULL_MIN)
    sonar = Sonar.of(SONAR, SONAR.reach, SONAR.nearest, SONAR.exponent, noise_cm=0.4)
    return Khepera3State(
        **core_fields(model, indices, measured, entry, first_moment),
        idle_current=entry.body.idle_current,
        is_discharged=int(entry.battery_used_min is not None),
        pulses_per_radian=entry.body.pulses_per_turn / math.tau,
        first_moment=first_moment,
        ground=Ground.of(measured, entry.body.ground_height, 0.002),
        sonar=sonar,
        beams=Beams.of(len(sonar.gains)),
        left=motor_control.power_up(-1),
        right=motor_control.power_up(1),
        board=np.array([1, 0, 0, 0, 0, *SETTINGS]),
        echoes=np.zeros(N_ULTRASONIC * N_ECHO, np.int64),
        burst=np.full(1, NONE),
        is_eager=np.zeros(1, np.int64),
        burst_echoes=np.zeros(N_ECHO, np.int64),
        times=np.full(N_MOMENTS, NONE),
        battery=cast(Vector[float], np.array([used, 0.0, 0.0])),
        vehicle=np.zeros(N_VEHICLE, np.int64),
        registers=np.zeros(KHEPERA_3.episode_interface.n_registers, np.int64),
    )
