"""Faces around a line camera in MuJoCo's scene, for `line_image`.

What cannot move is read once, what can move before each image. Boxes have four faces, all that is round is
a cylinder, and what has tipped over is the upright box or cylinder that it resembles, as for the infrared
sensors. Stripes are sites whose first axis runs from their left to their right; they cast no shadows, as
they lie on what does.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector
from khep_twin.sensing.line_light import BULB_LUMINANCE
from khep_twin.sensing.line_scene import (
    BOTTOM,
    CASTS,
    END_X,
    END_Y,
    GLOW,
    N_COLUMNS,
    OWN,
    RADIUS,
    REFLECTANCE,
    ROLE,
    SEEN,
    TOP,
    Eye,
    LineScene,
    X,
    Y,
)
from khep_twin.sensing.mujoco_scene import fixed, upright, visible
from khep_twin.sensing.seen_surfaces import Upright
from khep_twin.units import BULB_RADIUS

STRIPE = "stripe"
"""First part of the names of stripes."""

FACES_OF_A_BOX = 4

Floats = NDArray[np.float64]

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


class MovingFaces(NamedTuple):
    """Movable geoms of a scene, as the arrays of MuJoCo that `set_out` reads.

    Attributes:
        geoms: Indices of geoms (n,).
        kinds: Their types (n,).
        sizes: Their sizes (n, 3) [m].
        reflectances: Parts of the light that they reflect (n,).
        roles: Their roles (n,).
        stripes: Indices of sites (m,).
        stripe_sizes: Their sizes (m, 3) [m].
        stripe_reflectances: Parts of the light that they reflect (m,).
    """

    geoms: Vector[int]
    kinds: Vector[int]
    sizes: Matrix
    reflectances: Vector[float]
    roles: Vector[int]
    stripes: Vector[int]
    stripe_sizes: Matrix
    stripe_reflectances: Vector[float]


class Places(NamedTuple):
    """Present positions and orientations in a scene.

    Attributes:
        geoms: Positions of all geoms (n, 3) [m].
        geom_turns: Their orientations (n, 9).
        sites: Positions of all sites (m, 3) [m].
        site_turns: Their orientations (m, 9).
    """

    geoms: Matrix
    geom_turns: Matrix
    sites: Matrix
    site_turns: Matrix


def luminous_reflectance(rgb: Sequence[float]) -> float:
    """Return the part of white light that a colour reflects: its relative luminance in sRGB.

    Args:
        rgb: Red, green and blue, 0 to 1, as a screen shows them.
    """
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in rgb]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def fixed_faces(model: mujoco.MjModel) -> Floats:
    """Return the faces of a scene that cannot move (n, N_COLUMNS)."""
    rows: list[Floats] = []
    for geom in visible(model):
        shape = fixed(model, geom)
        if shape is not None:
            rows.append(faces_of(shape, luminous_reflectance(model.geom_rgba[geom, :3].tolist())))
    for site in _stripes(model):
        if model.site_bodyid[site] == 0:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.site_quat[site])
            row, size = np.zeros((1, N_COLUMNS)), model.site_size[site].tolist()
            grey = luminous_reflectance(model.site_rgba[site, :3].tolist())
            set_stripe(row, 0, model.site_pos[site].tolist(), turn.tolist(), size, grey)
            rows.append(row)
    return np.concatenate([np.zeros((0, N_COLUMNS)), *rows])


def faces_of(shape: Upright, reflectance: float) -> Floats:
    """Return the faces of an upright box or cylinder (n, N_COLUMNS)."""
    rows = np.zeros((FACES_OF_A_BOX, N_COLUMNS))
    return rows[: set_upright(rows, 0, shape, reflectance, SEEN | CASTS)]


def moving_faces(model: mujoco.MjModel, base: int) -> MovingFaces:
    """Return what can move in a scene, as seen from the robot with this body."""
    geoms = np.array([geom for geom in visible(model) if model.geom_bodyid[geom] != 0], np.int64)
    stripes = np.array([site for site in _stripes(model) if model.site_bodyid[site] != 0], np.int64)
    roots = model.body_rootid[model.geom_bodyid[geoms]]
    return MovingFaces(
        geoms,
        model.geom_type[geoms].astype(np.int64),
        model.geom_size[geoms],
        np.array([luminous_reflectance(rgb) for rgb in model.geom_rgba[geoms, :3].tolist()]),
        np.where(roots == model.body_rootid[base], CASTS | OWN, SEEN | CASTS).astype(np.int64),
        stripes,
        model.site_size[stripes],
        np.array([luminous_reflectance(rgb) for rgb in model.site_rgba[stripes, :3].tolist()]),
    )


def places(data: mujoco.MjData) -> Places:
    """Return positions and orientations of a scene, live."""
    return Places(data.geom_xpos, data.geom_xmat, data.site_xpos, data.site_xmat)


def most_faces(moving: MovingFaces, n_fixed: int, n_lamps: int) -> int:
    """Return the largest number of faces in a scene."""
    return n_fixed + FACES_OF_A_BOX * len(moving.geoms) + len(moving.stripes) + n_lamps


@compilable
def set_out(scene: LineScene, n_fixed: int, moving: MovingFaces, at: Places, eye: Eye) -> None:
    """Set the faces of what can move, and of the lamps that are on, behind the fixed ones.

    Args:
        scene: Surroundings of the camera.
        n_fixed: Number of fixed faces.
        moving: What can move.
        at: Present positions.
        eye: Place of the camera.
    """
    faces, lamps, count, lit = scene.faces, scene.lamps, n_fixed, False
    for lamp in range(len(lamps)):
        aside = lamps[lamp, 2] - eye.height
        square = BULB_RADIUS * BULB_RADIUS - aside * aside
        lit = lit or lamps[lamp, 3] > 0
        if lamps[lamp, 3] > 0 and square > 0:
            turn, span = (1.0, 0.0), (lamps[lamp, 2] - BULB_RADIUS, lamps[lamp, 2] + BULB_RADIUS)
            shape = (lamps[lamp, 0], lamps[lamp, 1]), turn, (math.sqrt(square), -1.0), span
            count = set_upright(faces, count, shape, 0.0, SEEN)
            faces[count - 1, GLOW] = BULB_LUMINANCE * lamps[lamp, 3]
    for i in range(len(moving.geoms)):
        geom, role = moving.geoms[i], moving.roles[i]
        if role & SEEN == 0 and not lit:
            continue
        size = moving.sizes[i, 0], moving.sizes[i, 1], moving.sizes[i, 2]
        shape = upright(moving.kinds[i], size, _three(at.geoms, geom), _nine(at.geom_turns, geom))
        if lit or shape[3][0] <= eye.height <= shape[3][1]:
            count = set_upright(faces, count, shape, moving.reflectances[i], role)
    for i in range(len(moving.stripes)):
        site = moving.stripes[i]
        size = moving.stripe_sizes[i, 0], moving.stripe_sizes[i, 1], moving.stripe_sizes[i, 2]
        place, turn = _three(at.sites, site), _nine(at.site_turns, site)
        count = set_stripe(faces, count, place, turn, size, moving.stripe_reflectances[i])
    scene.n_faces[0] = count


@compilable
def set_upright(faces: Matrix, count: int, shape: Upright, reflectance: float, role: int) -> int:
    """Add the faces of an upright box or cylinder; return the number of faces."""
    (x, y), (c, s), (half, width), span = shape
    if width < 0:
        _set(faces, count, (x, y, 0.0, 0.0, half), span, reflectance, role)
        return count + 1
    # Counter-clockwise, which is from the left to the right for who looks at a face.
    for face in range(FACES_OF_A_BOX):
        along, across, end_along, end_across = half, -width, half, width
        if face == 1:
            along, across, end_along, end_across = half, width, -half, width
        elif face == 2:
            along, across, end_along, end_across = -half, width, -half, -width
        elif face == 3:
            along, across, end_along, end_across = -half, -width, half, -width
        start = x + c * along - s * across, y + s * along + c * across
        end = x + c * end_along - s * end_across, y + s * end_along + c * end_across
        _set(faces, count + face, (start[0], start[1], end[0], end[1], 0.0), span, reflectance, role)
    return count + FACES_OF_A_BOX


@compilable
def set_stripe(
    faces: Matrix,
    count: int,
    place: Sequence[float],
    turn: Sequence[float],
    size: Sequence[float],
    reflectance: float,
) -> int:
    """Add a stripe; return the number of faces.

    Args:
        faces: Faces, changed in place.
        count: Number of faces.
        place: Position of its middle (3,) [m].
        turn: Orientation (9,).
        size: Halves of its width, thickness and height (3,) [m].
        reflectance: Part of the light that it reflects.
    """
    x, y, dx, dy = place[0], place[1], turn[0] * size[0], turn[3] * size[0]
    ends, span = (x - dx, y - dy, x + dx, y + dy, 0.0), (place[2] - size[2], place[2] + size[2])
    _set(faces, count, ends, span, reflectance, SEEN)
    return count + 1


@compilable
def _set(
    faces: Matrix,
    row: int,
    plan: tuple[float, float, float, float, float],
    span: tuple[float, float],
    reflectance: float,
    role: int,
) -> None:
    """Set a face: its ends, or its centre and two numbers, and its radius [m]; its span of heights [m]."""
    faces[row, X], faces[row, Y], faces[row, END_X], faces[row, END_Y] = plan[0], plan[1], plan[2], plan[3]
    faces[row, RADIUS], faces[row, BOTTOM], faces[row, TOP] = plan[4], span[0], span[1]
    faces[row, REFLECTANCE], faces[row, GLOW], faces[row, ROLE] = reflectance, 0.0, float(role)


@compilable
def _three(array: Matrix, row: int) -> tuple[float, float, float]:
    return array[row, 0], array[row, 1], array[row, 2]


@compilable
def _nine(array: Matrix, row: int) -> tuple[float, float, float, float, float, float, float, float, float]:
    first = array[row, 0], array[row, 1], array[row, 2]
    second = array[row, 3], array[row, 4], array[row, 5]
    return first + second + (array[row, 6], array[row, 7], array[row, 8])


def _stripes(model: mujoco.MjModel) -> list[int]:
    """Return the sites that are stripes."""
    names = ((site, str(model.site(site).name)) for site in range(model.nsite))
    return [site for site, name in names if name.startswith(STRIPE)]
