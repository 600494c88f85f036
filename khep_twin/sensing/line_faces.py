"""Faces around a line camera in MuJoCo's scene, for `line_image`.

Fixed geoms are read once, movable ones before each image. Boxes have four faces, and all round geoms are
cylinders. An object that has tipped over is replaced by the most similar upright box or cylinder, as for the
infrared sensors. Stripes are sites whose x axis points from their left to their right end; they cast no
shadows, as they lie on surfaces that do.
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
    CASTS_SHADOW,
    END_X,
    END_Y,
    GLOW,
    N_COLUMNS,
    RADIUS,
    REFLECTANCE,
    ROLE,
    SAME_ROBOT,
    TOP,
    VISIBLE,
    Eye,
    LineScene,
    X,
    Y,
)
from khep_twin.sensing.mujoco_scene import fixed_shape, upright_shape, visible_geoms
from khep_twin.sensing.seen_surfaces import Upright
from khep_twin.units import BULB_RADIUS

STRIPE = "stripe"
"""First part of the names of stripes."""

BOX_FACES = 4

Floats = NDArray[np.float64]

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


class MovingFaces(NamedTuple):
    """Movable geoms and stripes of a scene, as arrays of MuJoCo.

    Attributes:
        geoms: Indices of geoms (n,).
        geom_types: Their types (n,).
        sizes: Their sizes (n, 3) [m].
        reflectances: Parts of the light that they reflect (n,).
        roles: Their roles (n,).
        stripes: Indices of sites (m,).
        stripe_sizes: Their sizes (m, 3) [m].
        stripe_reflectances: Parts of the light that they reflect (m,).
    """

    geoms: Vector[int]
    geom_types: Vector[int]
    sizes: Matrix
    reflectances: Vector[float]
    roles: Vector[int]
    stripes: Vector[int]
    stripe_sizes: Matrix
    stripe_reflectances: Vector[float]


class FacePoses(NamedTuple):
    """Current positions and orientations in a scene.

    Attributes:
        geom_positions: Positions of all geoms (n, 3) [m].
        geom_rotations: Their rotation matrices (n, 9).
        site_positions: Positions of all sites (m, 3) [m].
        site_rotations: Their rotation matrices (m, 9).
    """

    geom_positions: Matrix
    geom_rotations: Matrix
    site_positions: Matrix
    site_rotations: Matrix


def luminous_reflectance(rgb: Sequence[float]) -> float:
    """Return the part of white light that an sRGB colour, 0 to 1, reflects: its relative luminance."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in rgb]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def fixed_faces(model: mujoco.MjModel) -> Floats:
    """Return the fixed faces of a scene (n, N_COLUMNS)."""
    rows: list[Floats] = []
    for geom in visible_geoms(model):
        shape = fixed_shape(model, geom)
        if shape is not None:
            rows.append(upright_faces(shape, luminous_reflectance(model.geom_rgba[geom, :3].tolist())))
    for site in _stripes(model):
        if model.site_bodyid[site] == 0:
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.site_quat[site])
            row, size = np.zeros((1, N_COLUMNS)), model.site_size[site].tolist()
            grey = luminous_reflectance(model.site_rgba[site, :3].tolist())
            set_stripe(row, 0, model.site_pos[site].tolist(), rotation.tolist(), size, grey)
            rows.append(row)
    return np.concatenate([np.zeros((0, N_COLUMNS)), *rows])


def upright_faces(shape: Upright, reflectance: float) -> Floats:
    """Return the faces of an upright box or cylinder (n, N_COLUMNS)."""
    rows = np.zeros((BOX_FACES, N_COLUMNS))
    return rows[: set_upright(rows, 0, shape, reflectance, VISIBLE | CASTS_SHADOW)]


def moving_faces(model: mujoco.MjModel, base: int) -> MovingFaces:
    """Return the movable geoms and stripes of a scene, for a camera on the robot with the body `base`."""
    geoms = np.array([geom for geom in visible_geoms(model) if model.geom_bodyid[geom] != 0], np.int64)
    stripes = np.array([site for site in _stripes(model) if model.site_bodyid[site] != 0], np.int64)
    roots = model.body_rootid[model.geom_bodyid[geoms]]
    return MovingFaces(
        geoms,
        model.geom_type[geoms].astype(np.int64),
        model.geom_size[geoms],
        np.array([luminous_reflectance(rgb) for rgb in model.geom_rgba[geoms, :3].tolist()]),
        (CASTS_SHADOW | np.where(roots == model.body_rootid[base], SAME_ROBOT, VISIBLE)).astype(np.int64),
        stripes,
        model.site_size[stripes],
        np.array([luminous_reflectance(rgb) for rgb in model.site_rgba[stripes, :3].tolist()]),
    )


def read_poses(data: mujoco.MjData) -> FacePoses:
    """Return positions and orientations of a scene, in the arrays that MuJoCo updates."""
    return FacePoses(data.geom_xpos, data.geom_xmat, data.site_xpos, data.site_xmat)


def max_faces(moving: MovingFaces, n_fixed: int, n_lamps: int) -> int:
    """Return the largest number of faces in a scene."""
    return n_fixed + BOX_FACES * len(moving.geoms) + len(moving.stripes) + n_lamps


@compilable
def place_faces(scene: LineScene, n_fixed: int, moving: MovingFaces, poses: FacePoses, eye: Eye) -> None:
    """Set the faces of movable geoms, stripes and lamps that are on, in the rows after the fixed faces.

    Args:
        scene: Surroundings of the camera.
        n_fixed: Number of fixed faces.
        moving: Movable geoms and stripes.
        poses: Current positions and orientations.
        eye: Pose of the camera.
    """
    faces, lamps, count, is_any_lamp_on = scene.faces, scene.lamps, n_fixed, False
    for lamp in range(len(lamps)):
        dz = lamps[lamp, 2] - eye.height
        square = BULB_RADIUS * BULB_RADIUS - dz * dz
        is_any_lamp_on = is_any_lamp_on or lamps[lamp, 3] > 0
        if lamps[lamp, 3] > 0 and square > 0:
            direction, span = (1.0, 0.0), (lamps[lamp, 2] - BULB_RADIUS, lamps[lamp, 2] + BULB_RADIUS)
            shape = (lamps[lamp, 0], lamps[lamp, 1]), direction, (math.sqrt(square), -1.0), span
            count = set_upright(faces, count, shape, 0.0, VISIBLE)
            faces[count - 1, GLOW] = BULB_LUMINANCE * lamps[lamp, 3]
    for i in range(len(moving.geoms)):
        geom, role = moving.geoms[i], moving.roles[i]
        if role & VISIBLE == 0 and not is_any_lamp_on:
            continue
        size = moving.sizes[i, 0], moving.sizes[i, 1], moving.sizes[i, 2]
        position, rotation = _vector(poses.geom_positions, geom), _matrix(poses.geom_rotations, geom)
        shape = upright_shape(moving.geom_types[i], size, position, rotation)
        if is_any_lamp_on or shape[3][0] <= eye.height <= shape[3][1]:
            count = set_upright(faces, count, shape, moving.reflectances[i], role)
    for i in range(len(moving.stripes)):
        site = moving.stripes[i]
        size = moving.stripe_sizes[i, 0], moving.stripe_sizes[i, 1], moving.stripe_sizes[i, 2]
        position, rotation = _vector(poses.site_positions, site), _matrix(poses.site_rotations, site)
        count = set_stripe(faces, count, position, rotation, size, moving.stripe_reflectances[i])
    scene.n_faces[0] = count


@compilable
def set_upright(faces: Matrix, count: int, shape: Upright, reflectance: float, role: int) -> int:
    """Add the faces of an upright box or cylinder; return the number of faces."""
    (x, y), (c, s), (half, width), span = shape
    if width < 0:
        _set_face(faces, count, (x, y, 0.0, 0.0, half), span, reflectance, role)
        return count + 1
    # Counter-clockwise, so that a face starts at its left end as seen from outside.
    for face in range(BOX_FACES):
        along, across, end_along, end_across = half, -width, half, width
        if face == 1:
            along, across, end_along, end_across = half, width, -half, width
        elif face == 2:
            along, across, end_along, end_across = -half, width, -half, -width
        elif face == 3:
            along, across, end_along, end_across = -half, -width, half, -width
        start = x + c * along - s * across, y + s * along + c * across
        end = x + c * end_along - s * end_across, y + s * end_along + c * end_across
        _set_face(faces, count + face, (start[0], start[1], end[0], end[1], 0.0), span, reflectance, role)
    return count + BOX_FACES


@compilable
def set_stripe(
    faces: Matrix,
    count: int,
    position: Sequence[float],
    rotation: Sequence[float],
    size: Sequence[float],
    reflectance: float,
) -> int:
    """Add a stripe; return the number of faces.

    Args:
        faces: Faces, changed in place.
        count: Number of faces.
        position: Position of its centre (3,) [m].
        rotation: Rotation matrix (9,).
        size: Halves of its width, thickness and height (3,) [m].
        reflectance: Part of the light that it reflects.
    """
    x, y, dx, dy = position[0], position[1], rotation[0] * size[0], rotation[3] * size[0]
    ends, span = (x - dx, y - dy, x + dx, y + dy, 0.0), (position[2] - size[2], position[2] + size[2])
    _set_face(faces, count, ends, span, reflectance, VISIBLE)
    return count + 1


@compilable
def _set_face(
    faces: Matrix,
    row: int,
    outline: tuple[float, float, float, float, float],
    span: tuple[float, float],
    reflectance: float,
    role: int,
) -> None:
    """Set a face: its two ends, or its centre and two zeros; its radius [m]; its lower and upper edge [m]."""
    faces[row, X], faces[row, Y] = outline[0], outline[1]
    faces[row, END_X], faces[row, END_Y] = outline[2], outline[3]
    faces[row, RADIUS], faces[row, BOTTOM], faces[row, TOP] = outline[4], span[0], span[1]
    faces[row, REFLECTANCE], faces[row, GLOW], faces[row, ROLE] = reflectance, 0.0, float(role)


@compilable
def _vector(array: Matrix, row: int) -> tuple[float, float, float]:
    return array[row, 0], array[row, 1], array[row, 2]


@compilable
def _matrix(array: Matrix, row: int) -> tuple[float, float, float, float, float, float, float, float, float]:
    first_row = array[row, 0], array[row, 1], array[row, 2]
    second_row = array[row, 3], array[row, 4], array[row, 5]
    return first_row + second_row + (array[row, 6], array[row, 7], array[row, 8])


def _stripes(model: mujoco.MjModel) -> list[int]:
    """Return the sites that are stripes."""
    names = ((site, str(model.site(site).name)) for site in range(model.nsite))
    return [site for site, name in names if name.startswith(STRIPE)]
