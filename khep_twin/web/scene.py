"""Compiled scenes for the page's 3-D view: their visible shapes and lights, and the poses of what moves.

Lengths are in m and colours from 0 to 1, as MuJoCo has them. Shapes of bodies that cannot move are in the
frame of the world, all others in the frame of their body.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

_GROUPS = 3
"""Number of groups that are visible: those of collision shapes come after them."""

_DIGITS = 5

Floats = NDArray[np.float32]


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
