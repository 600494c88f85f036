"""Illumination: light of a playpen's lamps at points of the floor, for drawings.

    light = sum over visible lamps of P / r^2

with power P and distance r from the point, at the height of the robot's sensors, to the bulb's centre. The
robot's ambient light sensors (`sensors`) use the same light, with their directional sensitivity.
Ignored are light reflected from walls and objects, and the shadows of robots.
"""

from itertools import chain

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import BULB_RADIUS_MM, Lamp, Playpen
from khep_twin.playpen.footprint import Circle, Footprint
from khep_twin.units import SENSOR_HEIGHT

SHADOW_LIMIT = 200
"""Largest number of pairs of lamp and object with shadows; with more, lamps shine through objects."""

_HEIGHT_MM = SENSOR_HEIGHT * 1000

Floats = NDArray[np.float64]


def illumination(playpen: Playpen, x_mm: Floats, y_mm: Floats) -> Floats:
    """Return the light at points x, y of a playpen, in the shape of these arrays [W/mm^2]."""
    obstacles = chain(*playpen.obstacles.values())
    objects = [(shape, item.height_mm) for item in obstacles for shape in item.footprints]
    if len(playpen.lamps) * len(objects) > SHADOW_LIMIT:
        objects = []
    light = np.zeros(x_mm.shape)
    for lamp in playpen.lamps:
        square = (lamp.x_mm - x_mm) ** 2 + (lamp.y_mm - y_mm) ** 2 + (lamp.z_mm - _HEIGHT_MM) ** 2
        is_visible = np.ones(x_mm.shape, dtype=bool)
        for shape, height_mm in objects:
            is_visible &= ~_shadow(lamp, shape, height_mm, x_mm, y_mm)
        # Distances are at least the radius of the bulb.
        light += is_visible * lamp.power_w * lamp.dim / np.maximum(square, BULB_RADIUS_MM**2)
    return light


def _shadow(lamp: Lamp, shape: Footprint, height_mm: float, x_mm: Floats, y_mm: Floats) -> NDArray[np.bool_]:
    """Return which points are in the shadow of an object with this footprint and height."""
    to_x, to_y = lamp.x_mm - x_mm, lamp.y_mm - y_mm
    # The segment from the point (0) to the bulb's centre (1) crosses the object's footprint from `entry` to
    # `leave`; it ends at the bulb's glass.
    entry, leave = _crossing_fractions(shape, x_mm, y_mm, to_x, to_y)
    glass = 1 - BULB_RADIUS_MM / np.maximum(np.hypot(to_x, to_y), BULB_RADIUS_MM)
    entry, leave = np.maximum(entry, 0), np.minimum(leave, glass)
    rise_mm = lamp.z_mm - _HEIGHT_MM
    lowest_mm = _HEIGHT_MM + rise_mm * (entry if rise_mm > 0 else leave)
    return (entry < leave) & (lowest_mm < height_mm)


def _crossing_fractions(
    footprint: Footprint, x_mm: Floats, y_mm: Floats, to_x: Floats, to_y: Floats
) -> tuple[Floats, Floats]:
    """Return where rays from points along vectors enter and leave a footprint, in lengths of the vector."""
    x, y = x_mm - footprint.x_mm, y_mm - footprint.y_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(footprint, Circle):
            square = to_x**2 + to_y**2
            middle = -(x * to_x + y * to_y) / square
            half = np.sqrt((footprint.radius_mm**2 - x**2 - y**2) / square + middle**2)
            return middle - half, middle + half
        entries: list[Floats] = []
        leaves: list[Floats] = []
        for (axis_x, axis_y), size_mm in zip(
            footprint.axes(), (footprint.length_mm, footprint.width_mm), strict=True
        ):
            distance, rate = x * axis_x + y * axis_y, to_x * axis_x + to_y * axis_y
            sides = (-size_mm / 2 - distance) / rate, (size_mm / 2 - distance) / rate
            entries.append(np.minimum(*sides))
            leaves.append(np.maximum(*sides))
    return np.maximum(*entries), np.minimum(*leaves)
