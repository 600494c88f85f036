"""Footprints: areas of the floor that parts cover, and a test for their overlap. Lengths in mm."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

_TOUCHING_MM = 1e-6
"""Tolerance for rounding: footprints that merely touch do not overlap."""


@dataclass(frozen=True, slots=True)
class Circle:
    """A disc."""

    x_mm: float
    y_mm: float
    radius_mm: float

    def reach(self, direction: tuple[float, float]) -> float:
        """Return its extent from the centre along a unit vector [mm]."""
        return self.radius_mm


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle, with its length along x at angle 0."""

    x_mm: float
    y_mm: float
    length_mm: float
    width_mm: float
    angle_deg: float

    def axes(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the unit vectors along its length and its width."""
        angle = math.radians(self.angle_deg)
        return (math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))

    def reach(self, direction: tuple[float, float]) -> float:
        """Return its extent from the centre along a unit vector [mm]."""
        along, across = (abs(axis[0] * direction[0] + axis[1] * direction[1]) for axis in self.axes())
        return along * self.length_mm / 2 + across * self.width_mm / 2


Footprint = Circle | Rectangle


def overlap(one: Footprint, other: Footprint) -> bool:
    """Return whether two footprints share more than an edge.

    Two convex shapes are disjoint if and only if some axis separates them. For discs and rectangles the
    candidates are the rectangles' axes and, for a disc, the direction to the other's nearest point.
    """
    directions: list[tuple[float, float]] = []
    for shape, partner in ((one, other), (other, one)):
        if isinstance(shape, Rectangle):
            directions += shape.axes()
        else:
            directions.append(_direction_to(shape, partner))
    offset = (other.x_mm - one.x_mm, other.y_mm - one.y_mm)
    return all(
        abs(offset[0] * direction[0] + offset[1] * direction[1])
        < one.reach(direction) + other.reach(direction) - _TOUCHING_MM
        for direction in directions
    )


def find_overhangs(shape: Footprint, width_mm: float, height_mm: float) -> Iterator[tuple[str, float]]:
    """Yield the arena's walls that a footprint overlaps, and the depth [mm]."""
    right, top = shape.reach((1.0, 0.0)), shape.reach((0.0, 1.0))
    depths = {
        "left": right - shape.x_mm,
        "right": shape.x_mm + right - width_mm,
        "bottom": top - shape.y_mm,
        "top": shape.y_mm + top - height_mm,
    }
    yield from ((wall, depth) for wall, depth in depths.items() if depth > _TOUCHING_MM)


def _direction_to(disc: Circle, other: Footprint) -> tuple[float, float]:
    """Return the unit vector from a disc's centre to the nearest point of another shape."""
    dx, dy = other.x_mm - disc.x_mm, other.y_mm - disc.y_mm
    if isinstance(other, Rectangle):
        # The nearest point is the disc's centre clamped to the sides, in the rectangle's frame.
        for axis, half_mm in zip(other.axes(), (other.length_mm / 2, other.width_mm / 2), strict=True):
            along = -(other.x_mm - disc.x_mm) * axis[0] - (other.y_mm - disc.y_mm) * axis[1]
            clamped = max(-half_mm, min(half_mm, along))
            dx, dy = dx + clamped * axis[0], dy + clamped * axis[1]
    distance = math.hypot(dx, dy)
    return (dx / distance, dy / distance) if distance else (1.0, 0.0)
