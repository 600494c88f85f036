"""Attachments of a log, decoded: the playpen, calibrations, and the scene for its shapes.

A log may come from anywhere, so its attachments, texts by name, are checked like any file of a user. What
cannot be used is a `LogError` of one line, which begins with the `source`, the name of the log in messages.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import xml.etree.ElementTree as ElementTree
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO

import mujoco

from khep_twin import playpen as playpens
from khep_twin.errors import CalibrationError, KhepTwinError, LogError
from khep_twin.files.toml_files import SIZE_LIMIT, validate
from khep_twin.log.decoding import DecodeError, first_line, shown
from khep_twin.playpen import Playpen
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import BODIES, Body

DEEPEST = 64
"""Most levels of nested elements in a scene."""

_KEPT = {"compiler", "default", "worldbody"}
"""Parts of a scene that define its shapes."""

_SHAPES = {"body", "frame", "inertial", "joint", "geom", "site", "camera", "light"}
_ELEMENTS = {"worldbody", "compiler", "default", "general", *_SHAPES}
"""Elements that these parts may hold, as khep_twin writes them: none names a file or replicates itself."""


def playpen_of(attachments: Mapping[str, str], source: object) -> Playpen:
    """Return the playpen of a log."""
    with _named(source, "playpen.toml"):
        return playpens.parse(_text(attachments, "playpen.toml"), "playpen.toml", recorded=True)


def calibration_of(attachments: Mapping[str, str], robot: str, source: object) -> Calibration | None:
    """Return the calibration of a robot; None if the log has none."""
    name = f"calibration/{robot}.toml"
    if name not in attachments:
        return None
    with _named(source, name):
        return validate(Calibration, _text(attachments, name), name, CalibrationError)


def bodies_of(attachments: Mapping[str, str], robots: Sequence[str], source: object) -> dict[str, Body]:
    """Return the body of each robot; the Khepera's where the log has no playpen."""
    entries = playpen_of(attachments, source).robots if "playpen.toml" in attachments else ()
    found = {f"khepera{index}": entry.body for index, entry in enumerate(entries)}
    return {robot: found.get(robot, BODIES["khepera1"]) for robot in robots}


def shapes_of(attachments: Mapping[str, str], robots: Sequence[str], source: object) -> mujoco.MjModel:
    """Return the scene of a log, reduced to its shapes; it has bodies and sensors of these robots."""
    bodies = bodies_of(attachments, robots, source)
    with _named(source, "scene.xml"):
        model = _model(_text(attachments, "scene.xml"))
        there = {model.body(index).name for index in range(model.nbody)}
        there |= {model.cam(index).name for index in range(model.ncam)}
        for robot, body in bodies.items():
            for name in ("base", *body.cameras):
                if f"{robot}/{name}" not in there:
                    raise DecodeError(f"no {robot}/{name}", "it, as the log's robots have it")
        return model


@contextmanager
def _named(source: object, name: str) -> Generator[None]:
    """Turn a problem of an attachment into one line that names the log."""
    try:
        yield
    except DecodeError as error:
        raise LogError(f"{source}: {name}: {error}") from None
    except KhepTwinError as error:
        raise LogError(f"{source}: {first_line(error)}") from None


def _text(attachments: Mapping[str, str], name: str) -> str:
    text = attachments.get(name)
    if text is None:
        raise DecodeError("missing", "it among the attachments")
    if len(text) > SIZE_LIMIT:
        raise DecodeError(f"{len(text)} characters", f"at most {SIZE_LIMIT}")
    return text


def _model(text: str) -> mujoco.MjModel:
    depth, root = 0, None
    try:
        for event, element in ElementTree.iterparse(BytesIO(text.encode("utf-8")), ("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > DEEPEST:
                raise DecodeError(f"elements {depth} deep", f"at most {DEEPEST}")
            root = element
    except (ElementTree.ParseError, UnicodeEncodeError, ValueError) as error:
        if isinstance(error, DecodeError):
            raise
        raise DecodeError(shown(error), "XML") from None
    if root is None or root.tag != "mujoco":
        raise DecodeError("no element mujoco", "a scene in MJCF")
    for part in list(root):
        if part.tag not in _KEPT:
            root.remove(part)
    for element in root.iter():
        if element is not root and element.tag not in _ELEMENTS:
            raise DecodeError(f"element {shown(element.tag)}", f"one of {', '.join(sorted(_ELEMENTS))}")
    try:
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, "unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise DecodeError(shown(error), "a scene that MuJoCo compiles") from None
