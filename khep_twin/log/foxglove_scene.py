"""The scene as foxglove.SceneUpdate, which Foxglove shows without configuration.

One message holds all shapes: fixed bodies in the frame "world", an entity each, and every moving body as an
entity in its own frame of /tf, to which it is locked. The message is protobuf, encoded here like the ROS
messages in `channels`: importing protobuf takes ten times as long as writing the message. The log holds
the descriptors that Foxglove publishes, kept in assets/foxglove_scene_update.bin
(`make schemas`).
"""

import struct
from collections.abc import Sequence
from importlib.resources import files

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.log.description import Shape, body_name, shapes

SCHEMA = "foxglove.SceneUpdate"
"""Name of the message type."""

_VARINT, _DOUBLE, _BYTES = 0, 1, 2
"""Wire types of fields."""

_ENTITIES = 2
"""Number of the field in SceneUpdate."""

_TIMESTAMP, _FRAME, _ID, _FRAME_LOCKED, _CUBES, _SPHERES, _CYLINDERS = 1, 2, 3, 5, 8, 9, 10
"""Numbers of the fields in SceneEntity; the timestamp is the start of the run, a lifetime of 0 has no end."""


def descriptors() -> bytes:
    """Return the message type as a google.protobuf.FileDescriptorSet, as required by MCAP."""
    return (files("khep_twin") / "assets" / "foxglove_scene_update.bin").read_bytes()


def scene_update(model: mujoco.MjModel) -> bytes:
    """Return the whole scene as one message; lengths in m."""
    entities: list[bytes] = []
    for body in range(model.nbody):
        if model.body_weldid[body]:
            name = body_name(model, body)
            entities.append(_entity(name, name, list(shapes(model, body)), *_HERE))
        else:
            # Not in /tf: each body is an entity of its own, at its place in the world.
            place = _place(model, body)
            entities += [
                _entity("world", f"world/{each.name}", [each], *place) for each in shapes(model, body)
            ]
    return b"".join(_message(_ENTITIES, entity) for entity in entities if entity)


_HERE = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
"""Identity pose."""


def _place(model: mujoco.MjModel, body: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose of a fixed body in the world: position and quaternion w, x, y, z."""
    position, quaternion = _HERE
    while body:
        position, quaternion = _composed(model.body_pos[body], model.body_quat[body], position, quaternion)
        body = int(model.body_parentid[body])
    return position, quaternion


def _composed(
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    inner_position: NDArray[np.float64],
    inner_quaternion: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compose two poses."""
    place, turn = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(place, turn, position, quaternion, inner_position, inner_quaternion)
    return place, turn


def _entity(
    frame: str,
    name: str,
    drawn: Sequence[Shape],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
) -> bytes:
    """Return a SceneEntity of shapes at a place in the frame; empty without any."""
    if not drawn:
        return b""
    parts = [
        _message(_TIMESTAMP, b""),
        _message(_FRAME, frame.encode("utf-8")),
        _message(_ID, name.encode("utf-8")),
        _tag(_FRAME_LOCKED, _VARINT) + b"\1",
    ]
    primitives: list[tuple[int, bytes]] = []
    for shape in drawn:
        pose = _composed(position, quaternion, shape.position, shape.quaternion)
        primitives += _primitives(shape, *pose)
    # In the order of their fields, as protobuf writes them.
    parts += [_message(number, content) for number, content in sorted(primitives, key=lambda each: each[0])]
    return b"".join(parts)


def _primitives(
    shape: Shape, position: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> list[tuple[int, bytes]]:
    """Return a shape as field and primitive; a capsule is a cylinder with a sphere at either end."""
    colour = _doubles(*shape.rgba.tolist())
    pose, size = _pose(position, quaternion), _doubles(*shape.size)
    if shape.kind == "box":
        return [(_CUBES, _message(1, pose) + _message(2, size) + _message(3, colour))]
    if shape.kind == "sphere":
        return [(_SPHERES, _message(1, pose) + _message(2, size) + _message(3, colour))]
    # Both ends are as wide as the middle.
    scales = _double(3, 1.0) + _double(4, 1.0)
    cylinder = (_CYLINDERS, _message(1, pose) + _message(2, size) + scales + _message(5, colour))
    if shape.kind == "cylinder":
        return [cylinder]
    width, _, length = shape.size
    ends = [
        _composed(position, quaternion, np.array([0, 0, end * length / 2]), _HERE[1])[0] for end in (-1, 1)
    ]
    ball = _message(2, _doubles(width, width, width)) + _message(3, colour)
    return [*((_SPHERES, _message(1, _pose(end, quaternion)) + ball) for end in ends), cylinder]


def _pose(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> bytes:
    w, x, y, z = quaternion.tolist()
    return _message(1, _doubles(*position.tolist())) + _message(2, _doubles(x, y, z, w))


def _doubles(*values: float) -> bytes:
    """Return a message of doubles in fields 1, 2, 3 and so on: a vector, a quaternion, a colour."""
    return b"".join(_double(number, value) for number, value in enumerate(values, 1))


def _double(number: int, value: float) -> bytes:
    """Return a field with a double; empty for 0, as in protobuf."""
    data = struct.pack("<d", value)
    return _tag(number, _DOUBLE) + data if any(data) else b""


def _message(number: int, content: bytes) -> bytes:
    """Return a field with a text or a message."""
    return _tag(number, _BYTES) + _varint(len(content)) + content


def _tag(number: int, kind: int) -> bytes:
    return _varint(number << 3 | kind)


def _varint(value: int) -> bytes:
    """Return an integer, seven bits a byte, the lowest first."""
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*data, value])
