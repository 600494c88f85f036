"""Conversion of an infrared sensor: from surfaces and lamps to counts.

`sensors` and `reflection` describe the model of proximity, `ambient` that of ambient light. The functions are
`compilable`: they index lists in plain code, arrays in compiled code, and query the scene by `scene`.
"""

from collections.abc import Sequence

from khep_twin.compilable import compilable
from khep_twin.sensing.light import Light, flicker_wave, light_counts
from khep_twin.sensing.noise import ambient_noise, idle_counts, proximity_noise
from khep_twin.sensing.reflection import reflected_light, remove_faint
from khep_twin.sensing.robot_sensors import RobotSensors, sensor_lobe
from khep_twin.sensing.scene import Scene, chip, surfaces

NEGLIGIBLE = 4.0
"""Negligible reflected light [counts]: a fifth of the noise."""

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
    gain, buffer = proximity.gain[channel], proximity.surfaces
    lobe = sensor_lobe(proximity, channel)
    count, bound = remove_faint(buffer, count, lobe, NEGLIGIBLE / gain)
    if count and gain * bound > -level:
        level += gain * reflected_light(buffer, count, sensor_chip, lobe)
    limit = int(proximity.limit * range_left)
    counts = min(round(min(level, float(limit)) / proximity.quantum) * proximity.quantum, limit)
    return max(counts, min(idle + min(proximity.floor, 0), limit), proximity.floor)
