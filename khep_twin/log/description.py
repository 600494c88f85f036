"""The scene as URDF, from the compiled model: what viewers that do not know MuJoCo draw.

Each body becomes a link named as the body, with its shown geoms and sites as visuals; what stands still is
part of the link "world". Poses come from /tf, so the joints only say what hangs on what.
"""

import math
from collections.abc import Iterator
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

_FLOOR_THICKNESS = 0.002
_HIDDEN_GROUP = 3


def urdf(model: mujoco.MjModel) -> str:
    """The scene as URDF text; lengths in m, angles in rad."""
    robot = ElementTree.Element("robot", name=model.names[: model.names.index(b"\0")].decode() or "playpen")
    for body in range(model.nbody):
        name = body_name(model, body)
        link = ElementTree.SubElement(robot, "link", name=name)
        for visual in _visuals(model, body):
            link.append(visual)
        if body:
            joint = ElementTree.SubElement(robot, "joint", name=f"{name}_joint", type="floating")
            ElementTree.SubElement(joint, "parent", link="world")
            ElementTree.SubElement(joint, "child", link=name)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def body_name(model: mujoco.MjModel, body: int) -> str:
    """A body's name in links and frames."""
    return model.body(body).name


def _visuals(model: mujoco.MjModel, body: int) -> Iterator[ElementTree.Element]:
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        rgba = model.geom_rgba[geom]
        if rgba[3] > 0 and model.geom_group[geom] != _HIDDEN_GROUP:
            kind, position = int(model.geom_type[geom]), model.geom_pos[geom]
            yield _visual(
                model.geom(geom).name, kind, model.geom_size[geom], position, model.geom_quat[geom], rgba
            )
    for site in np.flatnonzero(model.site_bodyid == body).tolist():
        kind, position = int(model.site_type[site]), model.site_pos[site]
        rgba = model.site_rgba[site]
        yield _visual(
            model.site(site).name, kind, model.site_size[site], position, model.site_quat[site], rgba
        )


def _visual(
    name: str,
    kind: int,
    size: NDArray[np.float64],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    rgba: NDArray[np.float32],
) -> ElementTree.Element:
    visual = ElementTree.Element("visual", name=name)
    place = position.copy()
    shape: tuple[str, dict[str, str]]
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        place[2] -= _FLOOR_THICKNESS / 2
        shape = "box", {"size": _numbers([2 * size[0], 2 * size[1], _FLOOR_THICKNESS])}
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape = "box", {"size": _numbers(2 * size)}
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        shape = "cylinder", {"radius": _numbers([size[0]]), "length": _numbers([2 * size[1]])}
    else:
        shape = "sphere", {"radius": _numbers([size[0]])}
    ElementTree.SubElement(visual, "origin", xyz=_numbers(place), rpy=_numbers(_roll_pitch_yaw(quaternion)))
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), shape[0], shape[1])
    material = ElementTree.SubElement(visual, "material", name=f"{name}_colour")
    ElementTree.SubElement(material, "color", rgba=_numbers(rgba))
    return visual


def _numbers(values: NDArray[np.floating] | list[float]) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


def _roll_pitch_yaw(quaternion: NDArray[np.float64]) -> list[float]:
    """A rotation w, x, y, z as angles about the fixed axes x, y, z [rad], as URDF wants it."""
    w, x, y, z = quaternion.tolist()
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [roll, pitch, yaw]
