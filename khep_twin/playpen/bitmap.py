"""Playpens from bitmaps: solid pixels become blocks, solid edges the arena's walls.

The blocks cover the solid pixels exactly and do not overlap. Equal runs of pixels in consecutive rows, or
columns, are merged to one block; the direction that gives fewer blocks is used. A slanting edge becomes
steps, with a block for each step.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import BitmapError
from khep_twin.files import toml_files
from khep_twin.playpen.model import Playpen
from khep_twin.playpen.overlap import PART_LIMIT
from khep_twin.units import BODY_RADIUS

SIDE_LIMIT = 4096
"""Most rows, and most columns, of a bitmap."""

BLOCK_LIMIT = PART_LIMIT - 1
"""Most blocks: the limit of a playpen's parts, minus one robot."""

CLEARANCE_MM = 1.0
"""Least clearance around a robot that is placed automatically [mm]."""

_THICKNESS_MM, _MIN_SIZE_MM, _MAX_THICKNESS_MM = 10.0, 1.0, 1000.0
_ARENA_MM = (100.0, 10_000.0)
_ADVICE = ", as from a picture of fewer pixels with a larger --mm-per-pixel"

Pixels = NDArray[np.bool_]
"""Solid pixels (rows, columns), the first row at the top."""

Pose = tuple[float, float, float]
"""x, y [mm] and heading [deg]."""


@dataclass(frozen=True, slots=True)
class Borders:
    """Numbers of completely solid rows and columns at the edges [pixels]."""

    left: int
    right: int
    bottom: int
    top: int

    @property
    def are_equal(self) -> bool:
        """True if all four borders have the same width."""
        return self.left == self.right == self.bottom == self.top


@dataclass(frozen=True, slots=True)
class BitmapPlaypen:
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
    place_robot: bool = True,
) -> BitmapPlaypen:
    """Convert a bitmap to a playpen.

    Args:
        solid: Bitmap (rows, columns), its first row at the top, where y is largest.
        name: Name of the playpen.
        mm_per_pixel: Side of a pixel [mm].
        height_mm: Height of the blocks [mm].
        robot: Pose of a robot.
        place_robot: True to place a robot at the free position nearest to the middle if `robot` is not given.

    Raises:
        BitmapError: The size of the arena or of a block is out of range, there are more blocks than the
            limit, or the robot cannot stand at its pose.
    """
    _check_arguments(solid, mm_per_pixel, height_mm)
    solid_inside, borders = strip_borders(solid)
    height, width = (float(side * mm_per_pixel) for side in solid_inside.shape)
    if not all(_ARENA_MM[0] <= side <= _ARENA_MM[1] for side in (width, height)):
        raise BitmapError(
            f"an arena of {width:g} x {height:g} mm within the walls; expected {_ARENA_MM[0]:g} to "
            f"{_ARENA_MM[1]:g} mm a side",
            ", as with another --mm-per-pixel",
        )
    corners, sizes = _find_blocks(solid_inside, mm_per_pixel)
    if robot is None and place_robot:
        robot = find_free_pose(corners, sizes, width, height)
    thickness = borders.left * mm_per_pixel
    if not borders.are_equal or not _MIN_SIZE_MM <= thickness <= _MAX_THICKNESS_MM:
        thickness = _THICKNESS_MM
    data: dict[str, object] = {
        "version": 1,
        "name": name,
        "arena": {
            "width_mm": _round_mm(width),
            "height_mm": _round_mm(height),
            "wall_thickness_mm": _round_mm(thickness),
        },
        "block": tuple(
            {
                "x_mm": _round_mm(x + length / 2),
                "y_mm": _round_mm(y + depth / 2),
                "length_mm": _round_mm(length),
                "width_mm": _round_mm(depth),
                "height_mm": float(height_mm),
            }
            for (x, y), (length, depth) in zip(corners.tolist(), sizes.tolist(), strict=True)
        ),
        "robot": () if robot is None else (dict(zip(("x_mm", "y_mm", "heading_deg"), robot, strict=True)),),
    }
    try:
        return BitmapPlaypen(toml_files.check(Playpen, data, "playpen", BitmapError), borders)
    except BitmapError as error:
        # A robot on a slanting edge overlaps dozens of blocks; one message is enough.
        raise BitmapError(str(error).splitlines()[0].removeprefix("playpen: ")) from None


def _check_arguments(solid: Pixels, mm_per_pixel: float, height_mm: float) -> None:
    for key, value, minimum in (("--mm-per-pixel", mm_per_pixel, 0.001), ("--height-mm", height_mm, 1.0)):
        # Not `value < minimum or ...`, as comparisons with nan are false.
        if not minimum <= value <= 1000:
            raise BitmapError(f"{key} {value:g}; expected a number from {minimum:g} to 1000")
    if not solid.size or max(solid.shape) > SIDE_LIMIT:
        rows, columns = solid.shape
        raise BitmapError(f"{rows} x {columns} pixels; expected 1 to {SIDE_LIMIT} rows and columns")


def _find_blocks(solid: Pixels, mm_per_pixel: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the blocks' lower left corners and sizes along x and y, (blocks, 2) each [mm]."""
    boxes = cover_with_rectangles(solid)
    smallest_mm = float(boxes[:, 2:].min(initial=SIDE_LIMIT) * mm_per_pixel)
    if smallest_mm < _MIN_SIZE_MM:
        raise BitmapError(f"a block of {smallest_mm:g} mm; expected at least {_MIN_SIZE_MM:g} mm", _ADVICE)
    row, column, rows, columns = boxes.T
    corners = np.column_stack((column, solid.shape[0] - row - rows)).astype(np.float64)
    sizes = np.column_stack((columns, rows)).astype(np.float64)
    corners *= mm_per_pixel
    sizes *= mm_per_pixel
    return corners, sizes


def strip_borders(solid: Pixels) -> tuple[Pixels, Borders]:
    """Remove the completely solid rows and columns at the edges; return the rest and their numbers.

    Raises:
        BitmapError: All pixels are solid.
    """
    rows, columns = np.all(solid, axis=1).tolist(), np.all(solid, axis=0).tolist()
    if all(rows):
        raise BitmapError("every pixel is solid; expected a bitmap with a free floor")
    top, bottom, left, right = (line.index(False) for line in (rows, rows[::-1], columns, columns[::-1]))
    inner = solid[top : solid.shape[0] - bottom, left : solid.shape[1] - right]
    return inner, Borders(left, right, bottom, top)


def cover_with_rectangles(solid: Pixels) -> NDArray[np.int64]:
    """Cover the solid pixels exactly with rectangles that do not overlap.

    Returns:
        Row and column of the first pixel, and numbers of rows and columns (rectangles, 4), from the top left.

    Raises:
        BitmapError: There are more than `BLOCK_LIMIT`.
    """
    (n_boxes, boxes), (n_column_boxes, column_boxes) = _merge_runs(solid), _merge_runs(solid.T)
    if n_column_boxes < n_boxes:
        n_boxes, boxes = n_column_boxes, column_boxes[:, [1, 0, 3, 2]]
    if n_boxes > BLOCK_LIMIT:
        raise BitmapError(f"{n_boxes} blocks; expected up to {BLOCK_LIMIT}", _ADVICE)
    return boxes[np.lexsort((boxes[:, 1], boxes[:, 0]))]


def _merge_runs(solid: Pixels) -> tuple[int, NDArray[np.int64]]:
    """Merge equal runs of adjoining rows; return the number of rectangles, and those up to the limit."""
    rows, columns = solid.shape
    count = 0
    boxes = [np.zeros((0, 4), dtype=np.int64)]
    # A run is encoded as one number: its first column * (columns + 1) + its end column.
    runs = first_rows = np.zeros(0, dtype=np.int64)
    for row in range(rows + 1):
        padded_row = np.zeros(columns + 2, dtype=np.int8)
        if row < rows:
            padded_row[1:-1] = solid[row]
        edges = np.diff(padded_row)
        row_runs = np.flatnonzero(edges == 1) * (columns + 1) + np.flatnonzero(edges == -1)
        _, new, old = np.intersect1d(row_runs, runs, assume_unique=True, return_indices=True)
        is_complete = np.ones(len(runs), dtype=np.bool_)
        is_complete[old] = False
        count += len(runs) - len(old)
        if count <= BLOCK_LIMIT and is_complete.any():
            top, (left, right) = first_rows[is_complete], np.divmod(runs[is_complete], columns + 1)
            boxes.append(np.column_stack((top, left, row - top, right - left)))
        start_rows = np.full(len(row_runs), row, dtype=np.int64)
        start_rows[new] = first_rows[old]
        runs, first_rows = row_runs, start_rows
    return count, np.concatenate(boxes)


def find_free_pose(
    low_mm: NDArray[np.float64], size_mm: NDArray[np.float64], width_mm: float, height_mm: float
) -> Pose | None:
    """Return the collision-free pose of a robot nearest to the arena's middle.

    Args:
        low_mm: Lower left corners of the rectangles (rectangles, 2) [mm].
        size_mm: Extents of the rectangles along x and y (rectangles, 2) [mm].
        width_mm: Width of the arena.
        height_mm: Height of the arena.

    Returns:
        Pose along y; None if there is none on a grid of a thousandth of the arena, at least 1 mm.
    """
    step = max(1.0, math.ceil(max(width_mm, height_mm) / 1000))
    margin = BODY_RADIUS * 1000 + CLEARANCE_MM
    x, y = (_grid_positions(side, step, margin) for side in (width_mm, height_mm))
    is_free = np.ones((len(y), len(x)), dtype=np.bool_)
    for (left, bottom), (length, depth) in zip(low_mm.tolist(), size_mm.tolist(), strict=True):
        columns = slice(*np.searchsorted(x, (left - margin, left + length + margin)).tolist())
        rows = slice(*np.searchsorted(y, (bottom - margin, bottom + depth + margin)).tolist())
        dx, dy = _interval_distances(x[columns], left, length), _interval_distances(y[rows], bottom, depth)
        is_free[rows, columns] &= dx**2 + dy[:, None] ** 2 >= margin**2
    if not is_free.any():
        return None
    squared_distance = (x - width_mm / 2) ** 2 + (y[:, None] - height_mm / 2) ** 2
    row, column = np.unravel_index(np.argmin(np.where(is_free, squared_distance, np.inf)), is_free.shape)
    return float(x[column]), float(y[row]), 90.0


def _grid_positions(side_mm: float, step_mm: float, margin_mm: float) -> NDArray[np.float64]:
    """Return positions along a side, including the middle, at least `margin_mm` from its ends."""
    positions = np.arange(0.0, side_mm, step_mm) + side_mm / 2 % step_mm
    return positions[(positions >= margin_mm) & (positions <= side_mm - margin_mm)]


def _interval_distances(positions: NDArray[np.float64], low: float, size: float) -> NDArray[np.float64]:
    """Return the distances of positions to an interval; 0 within it."""
    return np.maximum(np.maximum(low - positions, positions - low - size), 0.0)


def _round_mm(value_mm: float) -> float:
    return round(value_mm, 6)
