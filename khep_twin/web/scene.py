"""Scenes as the page draws them: the 3-D view, and turrets from above.

In the 3-D view lengths are in m and colours from 0 to 1, as in MuJoCo. Shapes of fixed bodies are in the
world frame, all others in the frame of their body. Outlines of turrets are in the frame of their robot.
"""

import math
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import TurretError
from khep_twin.world import World

_N_GROUPS = 3
"""Number of visible groups; those of collision shapes have higher numbers."""

_DIGITS = 5

Floats = NDArray[np.float32]
Points = NDArray[np.float64]

_TURNS = np.linspace(0, 2 * math.pi, 24, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_TURNS), np.sin(_TURNS), np.zeros(len(_TURNS))])
_BALL = np.vstack([_CIRCLE * math.cos(lat) + (0, 0, math.sin(lat)) for lat in np.linspace(-1.5, 1.5, 9)])
_CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


class DrawnScene:
    """Scene of a model as a page draws it.

    Args:
        model: Compiled model.
        data: State of the model, with its kinematics computed.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model = model
        self._data = data
        geoms, sites = (_visible_indices(model, kind) for kind in ("geom", "site"))
        bodies = [*model.geom_bodyid[geoms], *model.site_bodyid[sites]]
        self._moving = [body for body in sorted({*map(int, bodies)}) if _is_movable(model, body)]

    def describe(self) -> dict[str, object]:
        """Return shapes, lights and moving bodies, with their present poses."""
        model = self._model
        headlight = model.vis.headlight
        return {
            "bodies": [model.body(body).name for body in self._moving],
            "poses": self.poses(),
            "shapes": [*self._shapes("geom"), *self._shapes("site")],
            "meshes": [
                {"points": _round(vertices), "faces": faces.tolist()} for vertices, faces in _meshes(model)
            ],
            "lights": [
                {
                    "directional": bool(model.light_type[light] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
                    "at": _round(self._data.light_xpos[light]),
                    "direction": _round(self._data.light_xdir[light]),
                    "diffuse": _round(model.light_diffuse[light]),
                    "ambient": _round(model.light_ambient[light]),
                }
                for light in range(model.nlight)
                if model.light_active[light]
            ],
            "headlight": {"ambient": _round(headlight.ambient), "diffuse": _round(headlight.diffuse)},
        }

    def poses(self) -> list[list[float]]:
        """Return the present poses of the moving bodies: position [m] and quaternion, w first (n, 7)."""
        poses = np.hstack([self._data.xpos[self._moving], self._data.xquat[self._moving]])
        return poses.round(_DIGITS).tolist()

    def _shapes(self, kind: str) -> Iterator[dict[str, object]]:
        """Yield the visible shapes of a kind, "geom" or "site"."""
        model, data = self._model, self._data
        local = {key: getattr(model, f"{kind}_{key}") for key in ("bodyid", "type", "size", "pos", "quat")}
        world = {key: getattr(data, f"{kind}_{key}") for key in ("xpos", "xmat")}
        for index in _visible_indices(model, kind):
            body = int(local["bodyid"][index])
            quat = local["quat"][index]
            is_moving = body in self._moving
            if not is_moving:
                quat = np.zeros(4)
                mujoco.mju_mat2Quat(quat, world["xmat"][index])
            position = (local["pos"] if is_moving else world["xpos"])[index]
            yield {
                "name": model.geom(index).name if kind == "geom" else model.site(index).name,
                "kind": mujoco.mjtGeom(int(local["type"][index])).name.removeprefix("mjGEOM_").lower(),
                "size": _round(local["size"][index]),
                "body": self._moving.index(body) if is_moving else None,
                "pose": _round(np.array([*position, *quat])),
                "rgba": _round(_colour(model, kind, index)),
                "mesh": int(model.geom_dataid[index]) if kind == "geom" else -1,
            }


def compile_scene(spec: mujoco.MjSpec) -> DrawnScene:
    """Return the scene of a specification at its start."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return DrawnScene(model, data)


def _visible_indices(model: mujoco.MjModel, kind: str) -> list[int]:
    """Return the indices of the visible geoms or sites, by kind, that are not transparent."""
    groups = getattr(model, f"{kind}_group")
    return [
        index for index in range(len(groups)) if groups[index] < _N_GROUPS and _colour(model, kind, index)[3]
    ]


def _is_movable(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body can move: by a joint of it or of a parent, or as a mocap body."""
    return bool(model.body_weldid[body] or model.body_mocapid[model.body_rootid[body]] >= 0)


def _colour(model: mujoco.MjModel, kind: str, index: int) -> Floats:
    """Return the colour of the material, or without one that of the geom or site."""
    material = int(getattr(model, f"{kind}_matid")[index])
    return model.mat_rgba[material] if material >= 0 else getattr(model, f"{kind}_rgba")[index]


def _meshes(model: mujoco.MjModel) -> Iterator[tuple[Floats, NDArray[np.int32]]]:
    for mesh in range(model.nmesh):
        first_vertex, first_face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        yield (
            model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]],
            model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]],
        )


def _round(values: NDArray[np.floating]) -> list[float]:
    return np.asarray(values, np.float64).round(_DIGITS).tolist()


@cache
def start_parts(name: str) -> list[dict[str, object]]:
    """Return the parts of a turret in its start pose: corners [mm] and colour of each.

    Raises:
        TurretError: The turret's MJCF file cannot be compiled.
    """
    kind = installed_turrets()[name]
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
    """Parts of the turrets of a robot, in the order of `start_parts`, turret by turret."""

    def __init__(self, world: World, index: int) -> None:
        model, name = world.model, world.robots[index].name
        self._data = world.data
        self._base = world.robots[index].indices.base
        self._points = {
            geom: _points(model, geom)
            for turret in world.playpen.robots[index].turrets
            for geom in range(model.ngeom)
            if _belongs_to(model, geom, f"{name}/{turret}/")
        }

    def corners(self) -> list[list[list[float]]]:
        """Return the present corners of the parts [mm]."""
        position, rotation = self._data.xpos[self._base], self._data.xmat[self._base].reshape(3, 3)
        return _outlines(self._data, self._points, position, rotation)


def _belongs_to(model: mujoco.MjModel, geom: int, prefix: str) -> bool:
    body = model.body(int(model.geom_bodyid[geom]))
    return model.geom(geom).name.startswith(prefix) or body.name.startswith(prefix)


def _outlines(
    data: mujoco.MjData, points: Mapping[int, Points], position: Points, rotation: Points
) -> list[list[list[float]]]:
    """Return the convex outlines of geoms, projected along z of a frame [mm]."""
    outlines: list[list[list[float]]] = []
    for geom, local_points in points.items():
        points_3d = local_points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        projected_mm = ((points_3d - position) @ rotation)[:, :2] * 1e3
        outlines.append(_hull(projected_mm.round(2).tolist()))
    return outlines


def _hull(points: list[list[float]]) -> list[list[float]]:
    """Return the corners of the convex hull of points, counter-clockwise.

    For a box this takes a tenth of the time of SciPy's, which matters at 25 calls a second.
    """
    points = sorted(points)
    hull: list[list[float]] = []
    for sorted_points in (points, points[::-1]):
        half_hull: list[list[float]] = []
        for x, y in sorted_points:
            while len(half_hull) > 1:
                (x0, y0), (x1, y1) = half_hull[-2:]
                if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                    break
                half_hull.pop()
            half_hull.append([x, y])
        hull += half_hull[:-1]
    return hull


def _points(model: mujoco.MjModel, geom: int) -> Points:
    """Return points in the frame of a geom whose convex hull approximates it."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return np.vstack([_CIRCLE * size[0] + (0, 0, side * size[1]) for side in (-1, 1)])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.vstack([_BALL * size[0] + (0, 0, side * size[1]) for side in (-1, 1)])
    centre, half_size = np.split(model.geom_aabb[geom], 2)
    is_ball = kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    return centre + (_BALL if is_ball else _CUBE) * half_size
