"""Velocity commands of ROS 2, as speed setpoints of the wheels of a robot of any model."""

import math
from dataclasses import dataclass
from typing import Self

from khep_twin.errors import KhepTwinError
from khep_twin.log.message_types import Message
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.calibration import read_for

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
"""Types of velocity commands: that of ROS 2 Jazzy and earlier, and that of Kilted and later."""

_CONTROL_PERIOD = 0.01
"""Period of the pulses that a speed counts [s]."""


@dataclass(frozen=True, slots=True)
class Velocity:
    """Velocity of a robot: forward [m/s], and its turn to the left [rad/s]."""

    forward: float = 0.0
    turn: float = 0.0

    @classmethod
    def of_message(cls, type_name: str, message: Message) -> Self:
        """Return the velocity of a message of a type above.

        Raises:
            KhepTwinError: A speed is not finite.
        """
        twist = message["twist"] if type_name == TWIST_STAMPED else message
        forward, turn = twist["linear"]["x"], twist["angular"]["z"]
        if not (math.isfinite(forward) and math.isfinite(turn)):
            text = f"linear.x = {forward}, angular.z = {turn}: the robot stops"
            raise KhepTwinError(f"{text}; expected finite numbers")
        return cls(forward, turn)


STOP = Velocity()


@dataclass(frozen=True, slots=True)
class Setpoints:
    """Speed setpoints of the wheels [register]; `is_clamped` if the velocity is beyond the limit."""

    left: int
    right: int
    is_clamped: bool


def setpoint_limit(model: RobotModel) -> float:
    """Return the largest setpoint that a wheel can follow: that of its unloaded motor, or the protocol's.

    Raises:
        RobotModelError: The model gives no interface.
    """
    motors = read_for(model.calibration, model).motors
    no_load = motors.no_load_speed_rad_s * model.body.wheel_radius * _unit(model)
    return min(model.episode_interface.speed_limit, no_load)


def setpoints_of(model: RobotModel, velocity: Velocity, limit: float) -> Setpoints:
    """Return the setpoints for a velocity; beyond a limit they are reduced with the same curvature.

    Raises:
        RobotModelError: The model gives no interface.
    """
    unit = _unit(model)
    # Halves, as the sum of two finite numbers may be infinite.
    half_forward, half_turn = velocity.forward / 2, velocity.turn * model.body.wheel_base / 4
    halves = half_forward - half_turn, half_forward + half_turn
    largest = max(map(abs, halves))
    half_limit = limit / unit / 2
    is_clamped = largest > half_limit
    scale = (half_limit / largest if is_clamped else 1.0) * 2 * unit
    left, right = (round(half * scale) for half in halves)
    return Setpoints(left, right, is_clamped)


def _unit(model: RobotModel) -> float:
    """Return the setpoint of a speed of 1 m/s."""
    return _CONTROL_PERIOD * model.episode_interface.speed_per_pulse / model.body.pulse_length
