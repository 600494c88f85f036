"""Placement: checks that the parts of a playpen can stand at their positions.

Fixed parts may touch and cross anything, as the walls of a maze do. Free ones (robots, movable objects)
must start clear of all else, or the physics would begin by throwing them out. Heights count: two things whose
heights do not meet, such as a robot and a lamp above it, are clear of each other.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khep_twin.errors import Location, Problem
from khep_twin.playpen.footprint import Footprint, overlap, sticks_out
from khep_twin.playpen.polygon import Point, contains, corner_before, walls_around

THING_LIMIT = 5000
"""Most parts of one playpen: MuJoCo needs seconds to compile so many."""


@dataclass(frozen=True, slots=True)
class Thing:
    """A part of a playpen.

    Attributes:
        kind: Its table in the playpen file.
        number: Its number among its kind, from 1.
        name: Its name, or None.
        footprint: Area of the floor that it covers.
        bottom_mm: Height of its lower end above the floor [mm].
        top_mm: Height of its upper end [mm].
        free: True if it can be pushed.
    """

    kind: str
    number: int
    name: str | None
    footprint: Footprint
    bottom_mm: float
    top_mm: float
    free: bool

    @property
    def place(self) -> Location:
        """Its table in the file."""
        return self.kind, self.number - 1

    @property
    def label(self) -> str:
        """Its name in messages."""
        return label(self.kind, self.number, self.name)

    def __str__(self) -> str:
        """Return label and position [mm]."""
        return f"{self.label} at ({self.footprint.x_mm:g}, {self.footprint.y_mm:g})"


def label(kind: str, number: int, name: str | None) -> str:
    """Return the name of a part in messages: kind, number from 1, and its name if it has one."""
    return f"{kind} {number}" + (f" ({name})" if name else "")


class Floor(Protocol):
    """The floor that things stand on."""

    width_mm: float
    height_mm: float
    wall_thickness_mm: float
    outline_mm: tuple[Point, ...]


def placement_problems(things: Sequence[Thing], floor: Floor) -> Iterator[Problem]:
    """Yield the placement problems of things on a floor, one line each."""
    if len(things) > THING_LIMIT:
        found = f"{len(things)} blocks, cylinders, lamps and robots"
        yield Problem.of((), found, f"up to {THING_LIMIT} together")
        return
    inside: list[Thing] = []
    for thing in things:
        outside = list(_outside(thing, floor))
        yield from outside
        if not outside:
            inside.append(thing)
    yield from _collisions(inside, floor)


def beyond(label: str, place: Location, at: Footprint, floor: Floor) -> Iterator[Problem]:
    """Yield the coordinates of a part's centre that lie beyond the sides of the floor."""
    for key, value, limit in (("x_mm", at.x_mm, floor.width_mm), ("y_mm", at.y_mm, floor.height_mm)):
        if value > limit:
            yield Problem.of(
                (*place, key), f"{label}: {key} = {value:g}: outside the arena", f"0 to {limit:g}"
            )


def _outside(thing: Thing, floor: Floor) -> Iterator[Problem]:
    at = thing.footprint
    told = list(beyond(thing.label, thing.place, at, floor))
    yield from told
    if not told and floor.outline_mm and not contains(floor.outline_mm, at.x_mm, at.y_mm):
        yield Problem.of(thing.place, f"{thing} is outside the arena's outline", "a place within it")


def _collisions(things: Sequence[Thing], floor: Floor) -> Iterator[Problem]:
    width_mm, height_mm = floor.width_mm, floor.height_mm
    walls = {"left": "x = 0", "right": f"x = {width_mm:g}", "bottom": "y = 0", "top": f"y = {height_mm:g}"}
    around = walls_around(floor.outline_mm, floor.wall_thickness_mm) if floor.outline_mm else []
    for thing in things:
        if not thing.free:
            continue
        for index, wall in enumerate(around):
            if overlap(thing.footprint, wall):
                number = corner_before(floor.outline_mm, index)
                found = f"{thing} overlaps the wall after corner {number}"
                yield Problem.of(thing.place, found, "a place further in")
        for wall, depth_mm in () if around else sticks_out(thing.footprint, width_mm, height_mm):
            inward_mm = math.ceil(depth_mm * 10) / 10
            found = f"{thing} overlaps the {wall} wall at {walls[wall]}"
            yield Problem.of(thing.place, found, f"{inward_mm:g} mm further in")
    for thing, other in _overlapping_pairs(things):
        # Spots may coincide, and a robot may stand on one: a robot is placed on a spot only if it is clear.
        kinds = {thing.kind, other.kind}
        if "spot" not in kinds or not kinds <= {"spot", "robot"}:
            yield Problem.of(thing.place, f"{thing} overlaps {other}", "a place clear of it")


def _overlapping_pairs(things: Sequence[Thing]) -> Iterator[tuple[Thing, Thing]]:
    """Yield pairs of overlapping things, the first of each free."""
    if not things:
        return
    shapes = [thing.footprint for thing in things]
    centres = np.array([(shape.x_mm, shape.y_mm) for shape in shapes])
    reaches = np.array([(shape.reach((1.0, 0.0)), shape.reach((0.0, 1.0))) for shape in shapes])
    low, high = centres - reaches, centres + reaches
    for index, thing in enumerate(things):
        if thing.free:
            # Bounding rectangles first: few of thousands overlap, and only those need the exact test.
            near = ((low < high[index]) & (high > low[index])).all(axis=1)
            neighbours: list[int] = near.nonzero()[0].tolist()
            for neighbour in neighbours:
                other = things[neighbour]
                # A pair of free things is reported once, by the later one.
                if (neighbour < index or not other.free) and _meet(thing, other):
                    yield thing, other


def _meet(one: Thing, other: Thing) -> bool:
    same_height = one.bottom_mm < other.top_mm and other.bottom_mm < one.top_mm
    return same_height and overlap(one.footprint, other.footprint)
