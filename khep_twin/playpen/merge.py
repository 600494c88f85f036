"""Merging of adjoining blocks: fewer geoms for the same walls."""

import math
from collections.abc import Sequence
from itertools import groupby

from khep_twin.playpen.parts import Block, Obstacle

_DECIMALS = 6
"""Decimals of a millimetre and of a degree to which coordinates are compared."""


def merge_blocks(obstacles: Sequence[Obstacle]) -> list[tuple[int, Obstacle]]:
    """Merge adjoining blocks; return each obstacle with the lowest of its numbers.

    Blocks are merged if they touch or overlap along one axis, are equally thick across it, and have the same
    angle, height and surface. Movable blocks, ramps, and blocks with names or stripes are not merged.
    """
    candidates: list[tuple[int, Block]] = []
    unmergeable: list[tuple[int, Obstacle]] = []
    for number, item in enumerate(obstacles):
        if not isinstance(item, Block) or item.movable or item.name or item.stripes or item.ramp:
            unmergeable.append((number, item))
        else:
            candidates.append((number, item))
    for lengthwise in (True, False):
        candidates = _merge_along(candidates, lengthwise)
    return sorted([*candidates, *unmergeable], key=lambda item: item[0])


def _merge_along(blocks: list[tuple[int, Block]], lengthwise: bool) -> list[tuple[int, Block]]:
    """Merge collinear blocks along their length, or across it."""
    merged_blocks: list[tuple[int, Block]] = []
    rows = sorted(
        ((_row_key(block, lengthwise), number, block) for number, block in blocks), key=lambda row: row[:2]
    )
    for _, row in groupby(rows, key=lambda row: row[0]):
        intervals = sorted((*_interval(block, lengthwise), number, block) for _, number, block in row)
        start, end, number, block = intervals[0]
        for next_start, next_end, next_number, _ in intervals[1:]:
            if next_start <= end + 10**-_DECIMALS:
                end, number = max(end, next_end), min(number, next_number)
                continue
            merged_blocks.append((number, _resize(block, start, end, lengthwise)))
            start, end, number = next_start, next_end, next_number
        merged_blocks.append((number, _resize(block, start, end, lengthwise)))
    return merged_blocks


def _direction(block: Block, lengthwise: bool) -> tuple[float, float]:
    angle = math.radians(block.angle_deg + (0 if lengthwise else 90))
    return math.cos(angle), math.sin(angle)


def _row_key(block: Block, lengthwise: bool) -> tuple[object, ...]:
    """Return a key that is equal for collinear blocks."""
    x, y = _direction(block, lengthwise)
    across = block.y_mm * x - block.x_mm * y
    thickness = block.width_mm if lengthwise else block.length_mm
    angle_deg = block.angle_deg % 360
    measures = [round(measure, _DECIMALS) for measure in (angle_deg, across, thickness)]
    return *measures, block.height_mm, block.surface


def _interval(block: Block, lengthwise: bool) -> tuple[float, float]:
    x, y = _direction(block, lengthwise)
    middle = block.x_mm * x + block.y_mm * y
    half = (block.length_mm if lengthwise else block.width_mm) / 2
    return middle - half, middle + half


def _resize(block: Block, start: float, end: float, lengthwise: bool) -> Block:
    """Return a block that extends from `start` to `end` along its line [mm]."""
    if (start, end) == _interval(block, lengthwise):
        return block
    x, y = _direction(block, lengthwise)
    shift = (start + end) / 2 - (block.x_mm * x + block.y_mm * y)
    size = {"length_mm" if lengthwise else "width_mm": end - start}
    return block.model_copy(update={"x_mm": block.x_mm + shift * x, "y_mm": block.y_mm + shift * y, **size})
