"""State of a Khepera III in the stepping core."""

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import mujoco
import numpy as np

from khep_twin.board import lithium_cells
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera3.channels import ULTRASONIC
from khep_twin.robots.khepera3.model import GROUND_HEIGHT, KHEPERA_3, SONAR
from khep_twin.robots.khepera3.motor_control import N_MOTOR, write_number
from khep_twin.robots.khepera3.registers import DEFAULTS, N_BYTES, SETTINGS
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import DeviceFaults
from khep_twin.sensing.ground import Ground
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams
from khep_twin.sensing.sonar import Sonar
from khep_twin.sensors import core_fields

N_ULTRASONIC = len(ULTRASONIC)

INFRARED, BURST, ECHO = 0, 1, 2
"""Moments of a robot: of its infrared sensors, of the last burst, and of the last complete burst of each
ultrasonic sensor, from ECHO on."""
N_MOMENTS = ECHO + N_ULTRASONIC

NONE = -1
"""No time of a moment; no ultrasonic sensor."""

POWERED, TIMER_ZERO_MS, SCAN_MS, LAST_BURST, EVALUATES_BURSTS, LEDS, SETTING = 0, 1, 2, 3, 4, 5, 7
"""Indices in the state of the board: whether the supply suffices, the timer's zero, time of the last infrared
readings, sensor of the last burst, whether bursts are evaluated at once, states of two LEDs, and the
configuration."""
N_BOARD = SETTING + len(SETTINGS)

MAX_ECHOES = 5
N_ECHO = 1 + 3 * MAX_ECHOES
"""Numbers of an ultrasonic reading: number of echoes; distance [cm], amplitude and time [ms] of each."""

WANDERING, TURNING, N_STILL, LAST_LEFT, LAST_RIGHT = range(5)
"""Indices in the state of the vehicle of letter A: 1 with infrared sensors, 2 with ultrasonic ones; whether it
turns in place, control periods without motion, and position at the last motion [pulses]."""
N_VEHICLE = 5

USED, CURRENT, AVERAGE = range(3)
"""Indices in the state of the battery: used charge [C], current and average current [A]."""
N_BATTERY = 3

CAPACITY, FULL_MIN = 1.35 * 3600, 480
"""Charge of a full battery [C], and its time of use [min] (K-Team's product page, remembered)."""


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
        memory: Bytes of the left and right motor controller (2 * N_BYTES,).
        controllers: Numbers of the left and right motor controller (2 * N_MOTOR,).
        counts: Pulses of the encoders at the last control period (2,).
        board: State of the dsPIC (N_BOARD,).
        echoes: Last reading of each ultrasonic sensor (N_ULTRASONIC * N_ECHO,).
        burst: Reading of the last burst, if it is evaluated at once (N_ECHO,).
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
    memory: Vector[int]
    controllers: Vector[int]
    counts: Vector[int]
    board: Vector[int]
    echoes: Vector[int]
    burst: Vector[int]
    times: Vector[int]
    battery: Vector[float]
    vehicle: Vector[int]
    registers: Vector[int]
    noise: Vector[int]


def power_up_memory() -> Vector[int]:
    """Return the registers of both motor controllers at power-up (2 * N_BYTES,)."""
    memory: Vector[int] = np.zeros(2 * N_BYTES, np.int64)
    for first in (0, N_BYTES):
        for register, (value, size) in DEFAULTS.items():
            write_number(memory, first + register, size, value)
    return memory


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera3State:
    """Return the state of a robot at power-up."""
    board: Vector[int] = np.zeros(N_BOARD, np.int64)
    battery = np.zeros(N_BATTERY)
    board[POWERED], board[LAST_BURST], board[SETTING:] = 1, NONE, SETTINGS
    battery[USED] = lithium_cells.used_charge(CAPACITY, entry.battery_used_min, FULL_MIN)
    # 0.2 to 4 m (product page, remembered); half the amplitude at 35 degrees off the axis (a simulator).
    sonar = Sonar.of(SONAR, reach=4.0, nearest=0.2, exponent=3.5, noise_cm=0.4)
    return Khepera3State(
        **core_fields(model, indices, measured, entry, first_moment),
        idle_current=entry.body.idle_current,
        is_discharged=int(entry.battery_used_min is not None),
        pulses_per_radian=entry.body.pulses_per_turn / math.tau,
        first_moment=first_moment,
        ground=Ground.of(measured, GROUND_HEIGHT, 0.002),
        sonar=sonar,
        beams=Beams.of(len(sonar.gains)),
        memory=power_up_memory(),
        controllers=np.zeros(2 * N_MOTOR, np.int64),
        counts=np.zeros(2, np.int64),
        board=board,
        echoes=np.zeros(N_ULTRASONIC * N_ECHO, np.int64),
        burst=np.zeros(N_ECHO, np.int64),
        times=np.full(N_MOMENTS, NONE),
        battery=cast(Vector[float], battery),
        vehicle=np.zeros(N_VEHICLE, np.int64),
        registers=np.zeros(KHEPERA_3.episode_interface.n_registers, np.int64),
    )
