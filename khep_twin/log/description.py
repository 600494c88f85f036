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

_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX = 0, 2, 3, 5, 6
"""Kinds of `mujoco.mjtGeom` that are drawn; ellipsoids and meshes are left out."""

_PLANE_THICKNESS = 0.0002
_ENDLESS_SIZE = 10.0
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
    return model.body(body).name or f"body{body}"


def _visuals(model: mujoco.MjModel, body: int) -> Iterator[ElementTree.Element]:
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        rgba = model.geom_rgba[geom]
        shape = _shape(int(model.geom_type[geom]), model.geom_size[geom].tolist())
        if shape is not None and rgba[3] > 0 and model.geom_group[geom] != _HIDDEN_GROUP:
            name = model.geom(geom).name or f"geom{geom}"
            yield _visual(name, shape, model.geom_pos[geom], model.geom_quat[geom], rgba)
    for site in np.flatnonzero(model.site_bodyid == body).tolist():
        rgba = model.site_rgba[site]
        shape = _shape(int(model.site_type[site]), model.site_size[site].tolist())
        if shape is not None and rgba[3] > 0:
            name = model.site(site).name or f"site{site}"
            yield _visual(name, shape, model.site_pos[site], model.site_quat[site], rgba)


def _shape(kind: int, size: list[float]) -> ElementTree.Element | None:
    """A shape of MuJoCo, which counts half sizes, as URDF has it; None for one that URDF lacks."""
    if kind == _PLANE:
        # Size 0 is a plane that never ends.
        length, width = (2 * half or _ENDLESS_SIZE for half in size[:2])
        return ElementTree.Element("box", size=_numbers([length, width, _PLANE_THICKNESS]))
    if kind == _BOX:
        return ElementTree.Element("box", size=_numbers([2 * half for half in size]))
    if kind in (_CYLINDER, _CAPSULE):
        name = "cylinder" if kind == _CYLINDER else "capsule"
        return ElementTree.Element(name, radius=_numbers(size[:1]), length=_numbers([2 * size[1]]))
    if kind == _SPHERE:
        return ElementTree.Element("sphere", radius=_numbers(size[:1]))
    return None


def _visual(
    name: str,
    shape: ElementTree.Element,
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    rgba: NDArray[np.float32],
) -> ElementTree.Element:
    visual = ElementTree.Element("visual", name=name)
    ElementTree.SubElement(
        visual, "origin", xyz=_numbers(position.tolist()), rpy=_numbers(_roll_pitch_yaw(quaternion))
    )
    ElementTree.SubElement(visual, "geometry").append(shape)
    material = ElementTree.SubElement(visual, "material", name=f"{name}_colour")
    ElementTree.SubElement(material, "color", rgba=_numbers(rgba.tolist()))
    return visual


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _roll_pitch_yaw(quaternion: NDArray[np.float64]) -> list[float]:
    """A rotation w, x, y, z as angles about the fixed axes x, y, z [rad], as URDF wants it."""
    w, x, y, z = quaternion.tolist()
    sine = 2 * (w * y - z * x)
    if abs(sine) > 1 - 1e-12:  # straight up or down, where roll and yaw turn about the same axis
        return [0.0, math.copysign(math.pi / 2, sine), -2 * math.copysign(1.0, sine) * math.atan2(x, w)]
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(sine)
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [roll, pitch, yaw]
