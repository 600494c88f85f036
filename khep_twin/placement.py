"""Placement: whether things can stand where a playpen puts them.

What is fixed may touch and cross anything, as the walls of a maze do. What is free (robots, movable objects)
must start clear of all else, or the physics would begin by throwing it out. Heights count: two things whose
heights do not meet, such as a robot and a lamp above it, are clear of each other.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from khep_twin.footprint import Footprint, overlap, sticks_out

THING_LIMIT = 5000
"""Most things in one playpen: MuJoCo needs seconds to compile so many."""

COLLISION_LIMIT = 50
"""Most overlaps told at once: 5000 things on one spot have millions."""


@dataclass(frozen=True, slots=True)
class Thing:
    """Something in a playpen.

    Attributes:
        kind: its table in the playpen file.
        number: its place among its kind, from 1.
        name: its own name, None without.
        footprint: what it covers of the floor.
        bottom_mm: where it begins above the floor [mm].
        top_mm: where it ends [mm].
        free: whether it is moved by what pushes it.
    """

    kind: str
    number: int
    name: str | None
    footprint: Footprint
    bottom_mm: float
    top_mm: float
    free: bool

    @property
    def label(self) -> str:
        """What to call it in messages."""
        return label(self.kind, self.number, self.name)

    def __str__(self) -> str:
        """Label and place."""
        return f"{self.label} at ({self.footprint.x_mm:g}, {self.footprint.y_mm:g})"


def label(kind: str, number: int, name: str | None) -> str:
    """What messages call a part of a playpen: kind, number from 1, and name if it has one."""
    return f"{kind} {number}" + (f" ({name})" if name else "")


def placement_problems(things: Sequence[Thing], width_mm: float, height_mm: float) -> Iterator[str]:
    """What is wrong with things in an arena of this size, one line each."""
    if len(things) > THING_LIMIT:
        yield f"{len(things)} blocks, cylinders, lamps and robots; right is up to {THING_LIMIT} together"
        return
    yield from _shared_names(things)
    inside: list[Thing] = []
    for thing in things:
        outside = list(_outside(thing, width_mm, height_mm))
        yield from outside
        if not outside:
            inside.append(thing)
    collisions = list(islice(_collisions(inside, width_mm, height_mm), COLLISION_LIMIT + 1))
    yield from collisions[:COLLISION_LIMIT]
    if len(collisions) > COLLISION_LIMIT:
        yield f"more than {COLLISION_LIMIT} overlaps; the others are told once these are gone"


def _shared_names(things: Sequence[Thing]) -> Iterator[str]:
    first: dict[str, Thing] = {}
    for thing in things:
        if thing.name is not None and first.setdefault(thing.name, thing) is not thing:
            other = first[thing.name].label
            yield f'{thing.label}: name = "{thing.name}": taken by {other}; right is a name used once'


def _outside(thing: Thing, width_mm: float, height_mm: float) -> Iterator[str]:
    place = thing.footprint
    for key, value, limit in (("x_mm", place.x_mm, width_mm), ("y_mm", place.y_mm, height_mm)):
        if value > limit:
            yield f"{thing.label}: {key} = {value:g}: outside the arena; right is from 0 to {limit:g}"


def _collisions(things: Sequence[Thing], width_mm: float, height_mm: float) -> Iterator[str]:
    walls = {"left": "x = 0", "right": f"x = {width_mm:g}", "bottom": "y = 0", "top": f"y = {height_mm:g}"}
    for thing in things:
        if thing.free:
            for wall, depth_mm in sticks_out(thing.footprint, width_mm, height_mm):
                inward_mm = math.ceil(depth_mm * 10) / 10
                yield (
                    f"{thing} overlaps the {wall} wall at {walls[wall]}; right is {inward_mm:g} mm further in"
                )
    for thing, other in _overlapping_pairs(things):
        yield f"{thing} overlaps {other}; right is a place clear of it"


def _overlapping_pairs(things: Sequence[Thing]) -> Iterator[tuple[Thing, Thing]]:
    """Pairs of overlapping things of which at least one is free, the free one first."""
    # Swept from left to right: only things side by side in x are looked at.
    spans = {id(thing): thing.footprint.reach((1.0, 0.0)) for thing in things}
    fixed: list[Thing] = []
    free: list[Thing] = []
    for thing in sorted(things, key=lambda thing: thing.footprint.x_mm - spans[id(thing)]):
        left_mm = thing.footprint.x_mm - spans[id(thing)]
        free = [other for other in free if other.footprint.x_mm + spans[id(other)] > left_mm]
        fixed = [other for other in fixed if other.footprint.x_mm + spans[id(other)] > left_mm]
        for other in (*free, *fixed) if thing.free else free:
            if _meet(thing, other):
                yield (thing, other) if thing.free else (other, thing)
        (free if thing.free else fixed).append(thing)


def _meet(one: Thing, other: Thing) -> bool:
    same_height = one.bottom_mm < other.top_mm and other.bottom_mm < one.top_mm
    return same_height and overlap(one.footprint, other.footprint)
