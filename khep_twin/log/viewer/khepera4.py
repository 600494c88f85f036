"""Additions to the views of a Khepera IV: ultrasonic beams and LEDs in the arena, curves of its sensors."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.khepera4.channels import LEDS, ULTRASONIC, ULTRASONIC_CODES
from khep_twin.khepera4.ultrasonic import HEADINGS_DEG, HEIGHT, RADIUS
from khep_twin.log.viewer.arena import frame_chunk, line_chunks
from khep_twin.log.viewer.collected import Floats, Samples, time_column
from khep_twin.sensing.colours import ALL_SENSORS, AXES, Colour

CURVES: Mapping[str, tuple[str, Mapping[str, Colour]]] = {
    "ultrasonic": ("ultrasonic [cm]", {name: ALL_SENSORS[name] for name in ULTRASONIC}),
    "accelerometer": ("accelerometer [1/16384 g]", AXES),
    "gyroscope": ("gyroscope [0.066 deg/s]", AXES),
}
"""Title and curves of the additional plots, by channel."""

_HALF_BEAM = math.radians(15)
"""Half-angle of a drawn beam; the real beam has no sharp edge [rad]."""

_ARC_POINTS = 9  # of a beam
_LED_RADIUS = 0.0055  # [m]
_MAX_BRIGHTNESS = 63  # of an LED


def arena_chunks(robot: str, samples: Samples, led_positions: Floats) -> list[Chunk]:
    """Return beams and LEDs at the times of samples; `led_positions` are in the robot's frame (3, 3) [m]."""
    chunks: list[Chunk] = []
    if (distances := samples.extra_channels.get("ultrasonic")) is not None:
        chunks += _beams(robot, samples.times_ns, distances)
    if (brightness := samples.extra_channels.get("leds")) is not None:
        chunks += _lights(robot, samples.times_ns, brightness, led_positions)
    return chunks


def _beams(robot: str, times_ns: NDArray[np.int64], distances: Floats) -> list[Chunk]:
    """Return a sector per sensor, as long as its distance [cm] (n, 5); none without a distance."""
    n, count = distances.shape
    headings = np.radians(HEADINGS_DEG)
    angles = headings[:, None] + np.linspace(-_HALF_BEAM, _HALF_BEAM, _ARC_POINTS)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    x, y = RADIUS * np.cos(headings), RADIUS * np.sin(headings)
    origins = np.stack([x, y, np.full(count, HEIGHT)], axis=-1)
    is_valid = ~np.isin(distances, ULTRASONIC_CODES)
    strips = np.repeat(origins[None, :, None], n, axis=0).repeat(_ARC_POINTS + 2, axis=2)
    strips[:, :, 1:-1] += np.where(is_valid, distances / 100, 0)[..., None, None] * directions
    colours = np.zeros((n, count, 4), np.uint8)
    colours[is_valid] = (64, 150, 208, 255)
    lines = strips.reshape(n * count, -1, 3).astype(np.float32), colours.reshape(-1, 4)
    path, frame = f"/obstacles/{robot}_ultrasonic", f"{robot}/base"
    return line_chunks(path, frame, times_ns, *lines, radius=0.0015, n_lines=count)


def _lights(robot: str, times_ns: NDArray[np.int64], brightness: Floats, positions: Floats) -> list[Chunk]:
    """Return the LEDs in their colours: red, green and blue of each, 0 to 63 (n, 9); none if it is off."""
    n, count = len(times_ns), len(LEDS)
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
    return [frame_chunk(path, f"{robot}/base"), Chunk.from_columns(path, [time_column(times_ns)], columns)]
