"""Attachments of a log, decoded: the playpen, calibrations, and the scene for its shapes.

A log may come from anywhere, so its attachments (texts by name) are checked like any user file. An invalid
attachment raises a `LogError` of one line, which starts with `source`, the name of the log in messages.
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
from khep_twin.log.decoding import DecodeError, first_line, printable
from khep_twin.log.robot_models import models_of
from khep_twin.playpen import Playpen
from khep_twin.sensing.calibration import Calibration

MAX_DEPTH = 64
"""Maximum depth of nested elements in a scene."""

SCENE_LIMIT = 4 << 20
"""Largest scene, that of some 300 robots [characters]."""

_SHAPE_PARTS = {"compiler", "default", "worldbody"}
"""Parts of a scene that define its shapes."""

_SHAPES = {"body", "frame", "inertial", "joint", "geom", "site", "camera", "light"}
_ELEMENTS = {"worldbody", "compiler", "default", "general", *_SHAPES}
"""Elements allowed in these parts, as khep_twin writes them: none names a file or replicates itself."""


def playpen_of(attachments: Mapping[str, str], source: object) -> Playpen:
    """Return the playpen of a log."""
    with _attachment_errors(source, "playpen.toml"):
        return playpens.parse(_attachment_text(attachments, "playpen.toml"), "playpen.toml", recorded=True)


def calibration_of(attachments: Mapping[str, str], robot: str, source: object) -> Calibration | None:
    """Return the calibration of a robot; None if the log has none."""
    name = f"calibration/{robot}.toml"
    if name not in attachments:
        return None
    with _attachment_errors(source, name):
        return validate(Calibration, _attachment_text(attachments, name), name, CalibrationError)


def compile_shapes(attachments: Mapping[str, str], robots: Sequence[str], source: object) -> mujoco.MjModel:
    """Compile the scene of a log, reduced to its shapes, and check that it contains these robots."""
    models = models_of(attachments, robots)
    with _attachment_errors(source, "scene.xml"):
        model = _compile_mjcf(_attachment_text(attachments, "scene.xml", SCENE_LIMIT))
        names = {model.body(index).name for index in range(model.nbody)}
        names |= {model.cam(index).name for index in range(model.ncam)}
        for robot, robot_model in models.items():
            for name in ("base", *robot_model.body.cameras):
                if f"{robot}/{name}" not in names:
                    raise DecodeError(f"no {robot}/{name}", "it, as the log's robots have it")
        return model


@contextmanager
def _attachment_errors(source: object, name: str) -> Generator[None]:
    """Convert an error in an attachment to a `LogError` of one line that names the log."""
    try:
        yield
    except DecodeError as error:
        raise LogError(f"{source}: {name}: {error}") from None
    except KhepTwinError as error:
        raise LogError(f"{source}: {first_line(error)}") from None


def _attachment_text(attachments: Mapping[str, str], name: str, limit: int = SIZE_LIMIT) -> str:
    text = attachments.get(name)
    if text is None:
        raise DecodeError("missing", "it among the attachments")
    if len(text) > limit:
        raise DecodeError(f"{len(text)} characters", f"at most {limit}")
    return text


def _compile_mjcf(text: str) -> mujoco.MjModel:
    """Check a scene in MJCF, and compile its shapes only."""
    depth, root = 0, None
    try:
        for event, element in ElementTree.iterparse(BytesIO(text.encode("utf-8")), ("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > MAX_DEPTH:
                raise DecodeError(f"elements {depth} deep", f"at most {MAX_DEPTH}")
            root = element
    except (ElementTree.ParseError, UnicodeEncodeError, ValueError) as error:
        if isinstance(error, DecodeError):
            raise
        raise DecodeError(printable(error), "XML") from None
    if root is None or root.tag != "mujoco":
        raise DecodeError("no element mujoco", "a scene in MJCF")
    for part in list(root):
        if part.tag not in _SHAPE_PARTS:
            root.remove(part)
    for element in root.iter():
        if element is not root and element.tag not in _ELEMENTS:
            raise DecodeError(f"element {printable(element.tag)}", f"one of {', '.join(sorted(_ELEMENTS))}")
    try:
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, "unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise DecodeError(printable(error), "a scene that MuJoCo compiles") from None
