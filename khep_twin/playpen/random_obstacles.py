"""Random obstacle fields: playpens whose blocks and cylinders cover a given fraction of the floor.

All gaps between obstacles, and to the walls, are at least a lane wide, so that a robot fits through. The
middle of the arena is free for the robot.
"""

import math
from dataclasses import replace

import numpy as np

from khep_twin.errors import PlaypenError
from khep_twin.playpen.footprint import Circle, Footprint, overlap
from khep_twin.playpen.model import Playpen
from khep_twin.playpen.parts import Arena, Block, Cylinder, RobotEntry
from khep_twin.units import BODY_RADIUS

LANE_MM = 70.0
"""Minimum gap between two obstacles [mm]: a robot of 55 mm and clearance."""

HIGHEST_DENSITY = 0.1
"""Highest fraction of the floor that obstacles with lanes between them can cover."""

_MAX_TRIES = 20_000


def obstacle_field(
    name: str, width_mm: float, height_mm: float, density: float, rng: np.random.Generator
) -> Playpen:
    """Generate an obstacle field.

    Args:
        name: Name of the playpen.
        width_mm: Width of the arena.
        height_mm: Height of the arena.
        density: Fraction of the floor that obstacles cover, 0 to `HIGHEST_DENSITY`.
        rng: Random generator for kinds, sizes, positions and angles.

    Raises:
        PlaypenError: The density is out of range, or was not reached in the limit of tries.
    """
    if not 0 <= density <= HIGHEST_DENSITY:
        expected = f"0 to {HIGHEST_DENSITY:g}"
        raise PlaypenError(f"density = {density:g}", key="density", value=density, expected=expected)
    arena = Arena(width_mm=width_mm, height_mm=height_mm)
    middle = Circle(width_mm / 2, height_mm / 2, 1000 * BODY_RADIUS)
    footprints: list[Footprint] = [middle]
    blocks: list[Block] = []
    cylinders: list[Cylinder] = []
    target_area = density * width_mm * height_mm
    covered_area = 0.0
    for _ in range(_MAX_TRIES):
        if covered_area >= target_area:
            robot = RobotEntry(x_mm=middle.x_mm, y_mm=middle.y_mm, heading_deg=0)
            tables = {"block": tuple(blocks), "cylinder": tuple(cylinders), "robot": (robot,)}
            return Playpen.model_validate({"version": 1, "name": name, "arena": arena, **tables})
        size, width, along, across, rotation = rng.uniform(size=5).tolist()
        item: Block | Cylinder
        if rng.uniform() < 0.5:
            radius_mm = round(12.5 + 45 * size, 1)
            x_mm, y_mm = _draw_position(arena, radius_mm + LANE_MM, along, across)
            if x_mm < 0:
                continue
            item = Cylinder(x_mm=x_mm, y_mm=y_mm, radius_mm=radius_mm, height_mm=50)
        else:
            length_mm, depth_mm = round(60 + 140 * size, 1), round(20 + 50 * width, 1)
            x_mm, y_mm = _draw_position(arena, math.hypot(length_mm, depth_mm) / 2 + LANE_MM, along, across)
            if x_mm < 0:
                continue
            item = Block(
                x_mm=x_mm,
                y_mm=y_mm,
                length_mm=length_mm,
                width_mm=depth_mm,
                height_mm=50,
                angle_deg=round(180 * rotation, 1),
            )
        lane = _grow(item.footprint, LANE_MM)
        if any(overlap(lane, shape) for shape in footprints):
            continue
        footprints.append(item.footprint)
        if isinstance(item, Cylinder):
            cylinders.append(item)
            covered_area += math.pi * item.radius_mm**2
        else:
            blocks.append(item)
            covered_area += item.length_mm * item.width_mm
    share = covered_area / (width_mm * height_mm)
    raise PlaypenError(
        f"density = {density:g}: with lanes of {LANE_MM:g} mm there was room for {share:.3f} of the floor; "
        "expected less, or another seed"
    )


def _draw_position(arena: Arena, margin_mm: float, along: float, across: float) -> tuple[float, float]:
    """Return a random position at least `margin_mm` from the walls; negative if there is none."""
    spans = arena.width_mm - 2 * margin_mm, arena.height_mm - 2 * margin_mm
    if min(spans) <= 0:
        return -1.0, -1.0
    return round(margin_mm + spans[0] * along, 1), round(margin_mm + spans[1] * across, 1)


def _grow(shape: Footprint, margin_mm: float) -> Footprint:
    if isinstance(shape, Circle):
        return replace(shape, radius_mm=shape.radius_mm + margin_mm)
    return replace(shape, length_mm=shape.length_mm + 2 * margin_mm, width_mm=shape.width_mm + 2 * margin_mm)
