"""Conversion of an infrared sensor: from surfaces and lamps to counts, in plain numbers.

`sensors` and `reflection` describe the model of proximity, `ambient` that of light. The functions are
`compilable`: they index lists here, arrays there, and query the scene only by the functions of `scene`.
"""

from collections.abc import Sequence

from khep_twin.compilable import compilable
from khep_twin.sensing.light import Light, light_counts, wave
from khep_twin.sensing.noise import ambient_noise, idle_counts, proximity_noise
from khep_twin.sensing.reflection import reflected, sift
from khep_twin.sensing.robot_sensors import RobotSensors, lobe_of
from khep_twin.sensing.scene import Scene, chip, surfaces

SLIGHT = 4.0
"""Reflected light that does not matter [counts]: a fifth of the noise."""

EMITTER_NS = 1_250_000
"""Time from a sensor's conversion without its emitter to that with it [ns]: half its turn (assumed)."""


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
        draws: Random draws, as of `noise.draws`.
    """
    ambient, added = sensors.ambient, 0.0
    reach = ambient.dark - ambient.floor
    total, swing = light_counts(scene, sensors, light, powers, channel)
    bright = total + swing * wave(light.law, time_ns) if swing > 0 else total
    # The floor is the first argument, so that NaN counts as the floor until it is noticed.
    level = max(ambient.floor, ambient.dark - bright)
    if swing > 0:
        # The second conversion, with the emitter on, has other ambient light than the first.
        bright = total + swing * wave(light.law, time_ns + EMITTER_NS)
        change = level - max(ambient.floor, ambient.dark - bright)
        added = sensors.proximity.limit * change / reach
    counts = max(min(round(level + ambient_noise(ambient, draws)), ambient.ceiling), 0)
    range_left = (level - ambient.floor) / reach
    noise, idle = proximity_noise(sensors.proximity, channel, draws), idle_counts(sensors.proximity, draws)
    return proximity_counts(scene, sensors, channel, noise, idle, range_left, added), counts


@compilable
def proximity_counts(
    scene: Scene,
    sensors: RobotSensors,
    channel: int,
    noise: float,
    idle: int,
    range_left: float,
    added: float,
) -> int:
    """Return the counts of reflected light.

    Args:
        scene: Scene around the robot.
        sensors: Sensors of the robot.
        channel: Number of the sensor.
        noise: Noise of the reading [counts].
        idle: Reading with nothing in reach [counts].
        range_left: Part of the range that ambient light leaves, 0 to 1.
        added: Change of the ambient light between the sensor's two conversions [counts].
    """
    proximity = sensors.proximity
    level = noise + added - proximity.threshold[channel]
    # Less passes no threshold, or changes the reading by less than half a step.
    needed = max(-level, proximity.quantum / 2)
    mounted = chip(scene, sensors, channel)
    count = surfaces(scene, sensors, channel, mounted, needed)
    gain, found = proximity.gain[channel], proximity.found
    lobe = lobe_of(proximity, channel)
    count, most = sift(found, count, lobe, SLIGHT / gain)
    if count and gain * most > -level:
        level += gain * reflected(found, count, mounted, lobe)
    limit = int(proximity.limit * range_left)
    counts = min(round(min(level, float(limit)) / proximity.quantum) * proximity.quantum, limit)
    return max(counts, min(idle, limit), proximity.floor)
