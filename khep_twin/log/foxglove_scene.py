"""The scene as foxglove.SceneUpdate, which Foxglove shows without configuration.

One message holds all shapes: fixed bodies in the frame "world", an entity each, and every moving body as an
entity in its own frame of /tf, to which it is locked. The message is protobuf, of classes made at run time
from the descriptors that Foxglove publishes, kept in assets/foxglove_scene_update.bin (`python -m tools
foxglove-schema`); the log holds them too.
"""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.log.description import Shape, body_name, shapes

SCHEMA = "foxglove.SceneUpdate"
"""Name of the message type."""


def descriptors() -> bytes:
    """Return the message type as a google.protobuf.FileDescriptorSet, as required by MCAP."""
    return (files("khep_twin") / "assets" / "foxglove_scene_update.bin").read_bytes()


def scene_update(model: mujoco.MjModel) -> bytes:
    """Return the whole scene as one message; lengths in m."""
    scene = _messages()[SCHEMA]()
    for body in range(model.nbody):
        moves = bool(model.body_weldid[body])
        frame, place = (body_name(model, body), _HERE) if moves else ("world", _place(model, body))
        entity: Any = None
        for shape in shapes(model, body):
            # Not in /tf: each shape of a fixed body is a separate entity, at its position in the world.
            if entity is None or not moves:
                name = frame if moves else f"world/{shape.name}"
                # The timestamp is the start of the run; without a lifetime it has no end.
                entity = scene.entities.add(timestamp={}, frame_id=frame, id=name, frame_locked=True)
            _draw(entity, shape, *_composed(*place, shape.position, shape.quaternion))
    return scene.SerializeToString(deterministic=True)


@cache
def _messages() -> Mapping[str, Any]:
    """Return the message classes by name."""
    # Only needed where a log begins: importing protobuf takes longer than writing the scene.
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message_factory import GetMessages

    return GetMessages(FileDescriptorSet.FromString(descriptors()).file)


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


def _draw(entity: Any, shape: Shape, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
    """Add a shape to an entity; a capsule is a cylinder with a sphere at either end."""
    width, _, length = shape.size
    orientation, colour = _named("wxyz", quaternion), _named("rgba", shape.rgba)

    def add(primitives: Any, at: NDArray[np.float64], size: tuple[float, ...], **more: float) -> None:
        pose = {"position": _named("xyz", at), "orientation": orientation}
        primitives.add(pose=pose, size=_named("xyz", np.array(size)), color=colour, **more)

    if shape.kind == "box":
        add(entity.cubes, position, shape.size)
    elif shape.kind == "sphere":
        add(entity.spheres, position, shape.size)
    else:
        # Both ends are as wide as the middle.
        add(entity.cylinders, position, shape.size, bottom_scale=1.0, top_scale=1.0)
    if shape.kind == "capsule":
        for end in (-1, 1):
            at, _ = _composed(position, quaternion, np.array([0, 0, end * length / 2]), _HERE[1])
            add(entity.spheres, at, (width, width, width))


def _named(names: str, values: NDArray[Any]) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
