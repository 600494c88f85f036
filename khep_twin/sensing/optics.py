"""Conversion of an infrared sensor: from surfaces and lamps to counts.

`sensors` and `reflection` describe the model of proximity, `ambient` that of ambient light. The functions are
`compilable`: they index lists in plain code, arrays in compiled code, and query the scene by `scene`.
"""

import math
from collections.abc import Sequence

from khep_twin.compilable import compilable
from khep_twin.sensing.light import Light, flicker_wave, light_counts
from khep_twin.sensing.noise import ambient_noise, idle_counts, proximity_noise
from khep_twin.sensing.reflection import reflected_light, remove_faint
from khep_twin.sensing.robot_sensors import RobotSensors, sensor_lobe
from khep_twin.sensing.scene import Scene, body_frame, chip, position, ray, surfaces
from khep_twin.sensing.seen_surfaces import N_COLUMNS, SQUARE

NEGLIGIBLE = 4.0
"""Negligible reflected light [counts]: a fifth of the noise."""

FLOOR_REACH = 0.03
"""Distance before a sensor at which it sees a free floor [m] (assumed)."""

EMITTER_DELAY_NS = 1_250_000
"""Time from a sensor's conversion with its emitter off to that with it on [ns]: half a step (assumed)."""


@compilable
def convert(
    scene: Scene,
    sensors: RobotSensors,
    light: Light,
    powers: Sequence[float],
    time_ns: int,
    channel: int,
    draws: tuple[float, float, float],
) -> tuple[int, int]:
    """Return proximity and ambient counts of one sensor, for the pose at the start of the last step.

    Args:
        scene: Scene around the robot.
        sensors: Sensors of the robot.
        light: Lamps of the world.
        powers: Mean powers of the lamps (n,) [W].
        time_ns: Time of the conversion [ns].
        channel: Number of the sensor.
        draws: Random draws, from `noise.draws`.
    """
    ambient, ambient_change = sensors.ambient, 0.0
    ambient_range = ambient.dark - ambient.floor
    mean_light, amplitude = light_counts(scene, sensors, light, powers, channel)
    light_level = mean_light + amplitude * flicker_wave(light.law, time_ns) if amplitude > 0 else mean_light
    # The floor is the first argument, so that NaN becomes the floor until it is detected.
    level = max(ambient.floor, ambient.dark - light_level)
    if amplitude > 0:
        # The ambient light of the second conversion, with the emitter on, differs from that of the first.
        light_level = mean_light + amplitude * flicker_wave(light.law, time_ns + EMITTER_DELAY_NS)
        change = level - max(ambient.floor, ambient.dark - light_level)
        ambient_change = sensors.proximity.limit * change / ambient_range
    counts = max(min(round(level + ambient_noise(ambient, draws)), ambient.ceiling), 0)
    range_left = (level - ambient.floor) / ambient_range
    noise, idle = proximity_noise(sensors.proximity, channel, draws), idle_counts(sensors.proximity, draws)
    return proximity_counts(scene, sensors, channel, noise, idle, range_left, ambient_change), counts


@compilable
def proximity_counts(
    scene: Scene,
    sensors: RobotSensors,
    channel: int,
    noise: float,
    idle: int,
    range_left: float,
    ambient_change: float,
) -> int:
    """Return the counts of reflected light.

    Args:
        scene: Scene around the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        noise: Noise of the reading [counts].
        idle: Reading with nothing in range [counts].
        range_left: Part of the range that ambient light does not use, 0 to 1.
        ambient_change: Change of the ambient light between the sensor's two conversions [counts].
    """
    proximity = sensors.proximity
    level = noise + ambient_change - proximity.threshold[channel]
    # Less light does not exceed the threshold, or changes the reading by less than half a quantum.
    min_light = max(-level, proximity.quantum / 2)
    sensor_chip = chip(scene, sensors, channel)
    count = surfaces(scene, sensors, channel, sensor_chip, min_light)
    gain, buffer, floor = proximity.gain[channel], proximity.surfaces, 1.0
    if proximity.floor_light[channel] > 0:
        floor = _floor_reflectance(scene, sensors, channel, count)
        level -= proximity.floor_light[channel] * (1 - floor)
    lobe = sensor_lobe(proximity, channel, floor)
    count, bound = remove_faint(buffer, count, lobe, NEGLIGIBLE / gain)
    if count and gain * bound > -level:
        growth = 1 + proximity.noise_growth * noise
        level += gain * reflected_light(buffer, count, sensor_chip, lobe) * growth
    limit = int(proximity.limit * range_left)
    if proximity.saturates and 0 < limit and 0 < level:
        level = saturated(level, limit)
    counts = min(round(min(level, float(limit)) / proximity.quantum) * proximity.quantum, limit)
    return max(counts, min(idle + min(proximity.floor, 0), limit), proximity.floor)


@compilable
def saturated(level: float, limit: float) -> float:
    """Return a level that approaches a limit gradually: level / (1 + (level / limit)^4)^(1/4)."""
    square = (level / limit) * (level / limit)
    return level / math.sqrt(math.sqrt(1 + square * square))


@compilable
def _floor_reflectance(scene: Scene, sensors: RobotSensors, channel: int, count: int) -> float:
    """Return the reflectance of the floor halfway to the nearest of `count` surfaces."""
    x, y, z = position(scene, sensors, channel)
    frame, reach = body_frame(scene, sensors), FLOOR_REACH
    c, s = sensors.ambient.cosine[channel], sensors.ambient.sine[channel]
    for row in range(0, count * N_COLUMNS, N_COLUMNS):
        reach = min(reach, math.sqrt(sensors.proximity.surfaces[row + SQUARE]) / 2)
    start = x + reach * (frame[0] * c + frame[1] * s), y + reach * (frame[3] * c + frame[4] * s), z
    return ray(scene, sensors, start, (0.0, 0.0, -1.0))[1]
