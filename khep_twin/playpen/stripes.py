"""Stripes: upright panels of other surfaces on the sides of walls and objects. Lengths in mm.

A pattern is a list of widths and surfaces, e.g. [[20, "black"], [20, "white"]]. It starts at the left end of
each side, seen from the front, and repeats up to its right end. A cylinder has one side, which starts in the
direction of x and runs counter-clockwise. Stripes are as high as their wall or object.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from khep_twin.files.toml_files import Name
from khep_twin.playpen.footprint import Circle, Footprint
from khep_twin.playpen.polygon import Point, area, edges, rectangle_corners

PANEL_LIMIT = 5000
"""Most panels of a playpen's stripes."""

FACET_DEG = 6.0
"""Largest arc of a cylinder that one flat panel covers [deg]; its edges deviate by 0.14 % of the radius."""

_ROUNDING_MM = 1e-6

Stripe = tuple[Annotated[float, Field(ge=1, le=10_000)], Name]
Stripes = Annotated[
    tuple[Stripe, ...],
    Field(
        max_length=100,
        description='widths from 1 to 10000 and surfaces, such as [[20, "black"], [20, "white"]]',
    ),
]


@dataclass(frozen=True, slots=True)
class Panel:
    """A stripe, or a flat part of one, seen from above.

    Attributes:
        x_mm: Middle.
        y_mm: Middle.
        angle_deg: Direction from its left to its right end, seen from the front.
        width_mm: Width.
        surface: Name of its surface.
    """

    x_mm: float
    y_mm: float
    angle_deg: float
    width_mm: float
    surface: str

    @property
    def ends(self) -> tuple[Point, Point]:
        """Left and right end."""
        angle, half = math.radians(self.angle_deg), self.width_mm / 2
        dx, dy = half * math.cos(angle), half * math.sin(angle)
        return (self.x_mm - dx, self.y_mm - dy), (self.x_mm + dx, self.y_mm + dy)


def panels(shape: Footprint, stripes: Sequence[Stripe]) -> Iterator[Panel]:
    """Yield the panels on the sides of an object."""
    if not stripes:
        return
    if isinstance(shape, Circle):
        yield from _cylinder_panels(shape, stripes)
        return
    for side in edges(rectangle_corners(shape), closed=True):
        yield from _side_panels(*side, stripes)


def panels_within(corners: Sequence[Point], stripes: Sequence[Stripe]) -> Iterator[Panel]:
    """Yield the panels on the inner sides of the walls around a floor with these corners."""
    clockwise = list(corners) if area(corners) < 0 else list(reversed(corners))
    for start, end in edges(clockwise, closed=True) if stripes else ():
        yield from _side_panels(start, end, stripes)


def stripe_intervals(length_mm: float, stripes: Sequence[Stripe]) -> Iterator[tuple[float, float, str]]:
    """Yield start, end and surface of each stripe along a side."""
    start_mm = 0.0
    while start_mm < length_mm - _ROUNDING_MM:
        for width_mm, surface in stripes:
            end_mm = min(start_mm + width_mm, length_mm)
            if end_mm > start_mm + _ROUNDING_MM:
                yield start_mm, end_mm, surface
            start_mm = end_mm


def _side_panels(start: Point, end: Point, stripes: Sequence[Stripe]) -> Iterator[Panel]:
    (x0, y0), (x1, y1) = start, end
    length_mm, angle_deg = math.hypot(x1 - x0, y1 - y0), math.degrees(math.atan2(y1 - y0, x1 - x0))
    for start_mm, end_mm, surface in stripe_intervals(length_mm, stripes):
        fraction = (start_mm + end_mm) / 2 / length_mm
        x_mm, y_mm = x0 + fraction * (x1 - x0), y0 + fraction * (y1 - y0)
        yield Panel(x_mm, y_mm, angle_deg, end_mm - start_mm, surface)


def _cylinder_panels(shape: Circle, stripes: Sequence[Stripe]) -> Iterator[Panel]:
    for start_mm, end_mm, surface in stripe_intervals(math.tau * shape.radius_mm, stripes):
        start_angle, arc = start_mm / shape.radius_mm, (end_mm - start_mm) / shape.radius_mm
        facets = math.ceil(math.degrees(arc) / FACET_DEG)
        width_mm = 2 * shape.radius_mm * math.tan(arc / facets / 2)
        for facet in range(facets):
            angle = start_angle + (facet + 0.5) * arc / facets
            x_mm = shape.x_mm + shape.radius_mm * math.cos(angle)
            y_mm = shape.y_mm + shape.radius_mm * math.sin(angle)
            yield Panel(x_mm, y_mm, math.degrees(angle) + 90, width_mm, surface)
