"""Infrared sensors of the ground, beside those around a robot.

A ground sensor averages over a spot of the floor:

    counts = nothing + (white - nothing) mean(reflectance over the spot) min((h0 + l) / (h + l), 1)^2 + noise

with its height h above the surface, h0 on the floor, and a length l of its lens. The reflectance is that of
the floor, patch or object that a ray from the sensor meets; it is 0 beyond an edge. Light of lamps does not
reach the sensor in the shadow of the robot (assumed).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

from khep_twin.compilable import compilable
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.light import Light
from khep_twin.sensing.noise import Draws, ambient_noise
from khep_twin.sensing.optics import convert, saturated
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import BeamScene, position, ray, sensor_frame

_ANGLES = [octant * (math.pi / 4) for octant in range(8)]
_SPOT_POINTS = ((0.0, 0.0), *((0.7 * math.cos(angle), 0.7 * math.sin(angle)) for angle in _ANGLES))
"""Sample points of a spot of radius 1."""


class Ground(NamedTuple):
    """Sensors of the ground, and readings of all infrared sensors.

    Attributes:
        white_counts: Counts above white (n,).
        nothing_counts: Counts above nothing.
        noise_counts: Standard deviation [counts].
        spot: Radius of a spot [m].
        excess: Light from a white floor over that which saturates; 1 without saturation.
        height: Height above the floor [m].
        lens: Length in the law of the distance [m].
        largest: Largest count of the converter.
        rises_with_light: 1 if ambient counts rise with light.
        darkest: Ambient counts of a dead sensor.
    """

    white_counts: Sequence[float]
    nothing_counts: float
    noise_counts: float
    spot: float
    excess: float
    height: float
    lens: float
    largest: int
    rises_with_light: int
    darkest: int

    @classmethod
    def of(cls, measured: Calibration, height: float, lens: float) -> Self:
        """Return the sensors of a robot with a calibration, at a height above the floor [m]."""
        ground, ambient, largest = measured.ground, measured.ambient, measured.largest_count
        assert ground is not None  # checked with the playpen
        return cls(
            list(map(float, ground.white_counts)),
            float(ground.nothing_counts),
            float(ground.noise_counts),
            ground.spot_mm * 1e-3,
            ground.excess,
            height,
            lens,
            largest,
            int(ambient.rises_with_light),
            largest - ambient.ceiling_counts if ambient.rises_with_light else ambient.ceiling_counts,
        )


@compilable
def convert_any(
    scene: BeamScene,
    sensors: RobotSensors,
    ground: Ground,
    light: Light,
    powers: Sequence[float],
    time_ns: int,
    channel: int,
    draws: Draws,
) -> tuple[int, int]:
    """Return proximity and ambient counts of a sensor, as `optics.convert`; those of the ground are last."""
    number = channel - (len(sensors.cameras) - len(ground.white_counts))
    if number < 0:
        reflected, ambient = convert(scene, sensors, light, powers, time_ns, channel, draws)
    else:
        reflected = _floor_counts(scene, sensors, ground, channel, number, draws[0])
        dark_reading = sensors.ambient.dark + ambient_noise(sensors.ambient, draws)
        ambient = min(max(round(dark_reading), 0), ground.largest)
    return reflected, ground.largest - ambient if ground.rises_with_light else ambient


@compilable
def _floor_counts(
    scene: BeamScene, sensors: RobotSensors, ground: Ground, channel: int, number: int, noise: float
) -> int:
    """Return the counts of a ground sensor, by its number among these, with a standard normal draw."""
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
            nearness = min((ground.height + ground.lens) / (distance + ground.lens), 1.0)
            total += reflectance * (nearness * nearness)
    white, dark = ground.white_counts[number], ground.nothing_counts
    level = (white - dark) * total / len(_SPOT_POINTS)
    if ground.excess > 1:
        level = saturated(level * ground.excess, white - dark)
    counts = dark + level + ground.noise_counts * noise
    return min(max(round(counts), 0), ground.largest)
