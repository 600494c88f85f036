"""Playpens from bitmaps: solid pixels become blocks, solid edges the arena's walls.

The blocks cover the solid pixels exactly and do not overlap. Equal runs of pixels in consecutive rows are
merged to one block, or the same by columns, whichever gives fewer blocks. A slanting edge becomes steps, and
each step costs a block.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import BitmapError
from khep_twin.files import toml_files
from khep_twin.playpen.model import Playpen
from khep_twin.playpen.overlap import THING_LIMIT
from khep_twin.units import BODY_RADIUS

SIDE_LIMIT = 4096
"""Most rows, and most columns, of a bitmap."""

BLOCK_LIMIT = THING_LIMIT - 1
"""Most blocks: the limit of a playpen's parts, less a robot."""

CLEARANCE_MM = 1.0
"""Least clearance around a robot that is placed automatically [mm]."""

_THICKNESS_MM, _LEAST_MM, _THICKEST_MM = 10.0, 1.0, 1000.0
_ARENA_MM = (100.0, 10_000.0)
_ADVICE = ", as from a picture of fewer pixels with a larger --mm-per-pixel"

Pixels = NDArray[np.bool_]
"""Solid pixels (rows, columns), the first row at the top."""

Pose = tuple[float, float, float]
"""x, y [mm] and heading [deg]."""


@dataclass(frozen=True, slots=True)
class Borders:
    """Numbers of wholly solid rows and columns at the edges [pixels]."""

    left: int
    right: int
    bottom: int
    top: int

    @property
    def equal(self) -> bool:
        """True if there are as many on all four sides."""
        return self.left == self.right == self.bottom == self.top


@dataclass(frozen=True, slots=True)
class Imported:
    """A playpen and the solid borders of its bitmap."""

    playpen: Playpen
    borders: Borders


def to_playpen(
    solid: Pixels,
    name: str,
    *,
    mm_per_pixel: float = 1.0,
    height_mm: float = 50.0,
    robot: Pose | None = None,
    find_place: bool = True,
) -> Imported:
    """Convert a bitmap to a playpen.

    Args:
        solid: Bitmap (rows, columns), its first row at the top, where y is largest.
        name: Name of the playpen.
        mm_per_pixel: Side of a pixel [mm].
        height_mm: Height of the blocks [mm].
        robot: Pose of a robot.
        find_place: True to put a robot at the free position nearest to the middle if `robot` is not given.

    Raises:
        BitmapError: The arena's or a block's size is out of range, there are too many blocks, or the robot
            cannot stand at its pose.
    """
    _check_scale(solid, mm_per_pixel, height_mm)
    inner, borders = strip(solid)
    height, width = (float(side * mm_per_pixel) for side in inner.shape)
    if not all(_ARENA_MM[0] <= side <= _ARENA_MM[1] for side in (width, height)):
        raise BitmapError(
            f"an arena of {width:g} x {height:g} mm within the walls; expected {_ARENA_MM[0]:g} to "
            f"{_ARENA_MM[1]:g} mm a side",
            ", as with another --mm-per-pixel",
        )
    low, size = _blocks(inner, mm_per_pixel)
    if robot is None and find_place:
        robot = free_place(low, size, width, height)
    thickness = borders.left * mm_per_pixel
    if not borders.equal or not _LEAST_MM <= thickness <= _THICKEST_MM:
        thickness = _THICKNESS_MM
    data: dict[str, object] = {
        "version": 1,
        "name": name,
        "arena": {
            "width_mm": _round(width),
            "height_mm": _round(height),
            "wall_thickness_mm": _round(thickness),
        },
        "block": tuple(
            {
                "x_mm": _round(x + length / 2),
                "y_mm": _round(y + depth / 2),
                "length_mm": _round(length),
                "width_mm": _round(depth),
                "height_mm": float(height_mm),
            }
            for (x, y), (length, depth) in zip(low.tolist(), size.tolist(), strict=True)
        ),
        "robot": () if robot is None else (dict(zip(("x_mm", "y_mm", "heading_deg"), robot, strict=True)),),
    }
    try:
        return Imported(toml_files.check(Playpen, data, "playpen", BitmapError), borders)
    except BitmapError as error:
        # A robot on a slanting block overlaps dozens; one message is enough.
        raise BitmapError(str(error).splitlines()[0].removeprefix("playpen: ")) from None


def _check_scale(solid: Pixels, mm_per_pixel: float, height_mm: float) -> None:
    for key, value, least in (("--mm-per-pixel", mm_per_pixel, 0.001), ("--height-mm", height_mm, 1.0)):
        # In this order, as comparisons with nan are false.
        if not least <= value <= 1000:
            raise BitmapError(f"{key} {value:g}; expected a number from {least:g} to 1000")
    if not solid.size or max(solid.shape) > SIDE_LIMIT:
        rows, columns = solid.shape
        raise BitmapError(f"{rows} x {columns} pixels; expected 1 to {SIDE_LIMIT} rows and columns")


def _blocks(inner: Pixels, mm_per_pixel: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the blocks' lower left corners and extents along x and y, (blocks, 2) each [mm]."""
    boxes = rectangles(inner)
    least = float(boxes[:, 2:].min(initial=SIDE_LIMIT) * mm_per_pixel)
    if least < _LEAST_MM:
        raise BitmapError(f"a block of {least:g} mm; expected at least {_LEAST_MM:g} mm", _ADVICE)
    row, column, rows, columns = boxes.T
    low = np.column_stack((column, inner.shape[0] - row - rows)).astype(np.float64)
    size = np.column_stack((columns, rows)).astype(np.float64)
    low *= mm_per_pixel
    size *= mm_per_pixel
    return low, size


def strip(solid: Pixels) -> tuple[Pixels, Borders]:
    """Strip the wholly solid rows and columns at the edges; return the rest and their numbers.

    Raises:
        BitmapError: Nothing is left.
    """
    rows, columns = np.all(solid, axis=1).tolist(), np.all(solid, axis=0).tolist()
    if all(rows):
        raise BitmapError("every pixel is solid; expected a bitmap with a free floor")
    top, bottom, left, right = (line.index(False) for line in (rows, rows[::-1], columns, columns[::-1]))
    inner = solid[top : solid.shape[0] - bottom, left : solid.shape[1] - right]
    return inner, Borders(left, right, bottom, top)


def rectangles(solid: Pixels) -> NDArray[np.int64]:
    """Cover the solid pixels exactly with rectangles that do not overlap.

    Returns:
        Row and column of the first pixel, rows, columns (rectangles, 4), from the top left on.

    Raises:
        BitmapError: There are more than a playpen may hold beside a robot.
    """
    (fewest, boxes), (others, turned) = _merged_runs(solid), _merged_runs(solid.T)
    if others < fewest:
        fewest, boxes = others, turned[:, [1, 0, 3, 2]]
    if fewest > BLOCK_LIMIT:
        raise BitmapError(f"{fewest} blocks; expected up to {BLOCK_LIMIT}", _ADVICE)
    return boxes[np.lexsort((boxes[:, 1], boxes[:, 0]))]


def _merged_runs(solid: Pixels) -> tuple[int, NDArray[np.int64]]:
    """Merge equal runs of adjoining rows; return the number of rectangles, and these unless too many."""
    rows, columns = solid.shape
    count, done = 0, [np.zeros((0, 4), dtype=np.int64)]
    # A run is encoded as one number: its first column and the one behind its last.
    runs = since = np.zeros(0, dtype=np.int64)
    for row in range(rows + 1):
        line = np.zeros(columns + 2, dtype=np.int8)
        if row < rows:
            line[1:-1] = solid[row]
        edges = np.diff(line)
        found = np.flatnonzero(edges == 1) * (columns + 1) + np.flatnonzero(edges == -1)
        kept, same, old = np.intersect1d(found, runs, assume_unique=True, return_indices=True)
        ended = np.ones(len(runs), dtype=np.bool_)
        ended[old] = False
        count += len(runs) - len(kept)
        if count <= BLOCK_LIMIT and ended.any():
            first, behind = np.divmod(runs[ended], columns + 1)
            done.append(np.column_stack((since[ended], first, row - since[ended], behind - first)))
        began = np.full(len(found), row, dtype=np.int64)
        began[same] = since[old]
        runs, since = found, began
    return count, np.concatenate(done)


def free_place(
    low_mm: NDArray[np.float64], size_mm: NDArray[np.float64], width_mm: float, height_mm: float
) -> Pose | None:
    """Return the position for a robot nearest to the arena's middle, clear of all rectangles and walls.

    Args:
        low_mm: Lower left corners of the rectangles (rectangles, 2) [mm].
        size_mm: Extents of the rectangles along x and y (rectangles, 2) [mm].
        width_mm: Width of the arena.
        height_mm: Height of the arena.

    Returns:
        Pose, looking along y; None if there is none on a grid of a thousandth of the arena, at least 1 mm.
    """
    step = max(1.0, math.ceil(max(width_mm, height_mm) / 1000))
    reach = BODY_RADIUS * 1000 + CLEARANCE_MM
    x, y = (_grid(side, step, reach) for side in (width_mm, height_mm))
    free = np.ones((len(y), len(x)), dtype=np.bool_)
    for (left, bottom), (length, depth) in zip(low_mm.tolist(), size_mm.tolist(), strict=True):
        across = slice(*np.searchsorted(x, (left - reach, left + length + reach)).tolist())
        along = slice(*np.searchsorted(y, (bottom - reach, bottom + depth + reach)).tolist())
        dx, dy = _beyond(x[across], left, length), _beyond(y[along], bottom, depth)
        free[along, across] &= dx**2 + dy[:, None] ** 2 >= reach**2
    if not free.any():
        return None
    away = (x - width_mm / 2) ** 2 + (y[:, None] - height_mm / 2) ** 2
    row, column = np.unravel_index(np.argmin(np.where(free, away, np.inf)), free.shape)
    return float(x[column]), float(y[row]), 90.0


def _grid(side_mm: float, step_mm: float, reach_mm: float) -> NDArray[np.float64]:
    """Return positions along a side, including the middle, at least `reach_mm` from its ends."""
    places = np.arange(0.0, side_mm, step_mm) + side_mm / 2 % step_mm
    return places[(places >= reach_mm) & (places <= side_mm - reach_mm)]


def _beyond(places: NDArray[np.float64], low: float, size: float) -> NDArray[np.float64]:
    """Return the distances of positions to an interval; 0 within it."""
    return np.maximum(np.maximum(low - places, places - low - size), 0.0)


def _round(value_mm: float) -> float:
    return round(value_mm, 6)
