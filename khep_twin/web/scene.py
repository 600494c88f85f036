"""Scenes as the page draws them: the 3-D view, and turrets from above.

In the 3-D view lengths are in m and colours from 0 to 1, as MuJoCo has them. Shapes of bodies that cannot
move are in the frame of the world, all others in the frame of their body. Outlines of turrets are in the
frame of their robot.
"""

import math
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import installed
from khep_twin.errors import TurretError
from khep_twin.world import World

_GROUPS = 3
"""Number of groups that are visible: those of collision shapes come after them."""

_DIGITS = 5

Floats = NDArray[np.float32]

Points = NDArray[np.float64]

_TURNS = np.linspace(0, 2 * math.pi, 24, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_TURNS), np.sin(_TURNS), np.zeros(len(_TURNS))])
_BALL = np.vstack([_CIRCLE * math.cos(up) + (0, 0, math.sin(up)) for up in np.linspace(-1.5, 1.5, 9)])
_CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


class DrawnScene:
    """Scene of a model as a page draws it.

    Args:
        model: Compiled model.
        data: State of the model, with its kinematics computed.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        owners = [*model.geom_bodyid[_visible(model, "geom")], *model.site_bodyid[_visible(model, "site")]]
        self._moving = [body for body in sorted({*map(int, owners)}) if _moves(model, body)]

    def described(self) -> dict[str, object]:
        """Return shapes, lights and moving bodies, with their present poses."""
        model = self._model
        head = model.vis.headlight
        return {
            "bodies": [model.body(body).name for body in self._moving],
            "poses": self.poses(),
            "shapes": [*self._shapes("geom"), *self._shapes("site")],
            "meshes": [
                {"points": _rounded(vertices), "faces": faces.tolist()} for vertices, faces in _meshes(model)
            ],
            "lights": [
                {
                    "directional": bool(model.light_type[light] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
                    "at": _rounded(self._data.light_xpos[light]),
                    "direction": _rounded(self._data.light_xdir[light]),
                    "diffuse": _rounded(model.light_diffuse[light]),
                    "ambient": _rounded(model.light_ambient[light]),
                }
                for light in range(model.nlight)
                if model.light_active[light]
            ],
            "headlight": {"ambient": _rounded(head.ambient), "diffuse": _rounded(head.diffuse)},
        }

    def poses(self) -> list[list[float]]:
        """Return the present poses of the moving bodies: position [m] and quaternion, w first (n, 7)."""
        at = np.hstack([self._data.xpos[self._moving], self._data.xquat[self._moving]])
        return at.round(_DIGITS).tolist()

    def _shapes(self, kind: str) -> Iterator[dict[str, object]]:
        """Yield the visible geoms or sites."""
        model, data = self._model, self._data
        of = {name: getattr(model, f"{kind}_{name}") for name in ("bodyid", "type", "size", "pos", "quat")}
        seen = {name: getattr(data, f"{kind}_{name}") for name in ("xpos", "xmat")}
        for index in _visible(model, kind):
            body, turned = int(of["bodyid"][index]), of["quat"][index]
            moves = body in self._moving
            if not moves:
                turned = np.zeros(4)
                mujoco.mju_mat2Quat(turned, seen["xmat"][index])
            yield {
                "name": model.geom(index).name if kind == "geom" else model.site(index).name,
                "kind": mujoco.mjtGeom(int(of["type"][index])).name.removeprefix("mjGEOM_").lower(),
                "size": _rounded(of["size"][index]),
                "body": self._moving.index(body) if moves else None,
                "pose": _rounded(np.array([*(of["pos"] if moves else seen["xpos"])[index], *turned])),
                "rgba": _rounded(_colour(model, kind, index)),
                "mesh": int(model.geom_dataid[index]) if kind == "geom" else -1,
            }


def compiled(spec: mujoco.MjSpec) -> DrawnScene:
    """Return the scene of a specification at its start."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return DrawnScene(model, data)


def _visible(model: mujoco.MjModel, kind: str) -> list[int]:
    """Return the geoms or sites of the visible groups that are not transparent."""
    groups = getattr(model, f"{kind}_group")
    return [
        index for index in range(len(groups)) if groups[index] < _GROUPS and _colour(model, kind, index)[3]
    ]


def _moves(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body can move: it has a joint somewhere above, or is placed by a program."""
    return bool(model.body_weldid[body] or model.body_mocapid[model.body_rootid[body]] >= 0)


def _colour(model: mujoco.MjModel, kind: str, index: int) -> Floats:
    """Return a colour: a material's, or its own."""
    material = int(getattr(model, f"{kind}_matid")[index])
    return model.mat_rgba[material] if material >= 0 else getattr(model, f"{kind}_rgba")[index]


def _meshes(model: mujoco.MjModel) -> Iterator[tuple[Floats, NDArray[np.int32]]]:
    for mesh in range(model.nmesh):
        vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        yield (
            model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
            model.mesh_face[face : face + model.mesh_facenum[mesh]],
        )


def _rounded(values: NDArray[np.floating]) -> list[float]:
    return np.asarray(values, np.float64).round(_DIGITS).tolist()


@cache
def at_start(name: str) -> list[dict[str, object]]:
    """Return the parts of a turret in its start pose, each with its corners [mm] and its colour.

    Raises:
        TurretError: The turret's scene cannot be compiled.
    """
    kind = installed()[name]
    if kind.scene is None:
        return []
    try:
        model = mujoco.MjModel.from_xml_path(str(kind.scene))
    except ValueError as error:
        raise TurretError(f"turret {name}: {Path(kind.scene).name} cannot be compiled: {error}") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rgb = (255 * model.geom_rgba[:, :3]).round().astype(int).tolist()
    points = {geom: _points(model, geom) for geom in range(model.ngeom)}
    outlines = _outlines(data, points, np.zeros(3), np.eye(3))
    return [{"points_mm": corners, "rgb": colour} for corners, colour in zip(outlines, rgb, strict=True)]


class TurretParts:
    """Parts of the turrets of a world's robot, in the order of `at_start`, turret by turret."""

    def __init__(self, world: World, index: int) -> None:
        model, name = world.model, world.robots[index].name
        self._data, self._base = world.data, world.robots[index].indices.base
        self._points = {
            geom: _points(model, geom)
            for turret in world.playpen.robots[index].turrets
            for geom in range(model.ngeom)
            if _owned(model, geom, f"{name}/{turret}/")
        }

    def corners(self) -> list[list[list[float]]]:
        """Return the present corners of the parts [mm]."""
        position, turned = self._data.xpos[self._base], self._data.xmat[self._base].reshape(3, 3)
        return _outlines(self._data, self._points, position, turned)


def _owned(model: mujoco.MjModel, geom: int, prefix: str) -> bool:
    owner = model.body(int(model.geom_bodyid[geom]))
    return model.geom(geom).name.startswith(prefix) or owner.name.startswith(prefix)


def _outlines(
    data: mujoco.MjData, points: Mapping[int, Points], position: Points, turned: Points
) -> list[list[list[float]]]:
    """Return the convex outlines of geoms with these points, along z of a frame [mm]."""
    found: list[list[list[float]]] = []
    for geom, local in points.items():
        at = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        flat = ((at - position) @ turned)[:, :2] * 1e3
        found.append(_hull(flat.round(2).tolist()))
    return found


def _hull(points: list[list[float]]) -> list[list[float]]:
    """Return the corners of the convex hull of points, counter-clockwise.

    For a box this takes a tenth of the time of SciPy's, which matters at 25 calls a second.
    """
    points = sorted(points)
    hull: list[list[float]] = []
    for ordered in (points, points[::-1]):
        half: list[list[float]] = []
        for x, y in ordered:
            while len(half) > 1:
                (x0, y0), (x1, y1) = half[-2:]
                if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                    break
                half.pop()
            half.append([x, y])
        hull += half[:-1]
    return hull


def _points(model: mujoco.MjModel, geom: int) -> Points:
    """Return points of a geom, in its own frame, whose convex hull approximates the geom."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return np.vstack([_CIRCLE * size[0] + (0, 0, side * size[1]) for side in (-1, 1)])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.vstack([_BALL * size[0] + (0, 0, side * size[1]) for side in (-1, 1)])
    centre, half = np.split(model.geom_aabb[geom], 2)
    is_ball = kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    return centre + (_BALL if is_ball else _CUBE) * half
