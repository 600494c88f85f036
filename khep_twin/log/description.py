"""URDF of the scene, from the compiled model: geometry for viewers that do not read MJCF.

Each body becomes a link named like its frame, with its visible geoms and sites as visuals; fixed bodies are
part of the link "map". Poses come from /tf, so the joints only connect the links; `ros.robot_description` has
real ones.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import MAP
from khep_twin.log.frames import frame_name

Kind = Literal["box", "sphere", "cylinder", "capsule"]

_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX = 0, 2, 3, 5, 6
_KINDS: dict[int, Kind] = {
    _PLANE: "box",
    _SPHERE: "sphere",
    _CAPSULE: "capsule",
    _CYLINDER: "cylinder",
    _BOX: "box",
}
"""Shape names of the kinds of `mujoco.mjtGeom` that are drawn; ellipsoids and meshes are left out."""

_PLANE_THICKNESS = 0.0002  # [m]
_INFINITE_PLANE_SIZE = 10.0  # [m]
_HIDDEN_GROUP = 3  # of geoms that only have contacts


@dataclass(frozen=True, slots=True)
class Shape:
    """A drawn geom or site of a body.

    Attributes:
        name: Name of the geom or site.
        kind: Kind of shape; round ones have their axis along z.
        size: Size along x, y and z [m]; for a capsule, z is without its ends.
        position: Position in the body's frame (3,) [m].
        quaternion: Rotation in the body's frame, w, x, y, z (4,).
        rgba: Colour (4,) [0 to 1].
    """

    name: str
    kind: Kind
    size: tuple[float, float, float]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    rgba: NDArray[np.float32]


def urdf(model: mujoco.MjModel) -> str:
    """Return the scene as URDF text; lengths in m, angles in rad."""
    robot = ElementTree.Element("robot", name=model.names[: model.names.index(b"\0")].decode() or "playpen")
    for body in range(model.nbody):
        name = frame_name(model, body)
        link = ElementTree.SubElement(robot, "link", name=name)
        link.extend(map(visual, shapes(model, body)))
        if body:
            joint = ElementTree.SubElement(robot, "joint", name=f"{name}_joint", type="floating")
            ElementTree.SubElement(joint, "parent", link=MAP)
            ElementTree.SubElement(joint, "child", link=name)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def shapes(model: mujoco.MjModel, body: int) -> Iterator[Shape]:
    """Yield the drawn shapes of a body, without transparent, contact-only and unsupported ones."""
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        if model.geom_group[geom] != _HIDDEN_GROUP:
            name = model.geom(geom).name or f"geom{geom}"
            pose = model.geom_pos[geom], model.geom_quat[geom]
            geom_type, size = int(model.geom_type[geom]), model.geom_size[geom].tolist()
            yield from _shape(name, geom_type, size, *pose, model.geom_rgba[geom])
    for site in np.flatnonzero(model.site_bodyid == body).tolist():
        name = model.site(site).name or f"site{site}"
        pose = model.site_pos[site], model.site_quat[site]
        geom_type, size = int(model.site_type[site]), model.site_size[site].tolist()
        yield from _shape(name, geom_type, size, *pose, model.site_rgba[site])


def led_positions(model: mujoco.MjModel, robot: str) -> NDArray[np.float64]:
    """Return the positions of a robot's LEDs in its frame (n, 3) [m]."""
    bodies = {model.body(index).name for index in range(model.nbody)}
    sites = [model.site(index) for index in range(model.nsite)]
    is_led = [site.name.startswith(f"{robot}/") and f"{site.name}_light" in bodies for site in sites]
    return model.site_pos[is_led]


def collision_shapes(model: mujoco.MjModel, body: int) -> Iterator[Shape]:
    """Yield the shapes of a body that only have contacts."""
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == _HIDDEN_GROUP)).tolist():
        name = model.geom(geom).name or f"geom{geom}"
        pose = model.geom_pos[geom], model.geom_quat[geom]
        geom_type, size = int(model.geom_type[geom]), model.geom_size[geom].tolist()
        yield from _shape(name, geom_type, size, *pose, np.ones(4, np.float32))


def _shape(
    name: str,
    geom_type: int,
    half_sizes: list[float],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    rgba: NDArray[np.float32],
) -> Iterator[Shape]:
    """Yield a shape of MuJoCo, which stores half sizes; nothing for one that is invisible or not drawn."""
    if rgba[3] <= 0 or geom_type not in _KINDS:
        return
    if geom_type == _PLANE:
        # Size 0 is an infinite plane.
        length, width = (2 * half or _INFINITE_PLANE_SIZE for half in half_sizes[:2])
        size = length, width, _PLANE_THICKNESS
    elif geom_type == _BOX:
        size = 2 * half_sizes[0], 2 * half_sizes[1], 2 * half_sizes[2]
    else:
        height = half_sizes[0] if geom_type == _SPHERE else half_sizes[1]
        size = 2 * half_sizes[0], 2 * half_sizes[0], 2 * height
    yield Shape(name, _KINDS[geom_type], size, position, quaternion, rgba)


def geometry(shape: Shape) -> ElementTree.Element:
    """Return a shape as a URDF geometry."""
    if shape.kind == "box":
        return ElementTree.Element("box", size=join_numbers(shape.size))
    radius = join_numbers([shape.size[0] / 2])
    if shape.kind == "sphere":
        return ElementTree.Element("sphere", radius=radius)
    return ElementTree.Element(shape.kind, radius=radius, length=join_numbers([shape.size[2]]))


def visual(shape: Shape) -> ElementTree.Element:
    """Return a shape with its colour as a URDF visual."""
    element = ElementTree.Element("visual", name=shape.name)
    element.append(origin(shape.position, shape.quaternion))
    ElementTree.SubElement(element, "geometry").append(geometry(shape))
    material = ElementTree.SubElement(element, "material", name=f"{shape.name}_colour")
    ElementTree.SubElement(material, "color", rgba=join_numbers(shape.rgba.tolist()))
    return element


def origin(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> ElementTree.Element:
    """Return a pose as URDF: position [m] and rotation w, x, y, z."""
    angles = _roll_pitch_yaw(quaternion)
    return ElementTree.Element("origin", xyz=join_numbers(position.tolist()), rpy=join_numbers(angles))


def join_numbers(values: Sequence[float]) -> str:
    """Return numbers in the form of an attribute."""
    return " ".join(f"{value:.9g}" for value in values)


def _roll_pitch_yaw(quaternion: NDArray[np.float64]) -> list[float]:
    """Return a rotation w, x, y, z as angles about the fixed axes x, y, z [rad], as in URDF."""
    w, x, y, z = quaternion.tolist()
    sine = 2 * (w * y - z * x)
    if abs(sine) > 1 - 1e-12:  # gimbal lock: roll and yaw turn about the same axis
        return [0.0, math.copysign(math.pi / 2, sine), -2 * math.copysign(1.0, sine) * math.atan2(x, w)]
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(sine)
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [roll, pitch, yaw]
