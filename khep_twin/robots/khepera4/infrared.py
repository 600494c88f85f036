"""Infrared sensors of the Khepera IV: eight around, by the law of `sensing.optics`, and four for the floor.

A ground sensor averages over a spot of the floor:

    counts = nothing + (white - nothing) mean(reflectance over the spot) min((h0 + l) / (h + l), 1)^2 + noise

with its height h above the surface, h0 = 4.7 mm on the floor, and l = 2 mm (assumed). The reflectance is that
of the floor, patch or object that a ray from the sensor meets; it is 0 beyond an edge.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.dspic import read_signed, write_number
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.device_faults import DeviceFaults, sensor_reading
from khep_twin.sensing.light import Light
from khep_twin.sensing.noise import Tables, draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import BeamScene, position, ray, sensor_frame
from khep_twin.units import COUNTS_LIMIT, N_SENSORS

N_RING = N_SENSORS
"""Number of sensors around the robot; the others look at the floor."""

PERIOD_NS = 5_000_000
"""Period of the measurements [ns] (manual)."""

_HEIGHT, _LENS = 0.0047, 0.002
"""Height of the sensors above the floor (manual), and length in the law of their distance (assumed) [m]."""

_ANGLES = [octant * (math.pi / 4) for octant in range(8)]
_SPOT_POINTS = ((0.0, 0.0), *((0.7 * math.cos(angle), 0.7 * math.sin(angle)) for angle in _ANGLES))
"""Sample points of a spot of radius 1."""

_PROXIMITY, _AMBIENT = int(DspicRegister.PROXIMITY), int(DspicRegister.AMBIENT)


class Ground(NamedTuple):
    """Sensors that look at the floor.

    Attributes:
        white_counts: Counts above white (n,).
        nothing_counts: Counts above nothing.
        noise_counts: Standard deviation [counts].
        spot: Radius of a spot [m].
        rises_with_light: 1 if ambient counts rise with light.
    """

    white_counts: Sequence[float]
    nothing_counts: float
    noise_counts: float
    spot: float
    rises_with_light: int


@compilable
def measure(
    scene: BeamScene,
    sensors: RobotSensors,
    faults: DeviceFaults,
    ground: Ground,
    light: Light,
    powers: Sequence[float],
    tables: Tables,
    key: Vector[int],
    time_ns: int,
    memory: Vector[int],
) -> None:
    """Set the registers of all sensors.

    Args:
        scene: BeamScene at the time of the measurement.
        sensors: Sensors of the robot.
        faults: Their faults.
        ground: Those that look at the floor.
        light: Lamps of the world.
        powers: Powers of the lamps (n,) [W].
        tables: Quantiles of random draws.
        key: Words of the key of the robot's random draws (2,).
        time_ns: Time of the measurement [ns].
        memory: Memory of the dsPIC.
    """
    n_sensors = len(sensors.cameras)
    first_draw, ambient_optics = time_ns // PERIOD_NS * n_sensors, sensors.ambient
    for channel in range(n_sensors):
        noise = draws(tables, key, first_draw + channel)
        if channel < N_RING:
            reflected, ambient = convert(scene, sensors, light, powers, time_ns, channel, noise)
        else:
            reflected = _floor_counts(scene, sensors, ground, channel, noise[0])
            # In the shadow of the robot (assumed).
            dark_reading = ambient_optics.dark + ambient_optics.noise * noise[1]
            ambient = min(max(round(dark_reading), 0), COUNTS_LIMIT)
        darkest = ambient_optics.ceiling
        if ground.rises_with_light:
            ambient, darkest = COUNTS_LIMIT - ambient, COUNTS_LIMIT - darkest
        for word, reading, dead in ((_PROXIMITY, reflected, 0), (_AMBIENT, ambient, darkest)):
            start = word + 2 * channel
            last = read_signed(memory, start, 2)
            write_number(memory, start, 2, sensor_reading(faults, channel, reading, last, dead))


@compilable
def _floor_counts(scene: BeamScene, sensors: RobotSensors, ground: Ground, channel: int, noise: float) -> int:
    """Return the counts of a sensor that looks at the floor, with a standard normal draw."""
    origin, frame = position(scene, sensors, channel), sensor_frame(scene, sensors, channel)
    down, total = (-frame[2], -frame[5], -frame[8]), 0.0
    for point_x, point_y in _SPOT_POINTS:
        x, y = ground.spot * point_x, ground.spot * point_y
        start = (
            origin[0] + x * frame[0] + y * frame[1],
            origin[1] + x * frame[3] + y * frame[4],
            origin[2] + x * frame[6] + y * frame[7],
        )
        distance, reflectance = ray(scene, sensors, start, down)
        if distance >= 0:
            nearness = min((_HEIGHT + _LENS) / (distance + _LENS), 1.0)
            total += reflectance * (nearness * nearness)
    white, dark = ground.white_counts[channel - N_RING], ground.nothing_counts
    counts = dark + (white - dark) * total / len(_SPOT_POINTS) + ground.noise_counts * noise
    return min(max(round(counts), 0), COUNTS_LIMIT)
