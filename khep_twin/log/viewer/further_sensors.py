"""Views of further sensors: ultrasonic beams and LEDs of three colours in the arena, curves by name."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.log.channels import BASE_FRAME
from khep_twin.log.viewer.arena import frame_chunk, line_chunks
from khep_twin.log.viewer.collected import Floats, Samples, time_column
from khep_twin.robots.body import SonarRing
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.colours import AXES, Colour, sensor_colour

_HALF_BEAM = math.radians(15)
"""Half-angle of a drawn beam; the real beam has no sharp edge [rad]."""

_ARC_POINTS = 9  # of a beam
_LED_RADIUS = 0.0055  # [m]
_MAX_BRIGHTNESS = 63  # of an LED


def curves_of(model: RobotModel, channel: str) -> Mapping[str, Colour]:
    """Return the curves of a channel: name and colour of each of its numbers."""
    names = [column.removeprefix(f"{channel}_").replace("_", " ") for column, _ in model.channels[channel]]
    return {name: AXES.get(name) or sensor_colour(name) for name in names}


def arena_chunks(robot: str, model: RobotModel, samples: Samples, led_positions: Floats) -> list[Chunk]:
    """Return beams and LEDs at the times of samples; `led_positions` are in the robot's frame (n, 3) [m]."""
    chunks: list[Chunk] = []
    distances, sonar = samples.extra_channels.get("ultrasonic"), model.body.sonar
    if distances is not None and sonar is not None:
        chunks += _beams(robot, sonar, samples.times_ns, distances, model.sonar_unit)
    brightness = samples.extra_channels.get("leds")
    if brightness is not None and model.rgb_leds:
        chunks += _lights(robot, samples.times_ns, brightness, led_positions)
    return chunks


def _beams(
    robot: str, sonar: SonarRing, times_ns: NDArray[np.int64], readings: Floats, unit: float
) -> list[Chunk]:
    """Return a sector per sensor, as long as its reading (n, n_sensors) in a unit [m]; none for a code."""
    n, count = readings.shape
    headings = np.radians(sonar.headings_deg)
    angles = headings[:, None] + np.linspace(-_HALF_BEAM, _HALF_BEAM, _ARC_POINTS)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    origins = np.array(sonar.places)[:, :3]
    is_valid = ~np.isin(readings, sonar.codes)
    strips = np.repeat(origins[None, :, None], n, axis=0).repeat(_ARC_POINTS + 2, axis=2)
    strips[:, :, 1:-1] += np.where(is_valid, readings * unit, 0)[..., None, None] * directions
    colours = np.zeros((n, count, 4), np.uint8)
    colours[is_valid] = (64, 150, 208, 255)
    lines = strips.reshape(n * count, -1, 3).astype(np.float32), colours.reshape(-1, 4)
    path, frame = f"/obstacles/{robot}_ultrasonic", BASE_FRAME.format(robot)
    return line_chunks(path, frame, times_ns, *lines, radius=0.0015, n_lines=count)


def _lights(robot: str, times_ns: NDArray[np.int64], brightness: Floats, positions: Floats) -> list[Chunk]:
    """Return the LEDs in their colours: red, green and blue of each, 0 to 63 (n, 9); none if it is off."""
    n, count = len(times_ns), len(positions)
    levels = brightness.reshape(n * count, 3) / _MAX_BRIGHTNESS
    strongest = levels.max(axis=1, keepdims=True)
    colours = np.round(255 * np.divide(levels, strongest, out=np.zeros_like(levels), where=strongest > 0))
    balls = rr.Ellipsoids3D.columns(
        centers=np.tile(positions, (n, 1)).astype(np.float32),
        half_sizes=np.where(strongest > 0, _LED_RADIUS, 0).repeat(3, axis=1).astype(np.float32),
        colors=colours.astype(np.uint8),
    )
    path = f"/obstacles/{robot}_leds"
    columns = balls.partition([count] * n)
    return [
        frame_chunk(path, BASE_FRAME.format(robot)),
        Chunk.from_columns(path, [time_column(times_ns)], columns),
    ]
