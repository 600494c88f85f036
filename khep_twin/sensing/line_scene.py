"""Surroundings of a line camera, as numbers: faces, lamps, the camera's place and its rays."""

import math
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector
from khep_twin.units import K213_PIXELS

X, Y, END_X, END_Y, RADIUS, BOTTOM, TOP, REFLECTANCE, GLOW, ROLE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Columns of a face: its left and its right end as seen from outside, or the centre of a cylinder, whose
radius is above 0 [m]; the heights of its lower and upper edge [m]; the part of the light that it reflects;
its own luminance [cd/m^2]; and the sum of its roles."""
N_COLUMNS = 10

SEEN, CASTS, OWN = 1, 2, 4
"""Roles of a face: it is seen, it casts shadows, and it is of the robot that carries the camera."""

HALF_FIELD = math.tan(math.radians(18))
"""Tangent of half the field of view of 36 degrees (K213 manual 1.2)."""

RAYS_PER_PIXEL = 4
MARGIN = 10
"""Pixels beside the image from which blurred light comes, and largest half of the blur [pixels]."""

N_RAYS = (K213_PIXELS + 2 * MARGIN) * RAYS_PER_PIXEL
"""Number of rays."""

HALF = K213_PIXELS / 2
"""Half of the image [pixels]."""


class Eye(NamedTuple):
    """Place of a line camera.

    Attributes:
        x: Position [m].
        y: Position [m].
        height: Height above the floor [m].
        ahead: Cosine of its direction.
        left: Sine of its direction.
    """

    x: float
    y: float
    height: float
    ahead: float
    left: float


class LineScene(NamedTuple):
    """Surroundings of a line camera.

    Attributes:
        faces: Faces and cylinders, of which some count (n, N_COLUMNS).
        n_faces: Number of those that count (1,).
        lamps: Lamps: x, y, z [m] and power [W] (n_lamps, 4).
        room: Illuminance by the room's own light (1,) [lx].
        depths: Buffer for the depth on each ray (N_RAYS,) [m].
        lights: Buffer for the luminance on each ray (N_RAYS,) [cd/m^2].
        owners: Buffer for the face on each ray (N_RAYS,).
        lit: Buffer for the lamps that shine on a point (n_lamps,).
        sums: Buffer for the sums of light and of weights of each pixel (2, 64).
    """

    faces: Matrix
    n_faces: Vector[int]
    lamps: Matrix
    room: Vector[float]
    depths: Vector[float]
    lights: Vector[float]
    owners: Vector[int]
    lit: Vector[int]
    sums: Matrix


@compilable
def place_of_ray(ray: int) -> float:
    """Return the place of a ray in the image [pixels]."""
    return (ray + 0.5) / RAYS_PER_PIXEL - MARGIN


@compilable
def slope_of_ray(ray: int) -> float:
    """Return the tangent of a ray's direction, to the left."""
    return HALF_FIELD * (1 - place_of_ray(ray) / HALF)
