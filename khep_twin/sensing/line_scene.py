"""Surroundings of a line camera: faces, lamps, the camera's pose and its rays."""

import math
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector
from khep_twin.units import K213_PIXELS

X, Y, END_X, END_Y, RADIUS, BOTTOM, TOP, REFLECTANCE, GLOW, ROLE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Columns of a face: its left and its right end as seen from outside, or the centre of a cylinder, whose
radius is above 0 [m]; the heights of its lower and upper edge [m]; its reflectance; the luminance of a
lamp, otherwise 0 [cd/m^2]; and the sum of its roles."""
N_COLUMNS = 10

VISIBLE, CASTS_SHADOW, SAME_ROBOT = 1, 2, 4
"""Roles of a face: visible, casting shadows, and part of the robot that carries the camera."""

HALF_FIELD = math.tan(math.radians(18))
"""Tangent of half the field of view of 36 degrees (K213 manual 1.2)."""

RAYS_PER_PIXEL = 4
MARGIN = 10
"""Pixels beyond each end of the image whose light may blur into it: the largest half width of the blur."""

N_RAYS = (K213_PIXELS + 2 * MARGIN) * RAYS_PER_PIXEL
"""Number of rays."""

HALF_PIXELS = K213_PIXELS / 2
"""Half of the image [pixels]."""


class Eye(NamedTuple):
    """Pose of a line camera.

    Attributes:
        x: Position [m].
        y: Position [m].
        height: Height above the floor [m].
        cosine: Cosine of its heading.
        sine: Sine of its heading.
    """

    x: float
    y: float
    height: float
    cosine: float
    sine: float


class LineScene(NamedTuple):
    """Surroundings of a line camera.

    Attributes:
        faces: Faces and cylinders; rows from `n_faces` on are unused (n, N_COLUMNS).
        n_faces: Number of faces and cylinders (1,).
        lamps: Lamps: x, y, z [m] and power [W] (n_lamps, 4).
        room_lux: Illuminance by the room's lighting (1,) [lx].
        depths: Buffer for the depth on each ray (N_RAYS,) [m].
        luminances: Buffer for the luminance on each ray (N_RAYS,) [cd/m^2].
        face_index: Buffer for the index of the nearest face on each ray, -1 for none (N_RAYS,).
        visible_lamps: Buffer for 1 if a lamp shines on a point, otherwise 0 (n_lamps,).
        weighted_sums: Buffer for the sums of weighted luminances and of weights of each pixel (2, 64).
    """

    faces: Matrix
    n_faces: Vector[int]
    lamps: Matrix
    room_lux: Vector[float]
    depths: Vector[float]
    luminances: Vector[float]
    face_index: Vector[int]
    visible_lamps: Vector[int]
    weighted_sums: Matrix


@compilable
def ray_position(ray: int) -> float:
    """Return the position of a ray in the image [pixels]."""
    return (ray + 0.5) / RAYS_PER_PIXEL - MARGIN


@compilable
def ray_slope(ray: int) -> float:
    """Return the tangent of a ray's angle to the left of the optical axis."""
    return HALF_FIELD * (1 - ray_position(ray) / HALF_PIXELS)
