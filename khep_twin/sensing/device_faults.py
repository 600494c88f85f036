"""Faults of a robot's sensors and motors, which the stepping core applies. The functions are `compilable`."""

from typing import NamedTuple, Self, cast

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.robots.body import Body
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.scene import Scene, joint_speed, set_motor

SOUND, STUCK, DEAD = 0, 1, 2
"""States of a sensor; a stuck one repeats its last reading, the receiver of a dead one passes no current."""


class DeviceFaults(NamedTuple):
    """Faults of a robot's devices, the field `faults` of its state.

    Attributes:
        sensors: State of each sensor, in the order of `Body.fault_sensors`: SOUND, STUCK or DEAD (n,).
        strengths: Fractions of their torque that the left and right motor produce (2,).
    """

    sensors: Vector[int]
    strengths: Vector[float]

    @classmethod
    def of(cls, body: Body) -> Self:
        """Return devices without faults."""
        return cls(np.zeros(len(body.fault_sensors), np.int64), cast(Vector[float], np.ones(2)))


@compilable
def sensor_reading(faults: DeviceFaults, sensor: int, reading: int, last: int, dead: int) -> int:
    """Return the reading of a sensor with its fault, if it has one.

    Args:
        faults: Faults of the robot.
        sensor: Number of the sensor.
        reading: Reading without a fault.
        last: Last reading.
        dead: Reading of a dead sensor.
    """
    state = faults.sensors[sensor]
    if state == STUCK:
        return last
    return dead if state == DEAD else reading


@compilable
def set_reading(
    registers: Vector[int], register: int, faults: DeviceFaults, sensor: int, reading: int, dead: int
) -> None:
    """Set the register of a sensor to its reading with its fault; arguments as for `sensor_reading`."""
    registers[register] = sensor_reading(faults, sensor, reading, registers[register], dead)


@compilable
def drive_motor(
    scene: Scene, faults: DeviceFaults, side: int, motor: int, speed: int, constant: float, voltage: float
) -> None:
    """Set the voltage of a motor [V], for a weak one that at which it produces its fraction of the torque.

    A motor without current has only its back-EMF (the voltage that it generates), and no torque.

    Args:
        scene: Scene.
        faults: Faults of the robot.
        side: 0 left, 1 right.
        motor: Index of the motor.
        speed: Index of its wheel's speed.
        constant: Torque per current [N m/A], or voltage per speed.
        voltage: Voltage without a fault [V].
    """
    strength = faults.strengths[side]
    if strength != 1:
        voltage = strength * voltage + (1 - strength) * (constant * joint_speed(scene, speed))
    set_motor(scene, motor, voltage)
