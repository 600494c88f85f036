"""Additions to the views of a Khepera IV: ultrasonic beams and LEDs in the arena, curves of its sensors."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.khepera4.channels import CODES, LEDS, ULTRASONIC
from khep_twin.khepera4.ultrasonic import HEADINGS_DEG, HEIGHT, RADIUS
from khep_twin.log.viewer.arena import in_frame, line_chunks
from khep_twin.log.viewer.collected import Floats, Samples, time_column
from khep_twin.sensing.colours import AXES, OF_SENSORS, Colour

CURVES: Mapping[str, tuple[str, Mapping[str, Colour]]] = {
    "ultrasonic": ("ultrasonic [cm]", {name: OF_SENSORS[name] for name in ULTRASONIC}),
    "accelerometer": ("accelerometer [1/16384 g]", AXES),
    "gyroscope": ("gyroscope [0.066 deg/s]", AXES),
}
"""Title and curves of its further plots, by channel."""

_HALF_BEAM = math.radians(15)
"""Half the width of a drawn beam; the real one has no edge [rad]."""

_ARC = 9
_LED_RADIUS = 0.0055
_FULL = 63
"""Brightest value of an LED."""


def arena_chunks(robot: str, track: Samples, leds: Floats) -> list[Chunk]:
    """Return beams and LEDs at the times of samples; LEDs lie at places in the robot's frame (3, 3) [m]."""
    chunks: list[Chunk] = []
    if (seen := track.more.get("ultrasonic")) is not None:
        chunks += _beams(robot, track.times_ns, seen)
    if (lit := track.more.get("leds")) is not None:
        chunks += _lights(robot, track.times_ns, lit, leds)
    return chunks


def _beams(robot: str, times_ns: NDArray[np.int64], seen: Floats) -> list[Chunk]:
    """Return a sector for each sensor, as long as it reads [cm] (n, 5); none where it reads no distance."""
    n, count = seen.shape
    headings = np.radians(HEADINGS_DEG)
    ways = headings[:, None] + np.linspace(-_HALF_BEAM, _HALF_BEAM, _ARC)
    fans = np.stack([np.cos(ways), np.sin(ways), np.zeros_like(ways)], axis=-1)
    feet = np.stack([RADIUS * np.cos(headings), RADIUS * np.sin(headings), np.full(count, HEIGHT)], axis=-1)
    known = ~np.isin(seen, CODES)
    strips = np.repeat(feet[None, :, None], n, axis=0).repeat(_ARC + 2, axis=2)
    strips[:, :, 1:-1] += np.where(known, seen / 100, 0)[..., None, None] * fans
    colours = np.zeros((n, count, 4), np.uint8)
    colours[known] = (64, 150, 208, 255)
    lines = strips.reshape(n * count, -1, 3).astype(np.float32), colours.reshape(-1, 4)
    return line_chunks(f"/obstacles/{robot}_ultrasonic", f"{robot}/base", times_ns, *lines, 0.0015, count)


def _lights(robot: str, times_ns: NDArray[np.int64], lit: Floats, places: Floats) -> list[Chunk]:
    """Return the LEDs in their colours, red, green and blue of each, 0 to 63 (n, 9); none where it is off."""
    n, count = len(times_ns), len(LEDS)
    parts = lit.reshape(n * count, 3) / _FULL
    strongest = parts.max(axis=1, keepdims=True)
    colours = np.round(255 * np.divide(parts, strongest, out=np.zeros_like(parts), where=strongest > 0))
    balls = rr.Ellipsoids3D.columns(
        centers=np.tile(places, (n, 1)).astype(np.float32),
        half_sizes=np.where(strongest > 0, _LED_RADIUS, 0).repeat(3, axis=1).astype(np.float32),
        colors=colours.astype(np.uint8),
    )
    place = f"/obstacles/{robot}_leds"
    columns = balls.partition([count] * n)
    return [in_frame(place, f"{robot}/base"), Chunk.from_columns(place, [time_column(times_ns)], columns)]
