"""Placement: checks that the parts of a playpen do not collide.

Fixed parts may touch and cross each other, as the walls of a maze do. Free parts (robots, movable objects)
must not overlap any other part, as contact forces would push them apart in the first steps. Parts whose
height ranges are disjoint, e.g. a robot and a lamp above it, do not overlap.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khep_twin.errors import Location, Problem
from khep_twin.playpen.footprint import Footprint, find_overhangs, overlap
from khep_twin.playpen.polygon import Point, contains, corner_before, walls_around

PART_LIMIT = 5000
"""Most parts of one playpen, which MuJoCo takes seconds to compile."""


@dataclass(frozen=True, slots=True)
class PlacedPart:
    """A part of a playpen.

    Attributes:
        kind: Its table in the playpen file.
        number: Its number within its kind, from 1.
        name: Its name, or None.
        footprint: Area of the floor that it covers.
        bottom_mm: Height of its lower end above the floor [mm].
        top_mm: Height of its upper end [mm].
        is_free: True if it can be pushed.
    """

    kind: str
    number: int
    name: str | None
    footprint: Footprint
    bottom_mm: float
    top_mm: float
    is_free: bool

    @property
    def location(self) -> Location:
        """Location of its table in the file."""
        return self.kind, self.number - 1

    @property
    def label(self) -> str:
        """Its name in messages."""
        return part_label(self.kind, self.number, self.name)

    def __str__(self) -> str:
        """Return label and position [mm]."""
        return f"{self.label} at ({self.footprint.x_mm:g}, {self.footprint.y_mm:g})"


def part_label(kind: str, number: int, name: str | None) -> str:
    """Return the name of a part for messages: kind, number from 1, and its name, if any."""
    return f"{kind} {number}" + (f" ({name})" if name else "")


class Floor(Protocol):
    """The floor of an arena."""

    width_mm: float
    height_mm: float
    wall_thickness_mm: float
    outline_mm: tuple[Point, ...]


def placement_problems(parts: Sequence[PlacedPart], floor: Floor) -> Iterator[Problem]:
    """Yield the placement problems of parts on a floor, one line each."""
    if len(parts) > PART_LIMIT:
        text = f"{len(parts)} blocks, cylinders, lamps and robots"
        yield Problem.of((), text, f"up to {PART_LIMIT} together")
        return
    inside: list[PlacedPart] = []
    for part in parts:
        outside = list(_outside_problems(part, floor))
        yield from outside
        if not outside:
            inside.append(part)
    yield from _overlap_problems(inside, floor)


def centre_problems(label: str, location: Location, shape: Footprint, floor: Floor) -> Iterator[Problem]:
    """Yield the coordinates of a part's centre that lie outside the arena."""
    for key, value, limit in (("x_mm", shape.x_mm, floor.width_mm), ("y_mm", shape.y_mm, floor.height_mm)):
        if value > limit:
            yield Problem.of(
                (*location, key), f"{label}: {key} = {value:g}: outside the arena", f"0 to {limit:g}"
            )


def _outside_problems(part: PlacedPart, floor: Floor) -> Iterator[Problem]:
    footprint = part.footprint
    problems = list(centre_problems(part.label, part.location, footprint, floor))
    yield from problems
    if not problems and floor.outline_mm and not contains(floor.outline_mm, footprint.x_mm, footprint.y_mm):
        yield Problem.of(part.location, f"{part} is outside the arena's outline", "a place within it")


def _overlap_problems(parts: Sequence[PlacedPart], floor: Floor) -> Iterator[Problem]:
    width_mm, height_mm = floor.width_mm, floor.height_mm
    walls = {"left": "x = 0", "right": f"x = {width_mm:g}", "bottom": "y = 0", "top": f"y = {height_mm:g}"}
    outline_walls = walls_around(floor.outline_mm, floor.wall_thickness_mm) if floor.outline_mm else []
    for part in parts:
        if not part.is_free:
            continue
        for index, wall in enumerate(outline_walls):
            if overlap(part.footprint, wall):
                number = corner_before(floor.outline_mm, index)
                text = f"{part} overlaps the wall after corner {number}"
                yield Problem.of(part.location, text, "a place further in")
        for wall, depth_mm in () if outline_walls else find_overhangs(part.footprint, width_mm, height_mm):
            inward_mm = math.ceil(depth_mm * 10) / 10
            text = f"{part} overlaps the {wall} wall at {walls[wall]}"
            yield Problem.of(part.location, text, f"{inward_mm:g} mm further in")
    for part, other in _overlapping_pairs(parts):
        # Spots may coincide, and robots may stand on them: a robot is placed only on a free spot.
        kinds = {part.kind, other.kind}
        if "spot" not in kinds or not kinds <= {"spot", "robot"}:
            yield Problem.of(part.location, f"{part} overlaps {other}", "a place clear of it")


def _overlapping_pairs(parts: Sequence[PlacedPart]) -> Iterator[tuple[PlacedPart, PlacedPart]]:
    """Yield pairs of overlapping parts, of which the first is free."""
    if not parts:
        return
    shapes = [part.footprint for part in parts]
    centres = np.array([(shape.x_mm, shape.y_mm) for shape in shapes])
    extents = np.array([(shape.reach((1.0, 0.0)), shape.reach((0.0, 1.0))) for shape in shapes])
    low, high = centres - extents, centres + extents
    for index, part in enumerate(parts):
        if part.is_free:
            # Test bounding rectangles first: only a few of thousands need the exact test.
            is_near = ((low < high[index]) & (high > low[index])).all(axis=1)
            neighbours: list[int] = is_near.nonzero()[0].tolist()
            for neighbour in neighbours:
                other = parts[neighbour]
                # A pair of free parts is reported once, by the part of the higher index.
                if (neighbour < index or not other.is_free) and _collide(part, other):
                    yield part, other


def _collide(one: PlacedPart, other: PlacedPart) -> bool:
    """Return whether two parts overlap in height and on the floor."""
    same_height = one.bottom_mm < other.top_mm and other.bottom_mm < one.top_mm
    return same_height and overlap(one.footprint, other.footprint)
