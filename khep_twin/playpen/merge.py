"""Merging of blocks that continue each other: fewer geoms, and the same walls."""

import math
from collections.abc import Sequence
from itertools import groupby

from khep_twin.playpen.parts import Block

_SAME = 6
"""Decimals of a millimetre and of a degree to which coordinates are compared."""


def merged(blocks: Sequence[Block]) -> list[tuple[int, Block]]:
    """Merge blocks that continue each other; return them with the first number of each.

    Merged are fixed blocks without names and stripes, no ramps, of one angle, height and surface, that touch
    or cross along one of their axes and are equally thick across it.
    """
    numbered = list(enumerate(blocks))
    candidates = [(number, block) for number, block in numbered if not _stays(block)]
    others = [(number, block) for number, block in numbered if _stays(block)]
    for lengthwise in (True, False):
        candidates = _merged_along(candidates, lengthwise)
    return sorted([*candidates, *others], key=lambda item: item[0])


def _stays(block: Block) -> bool:
    return bool(block.movable or block.name or block.stripes or block.ramp)


def _merged_along(blocks: list[tuple[int, Block]], lengthwise: bool) -> list[tuple[int, Block]]:
    """Merge the blocks of each line along their length, or across it."""
    found: list[tuple[int, Block]] = []
    rows = sorted(
        ((_row(block, lengthwise), number, block) for number, block in blocks), key=lambda row: row[:2]
    )
    for _, row in groupby(rows, key=lambda row: row[0]):
        stretches = sorted((*_stretch(block, lengthwise), number, block) for _, number, block in row)
        start, end, number, block = stretches[0]
        for next_start, next_end, next_number, _ in stretches[1:]:
            if next_start <= end + 10**-_SAME:
                end, number = max(end, next_end), min(number, next_number)
                continue
            found.append((number, _stretched(block, start, end, lengthwise)))
            start, end, number = next_start, next_end, next_number
        found.append((number, _stretched(block, start, end, lengthwise)))
    return found


def _axis(block: Block, lengthwise: bool) -> tuple[float, float]:
    angle = math.radians(block.angle_deg + (0 if lengthwise else 90))
    return math.cos(angle), math.sin(angle)


def _row(block: Block, lengthwise: bool) -> tuple[object, ...]:
    """Return the key that blocks of one line share."""
    x, y = _axis(block, lengthwise)
    across = block.y_mm * x - block.x_mm * y
    thick = block.width_mm if lengthwise else block.length_mm
    angle_deg = block.angle_deg % 360
    return round(angle_deg, _SAME), round(across, _SAME), round(thick, _SAME), block.height_mm, block.surface


def _stretch(block: Block, lengthwise: bool) -> tuple[float, float]:
    x, y = _axis(block, lengthwise)
    middle = block.x_mm * x + block.y_mm * y
    half = (block.length_mm if lengthwise else block.width_mm) / 2
    return middle - half, middle + half


def _stretched(block: Block, start: float, end: float, lengthwise: bool) -> Block:
    """Return a block from start to end of its line."""
    if (start, end) == _stretch(block, lengthwise):
        return block
    x, y = _axis(block, lengthwise)
    shift = (start + end) / 2 - (block.x_mm * x + block.y_mm * y)
    size = {"length_mm" if lengthwise else "width_mm": end - start}
    return block.model_copy(update={"x_mm": block.x_mm + shift * x, "y_mm": block.y_mm + shift * y, **size})
