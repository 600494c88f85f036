"""URDF with real joints, for tools that move a robot by its joints, like RViz and robot_state_publisher.

Links are the frames of /tf, and a link's joint has its name with "_joint": wheels turn without limits, parts
of turrets have limits, sensors are fixed. Bodies that move freely have floating joints; a robot's joint is
with the frame of its odometry. A robot alone has no map, and its link base_link is the root.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

from collections.abc import Iterable
from xml.etree import ElementTree

import mujoco
import numpy as np

from khep_twin.log.channels import BASE_FRAME, MAP
from khep_twin.log.description import collision_shapes, geometry, join_numbers, origin, shapes, visual
from khep_twin.log.frames import frame_name
from khep_twin.ros.standard import ODOM_FRAME

StaticTransform = tuple[str, str, tuple[float, ...]]
"""Parent, name and pose of a frame: x, y, z [m] and quaternion x, y, z, w."""

_BASE_END = BASE_FRAME.format("")
"""End of the name of a robot's frame."""

_KINDS = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}


def robot_description(
    model: mujoco.MjModel, sensors: Iterable[StaticTransform], robot: str | None = None
) -> str:
    """Return a scene as URDF with joints; lengths in m, angles in rad, masses in kg.

    Args:
        model: Compiled scene.
        sensors: Frames of sensors.
        robot: Name of the robot to describe alone, with its sensors; None for the whole scene.
    """
    name = robot or model.names[: model.names.index(b"\0")].decode() or "playpen"
    root = ElementTree.Element("robot", name=name)
    links: set[str] = set()
    for body in range(model.nbody):
        link_name = frame_name(model, body)
        if robot is not None and not link_name.startswith(f"{robot}/"):
            continue
        link = ElementTree.SubElement(root, "link", name=link_name)
        link.extend(map(visual, shapes(model, body)))
        for shape in collision_shapes(model, body):
            collision = ElementTree.SubElement(link, "collision", name=shape.name)
            collision.append(origin(shape.position, shape.quaternion))
            ElementTree.SubElement(collision, "geometry").append(geometry(shape))
        if body and model.body_mass[body] > 0:
            link.append(_inertial(model, body))
        joint = _joint(model, body) if links else None
        if joint is not None and link_name.endswith(_BASE_END):
            odom = ODOM_FRAME.format(link_name.removesuffix(_BASE_END))
            ElementTree.SubElement(root, "link", name=odom)
            root.append(_connect("floating", MAP, odom))
            joint = _connect("floating", odom, link_name)
        if joint is not None:
            root.append(joint)
        links.add(link_name)
    for parent, child, (x, y, z, *rotation) in sensors:
        if parent in links:
            ElementTree.SubElement(root, "link", name=child)
            joint = _connect("fixed", parent, child)
            joint.append(origin(np.array([x, y, z]), np.array([rotation[3], *rotation[:3]])))
            root.append(joint)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def redraw(description: str, scene: str) -> str:
    """Return a description with the shapes of a later URDF of its scene, and without collisions.

    Raises:
        ParseError: The later text is no XML.
    """
    root = ElementTree.fromstring(description)
    links = {link.get("name"): link for link in ElementTree.fromstring(scene).iterfind("link")}
    for link in root.iterfind("link"):
        for element in (*link.findall("visual"), *link.findall("collision")):
            link.remove(element)
        link.extend(links.get(link.get("name"), link).findall("visual"))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _joint(model: mujoco.MjModel, body: int) -> ElementTree.Element:
    """Return the joint of a body with its parent, or with the map, where it moves freely."""
    child, parent = frame_name(model, body), frame_name(model, int(model.body_parentid[body]))
    n_joints, index = int(model.body_jntnum[body]), int(model.body_jntadr[body])
    kind = "fixed" if not n_joints else _KINDS.get(mujoco.mjtJoint(int(model.jnt_type[index])), "floating")
    # A joint beside the origin, or one of several, has no form in URDF with the same frames.
    if n_joints > 1 or (kind == "revolute" and np.any(model.jnt_pos[index])):
        kind = "floating"
    if kind == "floating":
        return _connect(kind, parent, child)
    is_limited = bool(n_joints and model.jnt_limited[index])
    joint = _connect("continuous" if kind == "revolute" and not is_limited else kind, parent, child)
    joint.append(origin(model.body_pos[body], model.body_quat[body]))
    if n_joints:
        ElementTree.SubElement(joint, "axis", xyz=join_numbers(model.jnt_axis[index].tolist()))
    if is_limited:
        # In the pose of the bodies above, a joint of MuJoCo has its reference as position.
        lower, upper = (model.jnt_range[index] - model.qpos0[model.jnt_qposadr[index]]).tolist()
        limits = {"lower": lower, "upper": upper, "effort": _effort(model, index), "velocity": 0.0}
        ElementTree.SubElement(joint, "limit", {key: join_numbers([value]) for key, value in limits.items()})
    return joint


def _connect(kind: str, parent: str, child: str) -> ElementTree.Element:
    """Return a joint between two links."""
    joint = ElementTree.Element("joint", name=f"{child}_joint", type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def _effort(model: mujoco.MjModel, joint: int) -> float:
    """Return the largest force or torque of a joint's motor [N, N m]; 0 if it is unknown."""
    motors = np.flatnonzero(model.actuator_trnid[:, 0] == joint)
    return float(np.abs(model.actuator_forcerange[motors]).max(initial=0.0))


def _inertial(model: mujoco.MjModel, body: int) -> ElementTree.Element:
    """Return mass and inertia of a body, about its principal axes."""
    inertial = ElementTree.Element("inertial")
    inertial.append(origin(model.body_ipos[body], model.body_iquat[body]))
    ElementTree.SubElement(inertial, "mass", value=join_numbers([float(model.body_mass[body])]))
    ixx, iyy, izz = model.body_inertia[body].tolist()
    values = {"ixx": ixx, "ixy": 0.0, "ixz": 0.0, "iyy": iyy, "iyz": 0.0, "izz": izz}
    ElementTree.SubElement(inertial, "inertia", {key: join_numbers([value]) for key, value in values.items()})
    return inertial
