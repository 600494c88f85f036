"""The scene as foxglove.SceneUpdate, which Foxglove shows without configuration.

One message contains all shapes. Each shape of a fixed body is an entity in the frame "world"; a moving body
is an entity locked to its frame of /tf. The classes of the protobuf message are created at run time from
Foxglove's descriptors in assets/foxglove_scene_update.bin (`python -m tools foxglove-schema`) and in the log.
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

_IDENTITY = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])  # position, quaternion w, x, y, z


def descriptors() -> bytes:
    """Return the message type as a google.protobuf.FileDescriptorSet, as required by MCAP."""
    return (files("khep_twin") / "assets" / "foxglove_scene_update.bin").read_bytes()


def scene_update(model: mujoco.MjModel) -> bytes:
    """Return the scene as one message; lengths in m."""
    scene = _message_classes()[SCHEMA]()
    for body in range(model.nbody):
        is_moving = bool(model.body_weldid[body])
        frame = body_name(model, body) if is_moving else "world"
        pose = _IDENTITY if is_moving else _world_pose(model, body)
        entity: Any = None
        for shape in shapes(model, body):
            # Fixed bodies are not in /tf: each of their shapes is a separate entity, posed in the world.
            if entity is None or not is_moving:
                name = frame if is_moving else f"world/{shape.name}"
                # The timestamp is the start of the run; without a lifetime it has no end.
                entity = scene.entities.add(timestamp={}, frame_id=frame, id=name, frame_locked=True)
            _add(entity, shape, *_compose(*pose, shape.position, shape.quaternion))
    return scene.SerializeToString(deterministic=True)


@cache
def _message_classes() -> Mapping[str, Any]:
    """Return the message classes by name."""
    # Only needed at the start of a log: importing protobuf takes longer than writing the scene.
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message_factory import GetMessages

    return GetMessages(FileDescriptorSet.FromString(descriptors()).file)


def _world_pose(model: mujoco.MjModel, body: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose of a fixed body in the world: position and quaternion w, x, y, z."""
    position, quaternion = _IDENTITY
    while body:
        position, quaternion = _compose(model.body_pos[body], model.body_quat[body], position, quaternion)
        body = int(model.body_parentid[body])
    return position, quaternion


def _compose(
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    inner_position: NDArray[np.float64],
    inner_quaternion: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compose two poses."""
    origin, rotation = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(origin, rotation, position, quaternion, inner_position, inner_quaternion)
    return origin, rotation


def _add(entity: Any, shape: Shape, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
    """Add a shape to an entity; a capsule is a cylinder with a sphere at either end."""
    width, _, length = shape.size
    orientation, colour = _components("wxyz", quaternion), _components("rgba", shape.rgba)

    def add(primitives: Any, centre: NDArray[np.float64], size: tuple[float, ...], **scales: float) -> None:
        pose = {"position": _components("xyz", centre), "orientation": orientation}
        primitives.add(pose=pose, size=_components("xyz", np.array(size)), color=colour, **scales)

    if shape.kind == "box":
        add(entity.cubes, position, shape.size)
    elif shape.kind == "sphere":
        add(entity.spheres, position, shape.size)
    else:
        # Both ends are as wide as the middle.
        add(entity.cylinders, position, shape.size, bottom_scale=1.0, top_scale=1.0)
    if shape.kind == "capsule":
        for end in (-1, 1):
            end_centre, _ = _compose(position, quaternion, np.array([0, 0, end * length / 2]), _IDENTITY[1])
            add(entity.spheres, end_centre, (width, width, width))


def _components(names: str, values: NDArray[Any]) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
