"""State of a Khepera III in the stepping core."""

import math
from typing import cast

import mujoco
import numpy as np

from khep_twin.board import lithium_cells
from khep_twin.playpen import RobotEntry
from khep_twin.robots.khepera3 import motor_control
from khep_twin.robots.khepera3.channels import ULTRASONIC
from khep_twin.robots.khepera3.motor_control import MotorState
from khep_twin.robots.khepera3.registers import SETTINGS
from khep_twin.robots.measuring_core import MeasuringFields, measuring_fields
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices

N_ULTRASONIC = len(ULTRASONIC)

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


@state_class
class Khepera3State(MeasuringFields):
    """State of one robot.

    Attributes (see also `MeasuringFields`):
        pulses_per_radian: Pulses of an encoder per angle of its wheel [1/rad].
        left: Left motor controller.
        right: Right motor controller.
        board: State of the dsPIC (N_BOARD,).
        echoes: Last reading of each ultrasonic sensor (N_ULTRASONIC * N_ECHO,).
        burst_echoes: Reading of the last burst that was evaluated (N_ECHO,).
        battery: State of the battery (N_BATTERY,).
    """

    pulses_per_radian: float
    left: MotorState
    right: MotorState
    board: Vector[int]
    echoes: Vector[int]
    burst_echoes: Vector[int]
    battery: Vector[float]


def make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> Khepera3State:
    """Return the state of a robot at power-up."""
    used = lithium_cells.used_charge(CAPACITY, entry.battery_used_min, FULL_MIN)
    return Khepera3State(
        **measuring_fields(model, indices, measured, entry, first_moment),
        pulses_per_radian=entry.body.pulses_per_turn / math.tau,
        left=motor_control.power_up(-1),
        right=motor_control.power_up(1),
        board=np.array([1, 0, 0, 0, 0, *SETTINGS]),
        echoes=np.zeros(N_ULTRASONIC * N_ECHO, np.int64),
        burst_echoes=np.zeros(N_ECHO, np.int64),
        battery=cast(Vector[float], np.array([used, 0.0, 0.0])),
    )
