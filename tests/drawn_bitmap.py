"""A playpen as a bitmap, drawn with a ruler, and a playpen drawn back into pixels."""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import Playpen

BLOCKS = [(120, 400, 80, 20, 0), (450, 380, 80, 20, 45), (200, 120, 60, 30, -45), (480, 150, 90, 16, 90)]
"""x, y, length, width [mm] and angle [deg], from the outer lower left corner; no two corners are alike."""


def drawn(wall: int = 10) -> NDArray[np.bool_]:
    """500 rows x 600 columns, the first row at the top."""
    solid = np.ones((500, 600), dtype=np.bool_)
    solid[wall : 500 - wall, wall : 600 - wall] = False
    rows, columns = np.mgrid[:500, :600]
    x, y = columns + 0.5, 500 - rows - 0.5
    for cx, cy, length, width, angle in BLOCKS:
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        along, across = (x - cx) * c + (y - cy) * s, (y - cy) * c - (x - cx) * s
        solid |= (abs(along) <= length / 2) & (abs(across) <= width / 2)
    return solid


def seen_from_above(playpen: Playpen) -> NDArray[np.bool_]:
    """The floor within the walls in pixels of 1 mm, the first row at the top."""
    rows, columns = np.mgrid[: round(playpen.arena.height_mm), : round(playpen.arena.width_mm)]
    x, y = columns + 0.5, playpen.arena.height_mm - rows - 0.5
    solid = np.zeros(x.shape, dtype=np.bool_)
    for block in playpen.blocks:
        place = block.footprint
        solid |= (abs(x - place.x_mm) < place.length_mm / 2) & (abs(y - place.y_mm) < place.width_mm / 2)
    return solid
